"""Makes the pictures of README and the front page anew: ``make pictures``.

``python docs/pictures/make.py [--quick] [--out DIR] [NAME ...]``; quick: few rays.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from pathlib import Path

import chromium  # next to this file
import rooms
from PIL import Image

import mrt_mitsuba as mrt  # first: it chooses the LLVM library

HERE = Path(__file__).parent


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
        page = browser.new_page(viewport={"width": 1000, "height": 900})
        page.goto(f"file://{folder}/index.html")
        shot = page.screenshot(clip={"x": 0, "y": 130, "width": 1000, "height": 420})
        browser.close()
    return Image.open(io.BytesIO(shot)).convert("RGB")


def save_rooms(folder: Path) -> Path:
    """Write the drawing of the architecture page, which is the same on every machine."""
    path = folder / "rooms.svg"
    path.write_text(rooms.drawing())
    return path


PICTURES = {"scene3": scene3, "check": check}


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
    parser.add_argument("--quick", action="store_true", help="few rays")
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
