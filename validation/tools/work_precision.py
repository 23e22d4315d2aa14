"""``error_vs_time``: what settings of ``render`` cost, how far off they are, and which of them are ahead.

Each case is repeated with other seeds; ``precision`` says what is made of the pictures.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError, UsageError
from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.rendering.result import Result
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.validation.tools import compare, precision_page, report, timing
from mrt_mitsuba.validation.tools.precision import RESOLVED, Findings, Options, Panel, Point, Strip

REFERENCE_SEEDS = (2**20 + 1, 2**20 + 2)  # far from those of the repeats
STEPS = (1, 2, 5)  # of the errors that the time is asked for, times powers of ten
MOST_ERRORS = 4


@dataclass(frozen=True)
class WorkPrecision(Findings):
    """The findings of ``error_vs_time``."""

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the page (``index.html``), ``summary.json``, CSV files and plots. Raises ``OutputError``."""
        report.save(folder, precision_page.study(self), title=precision_page.TITLE)

    def _repr_html_(self) -> str:
        return report.notebook(precision_page.study(self), title=precision_page.TITLE)


def error_vs_time(
    scene: Any,
    cases: Mapping[str, Options],
    *,
    reference: Any,
    repeats: int = 5,
    shared: Options | None = None,
    errors: Sequence[float] | None = None,
    strips: bool = True,
    progress: Progress | None = None,
) -> WorkPrecision:
    """Measure the error and the time of settings of ``render``.

    Args:
        scene: whatever ``render`` takes.
        cases: options of ``render`` by a name; names that differ in numbers only make one curve. A case may
            bring a ``scene`` of its own, of the same size.
        reference: options that give the truth. Where something is random, it is rendered as two halves of
            its ``spp``, with other seeds, and their difference is its own error; elsewhere a render with
            ``aa`` less by one is compared. Two sets of options, the better first: what they differ by bounds
            the error of the first. Or a picture: an array, the path of an EXR or a ``Result``, whose error is
            read from its layer "error".
        repeats: with other seeds, in turn, after a cold and a warm run of each case.
        shared: options of all cases and of the reference.
        errors: RMSEs to give the time for; by default round ones in the range that was measured.
        strips: render what each curve reaches in the same time.

    A case that fails is kept, with the reason. Raises ``UsageError`` for wrong arguments, and what
    ``render`` raises for the reference.
    """
    start = time.perf_counter()
    if not cases or repeats < 1:
        raise UsageError("error_vs_time needs at least one case and one repeat")
    taken = [name for name, options in {"shared": shared or {}, **cases}.items() if "seed" in options]
    if taken:
        raise UsageError(f"{taken[0]} sets a seed: repeats have seeds of their own; leave it out")
    runner = _Runner(scene, dict(shared or {}))
    halves, own_error = _reference(reference, runner)
    low = [e for e in errors or () if not e > RESOLVED * own_error]
    if low:
        raise UsageError(
            f"no claim can be made about an RMSE of {low[0]:g}: the reference's own error is "
            f"{own_error:.2g}, and only errors above twice that stand out; take a better reference"
        )
    points, failed = _measure(runner, cases, halves, own_error, repeats, progress or Progress())
    found = WorkPrecision(
        scene=runner.name,
        points=points,
        failed=failed,
        reference=(halves[0] + halves[1]) / 2,
        reference_error=own_error,
        repeats=repeats,
        errors=_round_errors(points.values(), own_error) if errors is None else list(errors),
    )
    shown = _strips(found, runner) if strips else []
    return replace(found, strips=shown, took=time.perf_counter() - start)


class _Runner:
    """Renders cases, each scene loaded once where it can be."""

    def __init__(self, scene: Any, shared: Options) -> None:
        self.scene, self.shared = scene, shared
        self.variant = runtime.use(shared.get("variant"))
        self._loaded: dict[int, tuple[Any, Any]] = {}  # by the id of a scene, which is kept with it
        self.name = ""

    def __call__(self, options: Options, seed: int) -> Result:
        given = {"scene": self.scene, "variant": self.variant, **self.shared, **options, "seed": seed}
        scene = given.pop("scene")
        can_be_loaded = isinstance(scene, dict) or str(scene).lower().endswith(".xml")
        if can_be_loaded and given["variant"] == self.variant and "params" not in given:
            if id(scene) not in self._loaded:
                self._loaded[id(scene)] = (scene, open_scene(scene).scene)
            scene = self._loaded[id(scene)][1]
        result = render(scene, **given)
        self.name = self.name or result.plan.scene
        return result


