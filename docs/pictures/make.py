"""Makes the pictures of README and the front page anew: ``make pictures``.

``python docs/pictures/make.py [--quick] [--out DIR] [NAME ...]``; quick: few rays and pixels.
"""

from __future__ import annotations

import argparse
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import chromium  # next to this file
import numpy as np
import rooms
from matplotlib.figure import Figure
from PIL import Image

import mrt_mitsuba as mrt  # first: it chooses the LLVM library

# isort: split
import mitsuba as mi

from mrt_mitsuba.files import to_8bit
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation import work_precision
from mrt_mitsuba.validation.studies import error_vs_time

HERE = Path(__file__).parent
LATE = 1.2  # times our own: time of a sampler that is still equal
SAMPLERS = ("independent", "stratified", "multijitter", "ldsampler")  # of Mitsuba


def scene3(quick: bool) -> Image.Image:
    """Scene 3 as the command renders it, by default at 800×600."""
    amount = {"aa": 1, "aamode": "none"} if quick else {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene3.png"
        mrt.render(3, **amount).save(path)
        return Image.open(path).convert("RGB")


def check(quick: bool) -> Image.Image:
    """A law that ``roughdielectric`` without visible normals breaks, as the page of a check shows it."""
    from playwright.sync_api import sync_playwright

    found = mrt.check_bsdf({"type": "roughdielectric", "sample_visible": False}, quick=quick)
    with (
        tempfile.TemporaryDirectory() as folder,
        sync_playwright() as playwright,
    ):
        found.save(folder)
        browser = chromium.launch(playwright)
        page = browser.new_page(viewport={"width": 1240, "height": 700})
        page.goto(f"file://{folder}/index.html")
        law = page.locator("article", has=page.locator("h3 code", has_text="energy"))
        box = law.bounding_box()
        clip = {"x": 0, "y": box["y"], "width": 1240, "height": 850}
        shot = page.screenshot(full_page=True, clip=clip)
        browser.close()
    return Image.open(io.BytesIO(shot)).convert("RGB")


def equal_time(quick: bool) -> Image.Image:
    """Mitsuba's Cornell box in the same time: by the best of its samplers, and denoised by ours."""
    mrt.register()
    side = 64 if quick else 256

    def load(sampler: str) -> mi.Scene:
        box = mi.cornell_box()
        box["sensor"]["film"] |= {"width": side, "height": side}
        box["sensor"]["sampler"] = {"type": sampler}
        return mi.load_dict(box)

    def theirs(scene: mi.Scene, spp: int, seed: int) -> np.ndarray:
        return np.array(mi.render(scene, spp=spp, seed=seed))

    def timed(render: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[Any, float]:
        start = time.perf_counter()
        return render(*arguments, **options), time.perf_counter() - start

    scene = load("multijitter")
    truth = np.mean([theirs(scene, 64 if quick else 256, 100 + k) for k in range(8)], axis=0)
    options: dict[str, Any] = {"metric": "display", "denoise": True, "target": "1%", "progress": Progress()}
    for seed in range(3):  # the first one compiles its kernels
        result, seconds = timed(mrt.render, scene, seed=seed, **options)
    rivals = []
    for sampler in SAMPLERS:
        loaded = load(sampler)
        spp = 16
        for seed in range(4):  # ends at a number of samples that takes the same time
            image, took = timed(theirs, loaded, spp, seed)
            spp = max(round(spp * seconds / took), 1)
        rivals.append((mrt.compare(image, truth).display, f"mi.render, {sampler}", took, image))
    # those that draw 4ⁿ samples only are passed over where that takes longer
    _, best, took, image = min(rival for rival in rivals if rival[2] < LATE * seconds)
    drawn = Figure(figsize=(10.4, 4.0), layout="compressed")
    shown = {f"{best}: {took:.2f} s": image, f"mrt.render, denoised: {seconds:.2f} s": result.image}
    shown["converged"] = truth
    for axes, (name, picture) in zip(drawn.subplots(1, 3), shown.items(), strict=True):
        axes.imshow(to_8bit(np.float32(picture), "srgb"), interpolation="nearest")
        axes.set_axis_off()
        found = mrt.compare(picture, truth)
        error = "" if picture is truth else f"\nFLIP {found.flip:.3f}, display RMSE {found.display:.3f}"
        axes.set_title(name + error, loc="left", fontsize=10)
    return rasterized(drawn)


def error_against_time(quick: bool) -> Image.Image:
    """What an error costs in time in scene 3 by the report's rays, and in the Cornell box by paths."""
    panels = []
    for scene in (3, error_vs_time.BOX):
        cost = error_vs_time.QUICK if quick else error_vs_time.DOCS
        for title, found in error_vs_time.scene_findings(scene, cost).items():
            panels.append(np.asarray(rasterized(work_precision.diagram(title, found))))
    return Image.fromarray(np.hstack(panels))


def rasterized(figure: Figure) -> Image.Image:
    """A figure as pixels."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=120, facecolor="white")
    return Image.open(file).convert("RGB")


def save_rooms(folder: Path) -> Path:
    """Write the drawing of the architecture page, which is the same on every machine."""
    path = folder / "rooms.svg"
    path.write_text(rooms.drawing())
    return path


PICTURES = {
    "scene3": scene3,
    "equal_time": equal_time,
    "check": check,
    "error_against_time": error_against_time,
}


def save(image: Image.Image, path: Path) -> None:
    """Write a PNG; drawings in 256 colours, which takes a third of the room."""
    if path.stem != "scene3":
        image = image.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    image.save(path, optimize=True)


def main(words: list[str] | None = None) -> None:
    """Make the pictures that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"of {', '.join(PICTURES)}; none: all",
    )
    parser.add_argument("--quick", action="store_true", help="few rays and pixels")
    parser.add_argument("--out", type=Path, default=HERE, help="folder")
    given = parser.parse_args(words)
    unknown = set(given.names) - {*PICTURES, "rooms"}
    if unknown:
        parser.error(f"no such picture: {', '.join(sorted(unknown))}")
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.names or [*PICTURES, "rooms"]:
        path = given.out / f"{name}.png"
        if name == "rooms":
            path = save_rooms(given.out)
        else:
            save(PICTURES[name](given.quick), path)
        print(path)


if __name__ == "__main__":
    main()
