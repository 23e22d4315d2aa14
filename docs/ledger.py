"""The ledger: for each way in which the original is wrong or peculiar, a number and a switch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Cylinder
from mrt_mitsuba.scene.report import report_scene

SIZE = {"width": 320, "height": 240}
PLAIN = {**SIZE, "aamode": "none", "focaldist": 0}


FAITHFUL, CORRECTED = "faithful", "corrected"


class Row(NamedTuple):
    """``default``: "faithful" to the original, or "corrected"; ``switch``: how to choose."""

    what: str
    original: str
    ours: str
    default: str
    switch: str
    measure: Callable[[], str]


ROWS: list[Row] = []


def deviation(*words: str) -> Callable[[Callable[[], str]], Callable[[], str]]:
    """Add a function that measures a deviation to ``ROWS``, with the words of its row."""

    def add(measure: Callable[[], str]) -> Callable[[], str]:
        ROWS.append(Row(*words, measure))
        return measure

    return add


def _rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


@deviation(
    "Sub-pixel lattice",
    "starts at the pixel's centre, so the picture is shifted by up to half a pixel",
    "the same, or centred in the pixel",
    FAITHFUL,
    "`lattice=report`, `centered`",
)
def lattice_shift() -> str:
    """Both lattices against many centred samples."""
    truth = mrt.render(3, **PLAIN, aa=16, lattice="centered").image
    report, centered = (mrt.render(3, **PLAIN, aa=4, lattice=kind).image for kind in ("report", "centered"))
    errors = [f"{_rms(image, truth):.1e}" for image in (report, centered)]
    return f"scene 3, aa=4, RMSE to 256 centred samples: {errors[0]}, centred {errors[1]}"


@deviation(
    "Clamp of each light to 1",
    "highlights were too bright, so each light's share is cut at 1; its author disliked it",
    "the same, or not cut",
    FAITHFUL,
    "`clamp` of `mrt_whitted`",
)
def clamp() -> str:
    whole = mrt.render(1, **PLAIN, aa=1, integrator={"type": "mrt_whitted", "clamp": False}).image
    clamped = mrt.render(1, **PLAIN, aa=1).image
    touched = np.mean(np.abs(whole - clamped).max(axis=-1) > 1e-6)
    return (
        f"scene 1: changes {100 * touched:.1f} % of the pixels, by up to {np.abs(whole - clamped).max():.0f}"
    )


@deviation(
    "Self-intersection",
    "absolute distances 1e-4 and 1e-3: speckled shadow borders, wrong at other scales",
    "relative to the coordinates",
    CORRECTED,
    "none",
)
def acne() -> str:
    """The original's rays start a fixed distance off; scaled down, that distance grows against the scene."""
    from mrt_mitsuba.validation.oracles.reference import reference_render

    scene = report_scene(3)
    exact = reference_render(scene, **SIZE).image
    original = reference_render(scene, **SIZE, start="original").image
    ours = mrt.render(3, **PLAIN, aa=1, fresnel="dielectric").image
    share = [100 * np.mean(np.abs(image - exact).max(axis=-1) > 1 / 255) for image in (original, ours)]
    figures = f"original {share[0]:.3f} %, ours {share[1]:.3f} %"
    return f"scene 3, pixels off by more than 1/255 from float64: {figures}"


@deviation(
    "Fresnel",
    "the program computes the exact dielectric; the report writes Schlick",
    "Schlick, or exact",
    "faithful to the report",
    "`fresnel=schlick`, `dielectric`",
)
def fresnel() -> str:
    schlick, exact = (mrt.render(3, **PLAIN, aa=1, fresnel=form).image for form in ("schlick", "dielectric"))
    return f"scene 3: the two differ by {np.abs(schlick - exact).mean():.1e} in the mean"


@deviation(
    "Negative roughness",
    "some spheres have one, and Smith's term feels the sign",
    "the same, but no light below zero",
    FAITHFUL,
    "none: choose another `alpha`",
)
def roughness_sign() -> str:
    """Scene 2 has spheres of negative roughness: Smith's term feels the sign."""
    scene = report_scene(2)
    negative = sum(sphere.material.alpha < 0 for sphere in scene.spheres)
    positive = replace(
        scene,
        spheres=tuple(
            replace(s, material=replace(s.material, alpha=abs(s.material.alpha))) for s in scene.spheres
        ),
    )
    images = [mrt.render(s, **PLAIN, aa=1).image for s in (scene, positive)]
    changed = np.mean(np.abs(images[0] - images[1]).max(axis=-1) > 1 / 255)
    return f"scene 2 has {negative} such spheres; made positive, {100 * changed:.2f} % of the pixels change"


