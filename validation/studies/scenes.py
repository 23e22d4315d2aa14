"""The report's scenes in float32 against the float64 tracer, with the reason for each pixel that differs.

The tracer shares no intersection code with Mitsuba, no acceleration structure and no float32. Where the
original program's own renders are at hand, it judges those as well.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.tools.sensitivity import sensitivity
from mrt_mitsuba.validation.tools.study import Study

TITLE = "The report's scenes, judged in float64"

STEP = 1 / 255  # of an 8-bit picture: what nobody sees

# Float32 places a ray of such a picture to about 1e-5 of a pixel; a mirror ray off a small sphere diverges a
# hundred times as much. Where so small a move changes what is met, float32 may meet the other
DISPLACEMENT = 1e-3

REASONS = ("silhouette", "shadow edge", "steep shading", "unexplained")


@dataclass(frozen=True)
class Limit:
    """What a scene may differ by: mean absolute difference, and share of pixels off by more than a step."""

    mean: float
    share: float


# Rounding alone leaves about 1e-7, ``min_contribution`` up to 1e-5 (it cuts paths, and the more mirrors the
# more of them); the rest is for single pixels on the other side of an edge, each worth up to 1 in some ten
# thousand
LIMITS = {
    0: Limit(2e-6, 0.001),
    1: Limit(1e-5, 0.001),
    2: Limit(1e-5, 0.001),
    3: Limit(2e-5, 0.001),
    4: Limit(2e-4, 0.002),
    9: Limit(1e-5, 0.001),
}


@dataclass(frozen=True)
class Judgement:
    """A picture against the truth.

    ``error`` [H, W]: the largest difference in a channel. ``reason`` [H, W]: an index in ``REASONS`` where it
    exceeds a step of an 8-bit picture, else -1. ``delicate``: share of all
    pixels that stand on a silhouette
    or a shadow's edge.
    """

    image: np.ndarray
    truth: np.ndarray
    error: np.ndarray
    reason: np.ndarray
    delicate: float | None

    @property
    def mean(self) -> float:
        """Mean absolute difference over pixels and channels."""
        return float(np.abs(self.image - self.truth).mean())

    @property
    def share(self) -> float:
        """Share of pixels off by more than a step."""
        return float(np.mean(self.error > STEP))

    def count(self, reason: str) -> int:
        """Number of pixels that are off for a reason."""
        return int(np.sum(self.reason == REASONS.index(reason)))


def judge(
    image: np.ndarray, scene: Scene, *, displacement: float = DISPLACEMENT, **settings: Any
) -> Judgement:
    """Judge a linear picture [H, W, 3], one sample a pixel; ``settings``: those of ``reference_render``.

    A pixel that is off by more than a step is on a silhouette or a shadow's edge if a ray moved by
    ``displacement`` pixels meets other things or other lights, on steep shading if that changes its colour by
    as much, or unexplained.
    """
    height, width, _ = image.shape
    truth = reference_render(scene, width=width, height=height, **settings).image
    error = np.abs(image - truth).max(axis=-1)
    off = error > STEP
    if not off.any():
        return Judgement(image, truth, error, np.full(off.shape, -1), None)
    found = sensitivity(scene, width=width, height=height, displacement=displacement, **settings)
    steep = off & (error <= found.spread)
    reason = np.select([~off, found.silhouette, found.shadow, steep], [-1, 0, 1, 2], 3)
    return Judgement(image, truth, error, reason, float(np.mean(found.silhouette | found.shadow)))


def draw(scene: int | Scene, size: tuple[int, int], *, whole: bool = False) -> np.ndarray:
    """Our picture, one sample per pixel, exact Fresnel; ``whole``: with no path cut short."""
    return mrt.render(
        scene,
        width=size[0],
        height=size[1],
        aa=1,
        aamode="none",
        focaldist=0,
        fresnel="dielectric",
        integrator={"type": "mrt_whitted", "min_contribution": 0.0} if whole else None,
    ).image


def original_renders() -> Path | None:
    """The folder of the original program's renders, if at hand: in MRT_REFERENCE or beside the checkout."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "reference"
    folder = Path(os.environ.get("MRT_REFERENCE", beside)) / "renders"
    return folder if folder.is_dir() else None


def run(study: Study, *, quick: bool) -> None:
    """Judge our renders, and the original's where they are at hand."""
    judged = _ours(study, quick)
    _pictures(study, judged)
    _original(study, quick)


# -------------------------------------------------- Ours --------------------------------------------------


