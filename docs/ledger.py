"""The ledger: for each way in which the original is wrong or peculiar, a number and a switch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scenes import report_scene

SIZE = {"width": 320, "height": 240}
PLAIN = {**SIZE, "aamode": "none", "focaldist": 0}


@dataclass(frozen=True)
class Row:
    what: str
    original: str
    ours: str
    switch: str
    measure: Callable[[], str]


def _rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def lattice_shift() -> str:
    """Both lattices against many centred samples."""
    truth = mrt.render(3, **PLAIN, aa=16, lattice="centered").image
    report, centered = (mrt.render(3, **PLAIN, aa=4, lattice=kind).image for kind in ("report", "centered"))
    errors = [f"{_rms(image, truth):.2e}" for image in (report, centered)]
    return f"scene 3, aa=4, RMSE to 256 centred samples: {errors[0]} and {errors[1]}"


def clamp() -> str:
    whole = mrt.render(1, **PLAIN, aa=1, integrator={"type": "mrt_whitted", "clamp": False}).image
    clamped = mrt.render(1, **PLAIN, aa=1).image
    touched = np.mean(np.abs(whole - clamped).max(axis=-1) > 1e-6)
    return (
        f"scene 1: changes {100 * touched:.1f} % of the pixels, by up to {np.abs(whole - clamped).max():.0f}"
    )


def acne() -> str:
    """The original's rays start a fixed distance off; scaled down, that distance grows against the scene."""
    from mrt_mitsuba.validation.reference import reference_render

    scene = report_scene(3)
    exact = reference_render(scene, **SIZE).image
    original = reference_render(scene, **SIZE, self_intersection="original").image
    ours = mrt.render(3, **PLAIN, aa=1, fresnel="dielectric").image
    share = [100 * np.mean(np.abs(image - exact).max(axis=-1) > 1 / 255) for image in (original, ours)]
    return f"scene 3, pixels off by more than 1/255 from float64: {share[0]:.3f} % and {share[1]:.3f} %"


def fresnel() -> str:
    schlick, exact = (mrt.render(3, **PLAIN, aa=1, fresnel=form).image for form in ("schlick", "dielectric"))
    return f"scene 3: mean difference {np.abs(schlick - exact).mean():.2e}"


def detectors() -> str:
    truth = mrt.render(3, **PLAIN, aa=4).image
    parts = []
    for aamode in ("luma", "sobel", "geometry"):
        result = mrt.render(3, **{**PLAIN, "aamode": aamode}, aa=4)
        refined = np.mean(result.layers["samples.Y"] > 1)
        parts.append(f"{aamode} refines {100 * refined:.0f} % and leaves {_rms(result.image, truth):.1e}")
    return "scene 3, RMSE to every pixel refined: " + ", ".join(parts)


def seams() -> str:
    options = {**SIZE, "aamode": "none", "aa": 1, "focaldist": 3.0, "focalrange": 0.5, "layers": ["depth"]}
    steps = []
    for dof in ("report", "corrected"):
        result = mrt.render(3, **options, dof=dof)
        steps.append(result.image)
    return f"scene 3: the two differ by {_rms(*steps):.1e} RMSE; the depth-of-field study has a thin lens too"


def mirrored() -> str:
    image = mrt.render(3, **PLAIN, aa=1).image
    return f"scene 3 against its mirror image: {_rms(image, image[:, ::-1]):.2f} RMSE"


def gamma() -> str:
    from mrt_mitsuba.output import to_8bit

    image = mrt.render(0, **PLAIN, aa=1).image
    report, srgb = (to_8bit(image, tonemap).mean() for tonemap in ("report", "srgb"))
    return f"scene 0, mean 8-bit level: {report:.0f} and {srgb:.0f}"


