"""Error against run time, for every setting that trades one for the other; and where the time goes."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from mrt_mitsuba.validation.tools import kernels, knobs
from mrt_mitsuba.validation.tools.image_tests import flip, rel_rmse
from mrt_mitsuba.validation.tools.points import Point, amounts, fastest, front
from mrt_mitsuba.validation.tools.readings import DEFAULT_CUT_OFF, reading
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import measure

TITLE = "Error against run time"

COLUMNS = (
    "setting",
    "seconds",
    "spread",
    "compile",
    "camera rays",
    "mirror rays",
    "shadow rays",
    "RMSE",
    "relRMSE",
    "max",
    "FLIP",
    "front",
)
ANSWERS = (0.03, 0.01, 0.003, 0.001)  # RMSE that the page finds settings for
ENOUGH_SECONDS = 3.0  # seconds of a setting's warm renders, after which three of them do


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    settings: knobs.Extent
    sampling: Sequence[int]  # scenes
    whitted: Sequence[int]
    path: Sequence[int]
    lens: Sequence[int]  # those that have a distance in focus
    cone: bool
    repeats: int


SCENES = (0, 1, 2, 3, 4, 7, 9)
FULL = Extent(
    knobs.Extent((240, 180), (1, 2, 4, 8), 32, (1, 4, 16, 64, 256), 1024),
    SCENES,
    SCENES,
    SCENES,
    (3, 4),
    True,
    5,
)
QUICK = Extent(knobs.Extent((64, 48), (1, 4), 12, (1, 16), 256), (0,), (0,), (0,), (3,), True, 1)


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    settings = extent.settings
    jobs: list[Callable[[], knobs.Trade]] = [
        *(
            partial(make, n, settings)
            for make, numbers in (
                (knobs.sampling, extent.sampling),
                (knobs.whitted, extent.whitted),
                (knobs.path, extent.path),
                (knobs.lens, extent.lens),
            )
            for n in numbers
        ),
        *([partial(knobs.cone, settings)] if extent.cone else []),
    ]
    study.text(
        f"Pictures of {settings.size[0]}x{settings.size[1]}; errors are those to a converged picture, whose "
        f"own error is estimated; seconds are medians of warm renders, all settings in turn, with (slowest - "
        f"fastest) / median as their spread. Settings that no other beats in both make the Pareto front."
    )
    samplings: dict[str, list[Point]] = {}
    with study.stage("Error against time", len(jobs)) as advance:
        for make in jobs:
            trade = make()
            points, own_error = _measure(trade, extent.repeats)
            _report(study, trade, points, own_error)
            if trade.name == "sampling":
                samplings[trade.scene] = points
            del trade
            gc.collect()  # scenes that stay alive slow down the kernels of later ones
            advance(1)
    _answer(study, samplings)


def _measure(trade: knobs.Trade, repeats: int) -> tuple[list[Point], float]:
    """Every case of a trade, and the RMSE that the reference itself may have."""
    reference = trade.reference().image
    own = 0.0 if trade.check is trade.reference else _rmse(trade.check().image, reference)
    seen = None
    points = []
    kernels.forget()
    for name, warm in measure(trade.cases, repeats=repeats, enough=ENOUGH_SECONDS).items():
        image = warm.result.image
        perceived = flip(
            np.maximum(reference, 0), np.maximum(image, 0), exposures=seen.exposures if seen else None
        )
        seen = seen or perceived
        points.append(
            Point(
                name,
                warm,
                _rmse(image, reference),
                rel_rmse(image, reference),
                float(np.abs(image - reference).max()),
                perceived.mean,
                _rays(trade.cases[name], warm.result),
            )
        )
    return points, own


def _rays(render: knobs.Render, result: Any) -> dict[str, int]:
    """Rays by kind; of integrators other than ours only those of the camera can be told."""
    return dict((render(count_rays=True) if result.plan.integrator == "mrt_whitted" else result).rays)


def _rmse(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(image.astype(np.float64) - reference))))


# --------------------------------------------- What it says ---------------------------------------------


def _report(study: Study, trade: knobs.Trade, points: Sequence[Point], own_error: float) -> None:
    name = f"{trade.name}-{trade.scene}"
    ahead = front(points)
    known = (
        f"Its own error is about {own_error:.2g}."
        if own_error
        else "It has no error of its own: the same rays, and nothing left out."
    )
    study.table(
        name,
        f"Scene {trade.scene}: {trade.title}",
        COLUMNS,
        [_row(p, p in ahead) for p in points],
        f"Reference: {trade.truth}. {known} Compile: kernels that no setting above needed.",
    )
    figure = _figure(points, ahead, own_error)
    study.plot(name, f"Scene {trade.scene}: {trade.title}", figure, reading(trade.name, points))
    _hold(study, trade, points, own_error)


def _row(p: Point, ahead: bool) -> tuple[Any, ...]:
    rays = (p.rays.get(kind, "–") for kind in ("primary", "mirror", "shadow"))
    compiled = p.warm.result.timings.compile
    errors = (p.rmse, p.rel_rmse, p.largest, p.flip)
    return (p.name, p.seconds, p.warm.spread, compiled, *rays, *errors, "yes" if ahead else "")


def _answer(study: Study, samplings: dict[str, list[Point]]) -> None:
    """Which settings for which error: of each scene, and one that does for all of them."""
    if not samplings:
        return
    choices = {
        scene: {limit: fastest(points, limit) for limit in ANSWERS} for scene, points in samplings.items()
    }
    columns = ["scene", *(f"RMSE at most {limit:g}" for limit in ANSWERS)]
    rows = [[scene, *map(_choice, found.values())] for scene, found in choices.items()]
    if len(samplings) > 1:
        rows.append(["all of these", *(_for_all(samplings, limit) for limit in ANSWERS)])
    study.table(
        "choose",
        "Which settings for an error of x?",
        columns,
        rows,
        "The fastest of all modes of anti-aliasing, amounts and lattices: aamode, aa, lattice.",
        first=True,
    )
    study.table(
        "settings",
        "The fastest settings, by error",
        ("scene", "RMSE at most", "fastest setting", "its RMSE", "seconds"),
        [
            (scene, limit, p.name, p.rmse, p.seconds) if p else (scene, limit, "none of these", "", "")
            for scene, found in choices.items()
            for limit, p in found.items()
        ],
    )


def _choice(p: Point | None) -> str:
    return f"{p.name}: {1000 * p.seconds:.3g} ms" if p else "none of these"


def _for_all(samplings: dict[str, list[Point]], limit: float) -> str:
    """The setting that stays within the limit in every scene and takes the least time for all together."""
    tables = [{p.name: p for p in points} for points in samplings.values()]
    good = [name for name in tables[0] if all(table[name].rmse <= limit for table in tables)]
    seconds = {name: sum(table[name].seconds for table in tables) for name in good}
    best = min(seconds, key=seconds.__getitem__, default=None)
    return f"{best}: {1000 * seconds[best]:.3g} ms" if best else "none of these"


def _figure(points: Sequence[Point], ahead: Sequence[Point], own_error: float) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5), layout="constrained")
    axes = figure.subplots()
    errors = [p.rmse for p in points if p.rmse > 0]
    bottom = 0.5 * min([*errors, own_error or np.inf])  # where settings without error are drawn

    def draw(chosen: Sequence[Point], **style: Any) -> None:
        axes.plot([1000 * p.seconds for p in chosen], [max(p.rmse, bottom) for p in chosen], **style)

    for kind in dict.fromkeys(_kind(p.name) for p in points):
        marker = "s" if kind.endswith("centered") else "o"
        draw([p for p in points if _kind(p.name) == kind], linestyle="none", marker=marker, label=kind)
    draw(ahead, color="0.3", linewidth=1, marker="o", markersize=11, fillstyle="none", label="Pareto front")
    for number, p in enumerate(ahead):
        place = (1000 * p.seconds, max(p.rmse, bottom))
        above_or_below = (7, 6 if number % 2 == 0 else -12)
        axes.annotate(p.name, place, textcoords="offset points", xytext=above_or_below, fontsize=8)
    if own_error > 0:
        axes.axhline(own_error, color="0.6", linestyle=":", label="error of the reference")
    if len(errors) < len(points):
        axes.axhline(bottom, color="0.9", linewidth=8, zorder=0, label="no error")
    axes.set(xscale="log", yscale="log", xlabel="milliseconds, warm", ylabel="RMSE")
    axes.margins(x=0.15, y=0.1)
    _label_between_decades(axes.xaxis)
    figure.legend(fontsize=8, ncols=3, loc="outside lower center")
    return figure


def _label_between_decades(axis: Any) -> None:
    """A logarithmic axis of a decade or two, labelled 10, 20, 50, 100."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(plain)
    axis.set_minor_locator(LogLocator(subs=(2, 5)))
    axis.set_minor_formatter(plain)