def _ours(study: Study, quick: bool) -> dict[int, Judgement]:
    judged, rows = {}, []
    with study.stage("Scenes in float64", len(LIMITS)) as advance:
        for number in LIMITS:
            size = _size(number, quick)
            judgement = judged[number] = judge(draw(number, size), report_scene(number))
            _bounds(study, number, judgement)
            rounding = float(np.abs(draw(number, size, whole=True) - judgement.truth).mean())
            rows.append([number, "{}x{}".format(*size), *_row(judgement, rounding)])
            advance(1)
    figures = ["mean difference", "mean, no path cut", "largest", "% off by > 1/255"]
    study.table(
        "scenes",
        "Our renders against the float64 tracer",
        ["scene", "size", *figures, *REASONS, "% delicate pixels"],
        rows,
        note="One sample per pixel, exact Fresnel. Pixels off by more than 1/255 are counted by reason. "
        "Delicate pixels would change what they meet, or a light, if their ray moved by "
        f"{DISPLACEMENT:g} pixels; they are looked for where something must be explained.",
    )
    return judged


def _row(judgement: Judgement, rounding: float) -> list[Any]:
    delicate = "-" if judgement.delicate is None else 100 * judgement.delicate
    largest = float(judgement.error.max())
    counts = map(judgement.count, REASONS)
    return [judgement.mean, rounding, largest, 100 * judgement.share, *counts, delicate]


def _size(number: int, quick: bool) -> tuple[int, int]:
    """Brute force over 600 spheres takes ten times as long as any other scene."""
    if number == 4:
        return (80, 60) if quick else (320, 240)
    return (120, 90) if quick else (320, 240)


def _bounds(study: Study, number: int, judgement: Judgement) -> None:
    limit = LIMITS[number]
    study.at_most(f"scene {number}: mean difference", judgement.mean, limit.mean)
    study.at_most(f"scene {number}: share of pixels off by > 1/255", judgement.share, limit.share)
    study.at_most(f"scene {number}: pixels off without a reason", judgement.count("unexplained"), 0)


# ------------------------------------------------ Pictures ------------------------------------------------


def _pictures(study: Study, judged: dict[int, Judgement]) -> None:
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 2.6 * len(judged)), layout="constrained")
    axes = figure.subplots(len(judged), 2)
    for (left, right), (number, judgement) in zip(axes, judged.items(), strict=True):
        left.imshow(np.clip(judgement.image, 0, 1))
        left.set_ylabel(f"scene {number}")
        shown = right.imshow(np.maximum(judgement.error, 1e-8), norm=LogNorm(1e-8, 1), cmap="magma")
        for index, (reason, color) in enumerate(zip(REASONS, ("cyan", "yellow", "lime", "red"), strict=True)):
            y, x = np.nonzero(judgement.reason == index)
            right.scatter(x, y, s=40, facecolors="none", edgecolors=color, label=reason)
        figure.colorbar(shown, ax=right, label="difference")
        for axis in (left, right):
            axis.set_xticks([])
            axis.set_yticks([])
    axes[0][1].legend(loc="upper right", fontsize="x-small")
    study.plot(
        "differences",
        "Where float32 and float64 differ",
        figure,
        "Left: our render. Right: the largest difference in a channel, on a logarithmic scale, most of it "
        "from paths cut where they no longer matter. Circles: pixels off by more than 1/255, by reason.",
    )
    study.plot(
        "distribution",
        "How many pixels differ by how much",
        _distribution(judged),
        "Share of pixels that differ from the float64 tracer by more than a value; dashed: 1/255.",
    )


def _distribution(judged: dict[int, Judgement]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axis = figure.subplots()
    for number, judgement in judged.items():
        error = np.sort(judgement.error.ravel())[::-1]
        share = np.arange(1, len(error) + 1) / len(error)
        axis.loglog(np.maximum(error, 1e-9), share, label=f"scene {number}")
    axis.axvline(STEP, color="gray", linestyle="--")
    axis.set_xlabel("difference")
    axis.set_ylabel("share of pixels that differ by more")
    axis.legend()
    return figure


# ----------------------------------------------- The original -----------------------------------------------


def _original(study: Study, quick: bool) -> None:
    folder = original_renders()
    if folder is None:
        study.text("The original's renders are not at hand (MRT_REFERENCE names their folder): not judged.")
        return
    rows = []
    for number in (0, 1, 3) if quick else (0, 1, 2, 3, 4):
        theirs = read_exr(folder / f"s{number}_none_aa1.exr").image
        height, width, _ = theirs.shape
        truth = reference_render(report_scene(number), width=width, height=height).image
        errors = [np.abs(image - truth) for image in (draw(number, (width, height)), theirs)]
        means = [float(e.mean()) for e in errors]
        shares = [float(np.mean(e.max(axis=-1) > STEP)) for e in errors]
        rows.append([number, *means, *(100 * s for s in shares)])
        study.at_most(f"scene {number}: our mean difference over the original's", means[0] / means[1], 1.0)
    study.table(
        "original",
        "The original's renders, judged by the same truth",
        ["scene", "mean, ours", "mean, original", "% off, ours", "% off, original"],
        rows,
        note="The truth has no self-intersection; most of what the original is off by is shadow acne near "
        "terminators.",
    )