@deviation(
    "Detectors",
    "luma and Sobel; both refine smooth gradients, luma misses edges",
    "the same, and one of shape",
    FAITHFUL,
    "`aamode=luma`, `sobel`, `geometry`",
)
def detectors() -> str:
    truth = mrt.render(3, **PLAIN, aa=4).image
    parts = []
    for aamode in ("luma", "sobel", "geometry"):
        result = mrt.render(3, **{**PLAIN, "aamode": aamode}, aa=4)
        refined = np.mean(result.layers["samples.Y"] > 1)
        parts.append(f"{aamode} refines {100 * refined:.0f} % and leaves {_rms(result.image, truth):.1e}")
    return "scene 3, RMSE to every pixel refined: " + ", ".join(parts)


@deviation(
    "Depth of field",
    "window without a centre, steps, seams where the depth jumps, leaks at outlines",
    "the same, or gathered as behind a lens",
    FAITHFUL,
    "`dof=report`, `corrected`",
)
def seams() -> str:
    options = {**SIZE, "aamode": "none", "aa": 1, "focaldist": 3.0, "focalrange": 0.5, "layers": ["depth"]}
    steps = [mrt.render(3, **options, dof=dof).image for dof in ("report", "corrected")]
    return (
        f"scene 3, focus at 3, range 0.5: the two differ by {_rms(*steps):.1e} RMSE; against a real lens, "
        "see the study `filters` of [validation](validation.md)"
    )


@deviation(
    "Bounce budget",
    "a low index of refraction ends reflection early; 0 switches it off",
    "the same, or one for each bounce",
    FAITHFUL,
    "`bounce_budget=report`, `plain` of `mrt_whitted`",
)
def budget() -> str:
    scene, plain = report_scene(3), {"type": "mrt_whitted", "bounce_budget": "plain"}
    spheres = (replace(s, material=replace(s.material, ior=0.5)) for s in scene.spheres)
    changes = []
    for one in (scene, replace(scene, spheres=tuple(spheres))):
        images = [mrt.render(one, **PLAIN, aa=1, integrator=i).image for i in (None, plain)]
        changes.append(np.abs(images[0] - images[1]).mean())
    return f"scene 3: mean difference {changes[0]:.1e}; with spheres of index 0.5, {changes[1]:.1e}"


@deviation(
    "Left and right",
    "mirrored against a right-handed camera",
    "the same",
    FAITHFUL,
    "none: part of the scenes' camera",
)
def mirrored() -> str:
    image = mrt.render(3, **PLAIN, aa=1).image
    return f"scene 3 against its mirror image: {_rms(image, image[:, ::-1]):.2f} RMSE"


@deviation(
    "PNG",
    "linear values, truncated",
    "the same, or sRGB, rounded",
    FAITHFUL,
    "`tonemap=report`, `srgb`",
)
def gamma() -> str:
    from mrt_mitsuba.output.files import to_8bit

    image = mrt.render(0, **PLAIN, aa=1).image
    report, srgb = (to_8bit(image, tonemap).mean() for tonemap in ("report", "srgb"))
    return f"scene 0, mean 8-bit level: {report:.0f}, in sRGB {srgb:.0f}"


@deviation(
    "Cone",
    "no base, no shadow, wrong normals",
    "whole and exact, also as an emitter or under `path`",
    CORRECTED,
    "`capped` of `mrt_cone` leaves the base out",
)
def cone() -> str:
    """Return how much of scene 9 shows what the original's cone lacks: its shadow, and its shading."""
    scene = report_scene(9)
    whole, empty = (mrt.render(s, **PLAIN, aa=1, layers=["depth"]) for s in (scene, replace(scene, cones=())))
    on_plane = whole.layers["depth.Z"] == empty.layers["depth.Z"]
    shadow = on_plane & (np.abs(whole.image - empty.image).max(axis=-1) > 1 / 255)
    shares = [f"{100 * part.mean():.1f} %" for part in (shadow, ~on_plane)]
    return f"scene 9: the shadow covers {shares[0]} of the pixels, the cone {shares[1]}"