def _reference(reference: Any, runner: _Runner) -> tuple[tuple[np.ndarray, np.ndarray], float]:
    """Return two independent halves of the reference, or twice the same picture; and its own error."""
    if isinstance(reference, Mapping):
        spp = {"spp": int(reference["spp"]) // 2} if reference.get("spp", 1) > 1 else {}
        results = [runner({**reference, **spp}, seed) for seed in REFERENCE_SEEDS]
        first, second = map(_picture, results)
        if (first == second).all() and (aa := results[0].plan.lattice.aa) > 1:
            coarser = _picture(runner({**reference, "aa": aa - 1}, REFERENCE_SEEDS[0]))
            return (first, first), _rms(first - coarser)
        return (first, second), _rms(first - second) / 2
    if isinstance(reference, Sequence) and not isinstance(reference, str):
        first, second = (_picture(runner(r, s)) for r, s in zip(reference, REFERENCE_SEEDS, strict=True))
        return (first, first), _rms(first - second)
    picture = compare.read_layer(reference)
    known = 0.0 if picture.variance is None else float(picture.variance.mean()) ** 0.5
    values = picture.values.astype(np.float64)
    return (values, values), known


def _picture(result: Result) -> np.ndarray:
    image = np.asarray(result.image, np.float64)
    bad = ~np.isfinite(image).all(axis=-1)
    if bad.any():
        raise MrtError(f"{bad.sum()} pixels are NaN or infinite, the first at {tuple(np.argwhere(bad)[0])}")
    return image


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _seconds(result: Result) -> float:
    """Return seconds of a render but for loading its scene."""
    return result.timings.total - result.timings.load


def _measure(
    runner: _Runner,
    cases: Mapping[str, Options],
    halves: tuple[np.ndarray, np.ndarray],
    own_error: float,
    repeats: int,
    progress: Progress,
) -> tuple[dict[str, Point], dict[str, str]]:
    """Return the points of cases, and why others failed.

    Each runs cold, warm, and ``repeats`` times in turn, so that a load on the machine meets all alike.
    """
    cold: dict[str, Result] = {}
    failed: dict[str, str] = {}
    runs: dict[str, list[Result]] = {name: [] for name in cases}
    with progress.stage("Error against time", len(cases) * (repeats + 2)) as advance:
        for turn in range(-2, repeats):  # cold, warm, and those that count
            for name in cases:
                advance(1)
                if name in failed:
                    continue
                try:
                    if turn == -2:
                        timing.forget()
                    result = runner(cases[name], max(turn, 0))
                    if (image := _picture(result)).shape != halves[0].shape:
                        both = (f"{i.shape[1]}x{i.shape[0]}" for i in (image, halves[0]))
                        sizes = " and the reference ".join(both)
                        raise UsageError(f"it has {sizes} pixels: their sizes must be the same")
                except Exception as error:
                    failed[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
                    continue
                cold.setdefault(name, result)
                runs[name] += [result] if turn >= 0 else []
    points = {
        name: _point(name, cases[name], cold[name], runs[name], halves, own_error)
        for name in cases
        if name not in failed
    }
    return points, failed


def _point(
    name: str,
    options: Options,
    cold: Result,
    runs: Sequence[Result],
    halves: tuple[np.ndarray, np.ndarray],
    own_error: float,
) -> Point:
    """Return the figures of a case."""
    errors = [np.stack([r.image.ravel() - half.ravel() for r in runs]) for half in halves]
    gram = errors[0] @ errors[1].T / errors[0].shape[1]
    return Point(
        name=name,
        options=options,
        times=np.array([_seconds(r) for r in runs]),
        gram=(gram + gram.T) / 2,
        cold=_seconds(cold),
        compile=cold.timings.compile,
        rays=dict(runs[0].rays),
        image=runs[0].image,
        difference=compare.compare(runs[0].image, (halves[0] + halves[1]) / 2),
        reference_error=own_error,
    )


def _round_errors(points: Any, floor: float) -> list[float]:
    """Return some round errors between the largest and the least that are resolved."""
    found = [p.rmse for p in points if p.resolved and p.rmse > 1e-9]
    if not found:
        return []
    powers = range(int(np.floor(np.log10(min(found)))), int(np.ceil(np.log10(max(found)))) + 1)
    errors = [float(f"{step}e{power}") for power in powers for step in STEPS]
    inside = [e for e in errors if max(min(found), RESOLVED * floor) <= e <= max(found)]
    return inside[::-1][:MOST_ERRORS] or [float(f"{np.sqrt(min(found) * max(found)):.1e}")]


def _strips(found: WorkPrecision, runner: _Runner) -> list[Strip]:
    """Render what each curve of several cases reaches in times that all of them have.

    That is the case nearest to the time, with as many samples as fill it where they can be chosen.
    """
    curves = [points for points in found.families.values() if len(points) > 1]
    if len(curves) < 2:
        return []
    low = max(points[0].seconds for points in curves)
    high = min(points[-1].seconds for points in curves)
    strips: list[Strip] = []
    for seconds in [low, high] if high > 3 * low else [np.sqrt(low * high)]:
        panels: list[Panel] = []
        for points in curves:
            near = min(points, key=lambda p: abs(np.log(p.seconds / seconds)))
            panel = near.name, near.seconds, near.image
            spp = near.options.get("spp")
            wanted = max(1, round(spp * seconds / near.seconds)) if isinstance(spp, int) else spp
            if wanted != spp:
                with suppress(Exception):  # so many samples may not fit
                    result = runner({**near.options, "spp": wanted}, found.repeats)
                    panel = f"{near.family}, {wanted} spp", _seconds(result), result.image
            panels.append(panel)
        strips.append((seconds, panels))
    return strips