def _kind(name: str) -> str:
    """Settings that differ in an amount only are drawn alike."""
    return " ".join(
        word.split("=")[0]
        for word in name.split()
        if not word.isdigit() and not word.startswith(("aa=", "spp="))
    )


# -------------------------------------------- What must hold --------------------------------------------


def _hold(study: Study, trade: knobs.Trade, points: Sequence[Point], own_error: float) -> None:
    """Facts that no load on the machine changes: more work, less error."""
    by_name = {p.name: p for p in points}
    where = f"scene {trade.scene}, {trade.name}"
    if trade.name == "sampling":
        aas = amounts(points, "aa=")
        least, most = (by_name[f"none aa={aa} centered"].rmse for aa in (aas[0], aas[-1]))
        # the error of a lattice at edges falls at least by the root of the samples
        study.at_most(f"{where}: RMSE at aa={aas[-1]} / aa={aas[0]}", most / least, 2 * aas[0] / aas[-1])
        study.at_most(f"{where}: error of the reference / least error measured", own_error / most, 1)
    elif trade.name == "whitted":
        study.at_most(
            f"{where}: max error of the default cut-off",
            by_name[DEFAULT_CUT_OFF].largest,
            0.5 / 255,
        )
        study.at_least(
            f"{where}: RMSE of one bounce less than none",
            by_name["max_depth=1"].rmse,
            by_name["max_depth=10"].rmse,
        )
    elif trade.name == "path":
        spp = amounts(points, "spp=")
        ratio = by_name[f"path spp={spp[-1]}"].rmse / by_name[f"path spp={spp[0]}"].rmse
        # 1/sqrt(n) where noise is tame; scene 4's small highlights make rare, very bright pixels, in the
        # reference as well, and leave 0.6
        study.at_most(f"{where}: RMSE of path at spp={spp[-1]} / spp={spp[0]}", ratio, 0.8)
    elif trade.name == "lens":
        ratio = by_name["filter corrected"].rmse / by_name["filter report"].rmse
        study.at_most(f"{where}: RMSE of corrected / report", ratio, 1)
    elif trade.name == "cone":
        few, many = (by_name[f"{n} segments"].rmse for n in (knobs.SEGMENTS[0], knobs.SEGMENTS[-1]))
        study.at_most(f"{where}: RMSE of most segments / fewest", many / few, 0.2)