def budget() -> str:
    scene = report_scene(3)
    report = mrt.render(scene, **PLAIN, aa=1).image
    plain = mrt.render(
        scene, **PLAIN, aa=1, integrator={"type": "mrt_whitted", "bounce_budget": "plain"}
    ).image
    glass = replace(
        scene, spheres=tuple(replace(s, material=replace(s.material, ior=0.5)) for s in scene.spheres)
    )
    low = mrt.render(glass, **PLAIN, aa=1).image
    free = mrt.render(
        glass, **PLAIN, aa=1, integrator={"type": "mrt_whitted", "bounce_budget": "plain"}
    ).image
    return (
        f"scene 3: mean difference {np.abs(report - plain).mean():.1e}; with spheres of index 0.5, "
        f"{np.abs(low - free).mean():.1e}"
    )


ROWS = (
    Row(
        "Sub-pixel lattice",
        "starts at the pixel's centre, so the picture is shifted by up to half a pixel",
        "faithful, or centred in the pixel",
        "`lattice=report`, `centered`",
        lattice_shift,
    ),
    Row(
        "Clamp of each light to 1",
        "its author disliked it, but highlights were too bright",
        "faithful, or off",
        "`clamp` of `mrt_whitted`",
        clamp,
    ),
    Row(
        "Self-intersection",
        "absolute distances 1e-4 and 1e-3: speckled shadow borders, wrong at other scales",
        "relative to the coordinates",
        "none: corrected",
        acne,
    ),
    Row(
        "Fresnel",
        "exact dielectric, where the report writes Schlick",
        "Schlick, or exact",
        "`fresnel=schlick`, `dielectric`",
        fresnel,
    ),
    Row(
        "Detectors",
        "luma and Sobel; both refine smooth gradients, luma misses edges",
        "faithful, and one of shape",
        "`aamode=luma`, `sobel`, `geometry`",
        detectors,
    ),
    Row(
        "Depth of field",
        "window without a centre, steps, seams where the depth jumps, leaks at outlines",
        "faithful, or a gathering lens",
        "`dof=report`, `corrected`",
        seams,
    ),
    Row(
        "Bounce budget",
        "a low index of refraction ends reflection early; 0 switches it off",
        "faithful, or one for each",
        "`bounce_budget=report`, `plain`",
        budget,
    ),
    Row(
        "Left and right",
        "mirrored against a right-handed camera",
        "faithful",
        "none: part of the scenes' camera",
        mirrored,
    ),
    Row("PNG", "linear values, truncated", "faithful, or sRGB, rounded", "`tonemap=report`, `srgb`", gamma),
    Row(
        "Cone",
        "no base, no shadow, wrong normals",
        "whole, exact, also as an emitter or under `path`",
        "none: corrected",
        lambda: "scene 9 in the [gallery](gallery.md) shows base and shadow",
    ),
    Row("Cylinder", "missing", "`mrt_cylinder` with caps", "none: new", lambda: "see [plugins](plugins.rst)"),
    Row(
        "Textures",
        "on triangles only",
        "on every shape with coordinates",
        "none: new",
        lambda: "`mrt_texture` reads as the report does, `bitmap` as Mitsuba does",
    ),
    Row(
        "Motion blur",
        "whole renders averaged, so highlights stay sharp",
        "the same, or times spread over the samples",
        "`motion`, `motionsamples`",
        lambda: "see the [gallery](gallery.md)",
    ),
    Row(
        "Progress",
        "none in the adaptive passes",
        "a bar with the time left in every pass",
        "`quiet`",
        lambda: "",
    ),
)


def build(folder: Path) -> None:
    """Measure every row and write the page to include."""
    lines = []
    for row in ROWS:
        measured = row.measure()
        lines += [
            f"## {row.what}",
            "",
            f"- **Original:** {row.original}.",
            f"- **Ours:** {row.ours}.",
            f"- **Switch:** {row.switch}.",
        ]
        lines += [f"- **Measured:** {measured}."] if measured else []
        lines += [""]
    (folder / "ledger.inc.md").write_text("\n".join(lines))
