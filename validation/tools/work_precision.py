"""``error_vs_time``: what settings of ``render`` cost, how far off they are, and which of them are ahead.

Each case is repeated with other seeds; ``precision`` says what is made of the pictures.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError, UsageError
from mrt_mitsuba.rendering.api import render
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.rendering.result import Result
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.validation.tools import timing
from mrt_mitsuba.validation.tools.compare import compare, read_layer
from mrt_mitsuba.validation.tools.precision import RESOLVED, TITLE, Findings, Point

REFERENCE_SEEDS = (2**20 + 1, 2**20 + 2)  # far from those of the repeats
STEPS = (1, 2, 5)  # of the errors that the time is asked for, times powers of ten
MOST_ERRORS = 4

Options = Mapping[str, Any]
Run = Callable[[Options, int], Result]  # a render with options and a seed
Halves = tuple[np.ndarray, np.ndarray]  # two independent pictures, or the same one twice


def error_vs_time(
    scene: Any,
    cases: Mapping[str, Options],
    *,
    reference: Any,
    repeats: int = 5,
    shared: Options | None = None,
    errors: Sequence[float] | None = None,
    progress: Progress | None = None,
) -> Findings:
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

    A case that fails is kept, with the reason. Raises ``UsageError`` for wrong arguments, and what
    ``render`` raises for the reference.
    """
    start = time.perf_counter()
    if not cases or repeats < 1:
        raise UsageError("error_vs_time needs at least one case and one repeat")
    taken = [name for name, options in {"shared": shared or {}, **cases}.items() if "seed" in options]
    if taken:
        raise UsageError(f"{taken[0]} sets a seed: repeats have seeds of their own; leave it out")
    run = _runner(scene, dict(shared or {}))
    halves, own_error = _reference(reference, run)
    low = [e for e in errors or () if not e > RESOLVED * own_error]
    if low:
        raise UsageError(
            f"no claim can be made about an RMSE of {low[0]:g}: the reference's own error is "
            f"{own_error:.2g}, and only errors above twice that stand out; take a better reference"
        )
    runs, failed = _measure(run, cases, halves[0].shape, repeats, progress or Progress())
    points = {name: _point(name, found, halves, own_error) for name, found in runs.items()}
    return Findings(
        scene=next((found[0].plan.scene for found in runs.values()), "scene"),
        points=points,
        failed=failed,
        reference=(halves[0] + halves[1]) / 2,
        reference_error=own_error,
        repeats=repeats,
        errors=_round_errors(points.values(), own_error) if errors is None else list(errors),
        took=time.perf_counter() - start,
    )


def _runner(scene: Any, shared: Options) -> Run:
    """Return what renders cases, each scene loaded once where it can be."""
    variant = runtime.use(shared.get("variant"))
    loaded: dict[int, tuple[Any, Any]] = {}  # by the id of a scene, which is kept with it

    def run(options: Options, seed: int) -> Result:
        given = {"scene": scene, "variant": variant, **shared, **options, "seed": seed}
        one = given.pop("scene")
        can_be_loaded = isinstance(one, dict) or str(one).lower().endswith(".xml")
        if can_be_loaded and given["variant"] == variant and "params" not in given:
            if id(one) not in loaded:
                loaded[id(one)] = (one, open_scene(one).scene)
            one = loaded[id(one)][1]
        return render(one, **given)

    return run


def _reference(reference: Any, run: Run) -> tuple[Halves, float]:
    """Return two independent halves of the reference, or twice the same picture; and its own error."""
    if isinstance(reference, Mapping):
        spp = {"spp": int(reference["spp"]) // 2} if reference.get("spp", 1) > 1 else {}
        results = [run({**reference, **spp}, seed) for seed in REFERENCE_SEEDS]
        first, second = map(_picture, results)
        if (first == second).all() and (aa := results[0].plan.lattice.aa) > 1:
            coarser = _picture(run({**reference, "aa": aa - 1}, REFERENCE_SEEDS[0]))
            return (first, first), compare(first, coarser).rmse
        return (first, second), compare(first, second).rmse / 2
    if isinstance(reference, Sequence) and not isinstance(reference, str):
        first, second = (_picture(run(r, s)) for r, s in zip(reference, REFERENCE_SEEDS, strict=True))
        return (first, first), compare(first, second).rmse
    picture = read_layer(reference)
    known = 0.0 if picture.variance is None else float(picture.variance.mean()) ** 0.5
    values = picture.values.astype(np.float64)
    return (values, values), known


def _picture(result: Result) -> np.ndarray:
    image = np.asarray(result.image, np.float64)
    bad = np.argwhere(~np.isfinite(image).all(axis=-1))
    if len(bad):
        raise MrtError(f"{len(bad)} pixels are NaN or infinite, the first at {tuple(bad[0].tolist())}")
    return image


def _measure(
    run: Run, cases: Mapping[str, Options], shape: tuple[int, ...], repeats: int, progress: Progress
) -> tuple[dict[str, list[Result]], dict[str, str]]:
    """Return the results of cases, the cold run first, and why others failed.

    Each runs cold, warm, and ``repeats`` times in turn, so that a load on the machine meets all alike.
    """
    failed: dict[str, str] = {}
    runs: dict[str, list[Result]] = {name: [] for name in cases}
    with progress.stage(TITLE, len(cases) * (repeats + 2)) as advance:
        for turn in range(-2, repeats):  # cold, warm, and those that count
            for name in cases:
                advance(1)
                if name in failed:
                    continue
                try:
                    if turn == -2:
                        timing.forget()
                    result = run(cases[name], max(turn, 0))
                    if (image := _picture(result)).shape != shape:
                        both = (f"{i[1]}x{i[0]}" for i in (image.shape, shape))
                        sizes = " and the reference ".join(both)
                        raise UsageError(f"it has {sizes} pixels: their sizes must be the same")
                except Exception as error:
                    failed[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"
                    continue
                runs[name] += [result] if turn != -1 else []
    return {name: found for name, found in runs.items() if name not in failed}, failed


def _point(name: str, runs: Sequence[Result], halves: Halves, own_error: float) -> Point:
    """Return the figures of a case; its first run was cold."""
    images = [result.image for result in runs[1:]]
    errors = [np.stack([(image - half).ravel() for image in images]) for half in halves]
    gram = errors[0] @ errors[1].T / errors[0].shape[1]
    seconds = np.array([result.timings.total - result.timings.load for result in runs])
    return Point(
        name=name,
        times=seconds[1:],
        gram=(gram + gram.T) / 2,
        cold=float(seconds[0]),
        compile=runs[0].timings.compile,
        rays=dict(runs[1].rays),
        image=images[0],
        difference=compare(images[0], (halves[0] + halves[1]) / 2),
        reference_error=own_error,
    )


def _round_errors(points: Iterable[Point], floor: float) -> list[float]:
    """Return some round errors between the largest and the least that are resolved."""
    found = [p.rmse for p in points if p.resolved and p.rmse > 1e-9]
    if not found:
        return []
    powers = range(int(np.floor(np.log10(min(found)))), int(np.ceil(np.log10(max(found)))) + 1)
    errors = [float(f"{step}e{power}") for power in powers for step in STEPS]
    inside = [e for e in errors if max(min(found), RESOLVED * floor) <= e <= max(found)]
    return inside[::-1][:MOST_ERRORS] or [float(f"{np.sqrt(min(found) * max(found)):.1e}")]