@deviation(
    "Cylinder",
    "missing",
    "`mrt_cylinder`, with its two discs",
    CORRECTED,
    "`capped` of `mrt_cylinder`",
)
def cylinder() -> str:
    """Distances to a cylinder in place of the cone of scene 9, in float32 against float64."""
    from mrt_mitsuba.validation.oracles.reference import reference_render

    scene = report_scene(9)
    cone = scene.cones[0]
    tube = Cylinder(cone.apex, cone.base_center, cone.radius, cone.material)
    scene = replace(scene, cones=(), cylinders=(tube,))
    exact = reference_render(scene, **SIZE).depth
    t = mrt.render(scene, **PLAIN, aa=1, layers=["depth"]).layers["depth.Z"]
    both = np.isfinite(t) & np.isfinite(exact)
    error = np.median(np.abs(t[both] / exact[both] - 1))
    return f"{both.sum()} pixels, median relative error of the distance against float64: {error:.0e}"


@deviation(
    "Textures",
    "on triangles only, nearest texel, values as stored",
    "on every shape with coordinates; read the same way, or as Mitsuba does",
    FAITHFUL,
    "`texturing=report`, `standard`",
)
def textures() -> str:
    scene = report_scene(8)
    images = [mrt.render(replace(scene, texturing=t), **PLAIN, aa=1).image for t in ("report", "standard")]
    return f"scene 8: the two ways differ by {np.abs(images[0] - images[1]).mean():.1e} in the mean"


@deviation(
    "MTL files",
    "`Ni` is the roughness and `Ka` the index of refraction",
    "the same, or as the format is described",
    FAITHFUL,
    "`convention=report`, `standard`",
)
def materials() -> str:
    house = Path(__file__).parent / "examples" / "house.obj"
    images = [mrt.render(house, **PLAIN, aa=1, convention=c).image for c in ("report", "standard")]
    mean = np.abs(images[0] - images[1]).mean()
    return f"the house of [models from files](models.md): the two readings differ by {mean:.1e} in the mean"


@deviation(
    "Motion blur",
    "whole renders averaged, so that highlights stay sharp, in copies",
    "the same, or times spread over the rays",
    FAITHFUL,
    "`motionmode=frames`, `stratified`",
)
def motion() -> str:
    moving = {**PLAIN, "aa": 2, "motion": (0.25, 0, -0.25)}
    truth = mrt.render(3, **moving, motionsamples=512).image
    errors = []
    for motionmode in ("frames", "stratified"):
        image = mrt.render(3, **moving, motionsamples=8, motionmode=motionmode).image
        errors.append(f"{motionmode} {_rms(image, truth):.1e}")
    return f"scene 3, 8 moments, RMSE to 512: {' (32 rays a pixel), '.join(errors)} (8 rays)"


@deviation(
    "Progress",
    "none in the adaptive passes",
    "a bar with the time left in every pass",
    CORRECTED,
    "`quiet=1`",
)
def progress() -> str:
    from mrt_mitsuba.rendering.progress import Progress

    class Titles(Progress):
        def __init__(self) -> None:
            self.seen: list[str] = []

        def stage(self, title, total, message=""):
            self.seen.append(title.lower())
            return super().stage(title, total, message)

    titles = Titles()
    mrt.render(3, **SIZE, focaldist=2.0, progress=titles)
    return f"scene 3: {len(titles.seen)} passes with a bar each ({', '.join(titles.seen)})"


def build(folder: Path) -> None:
    """Measure every row and write the page to include."""
    lines = ["| what | by default | switch |", "|---|---|---|"]
    lines += [f"| [{row.what}](#{_anchor(row.what)}) | {row.default} | {row.switch} |" for row in ROWS]
    for row in ROWS:
        lines += [
            "",
            f"## {row.what}",
            "",
            f"- **Original:** {row.original}.",
            f"- **Ours:** {row.ours}.",
            f"- **By default:** {row.default}.",
            f"- **Switch:** {row.switch}.",
            f"- **Measured:** {row.measure()}.",
        ]
    (folder / "ledger.inc.md").write_text("\n".join(lines) + "\n")


def _anchor(title: str) -> str:
    return title.lower().replace(" ", "-")
