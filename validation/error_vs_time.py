"""Error against run time, for every setting that trades one for the other; and where the time goes."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from . import cost, knobs
from .image_tests import flip, rel_rmse
from .study import Study
from .warm import Warm, measure

TITLE = "Error against run time, and where the time goes"

COLUMNS = (
    "setting",
    "seconds",
    "spread",
    "compile",
    "camera rays",
    "RMSE",
    "relRMSE",
    "max",
    "FLIP",
    "front",
)
SAME = 0.02  # errors closer than this are the same: no reason to wait longer
ANSWERS = (0.03, 0.01, 0.003, 0.001)  # RMSE that the page finds settings for


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    settings: knobs.Extent
    sampling: Sequence[int]  # scenes
    whitted: Sequence[int]
    path: Sequence[int]
    lens: Sequence[int]
    cone: bool
    repeats: int
    cost: cost.Extent


FULL = Extent(
    knobs.Extent((320, 240), (1, 2, 4, 8), 32, (1, 4, 16, 64, 256), 1024),
    (0, 1, 2, 3, 4, 7, 9),
    (0, 1, 2, 3, 4, 7, 9),
    (0, 1, 2, 3, 4, 7, 9),
    (3, 4),
    True,
    5,
    cost.FULL,
)
QUICK = Extent(knobs.Extent((64, 48), (1, 4), 12, (1, 16), 64), (0,), (0,), (0,), (3,), True, 1, cost.QUICK)


@dataclass(frozen=True)
class Point:
    """One setting: what it costs and how far off it is."""

    name: str
    warm: Warm
    rmse: float
    rel_rmse: float
    largest: float
    flip: float

    @property
    def seconds(self) -> float:
        return self.warm.seconds


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    jobs: list[Callable[[], knobs.Trade]] = [
        *(
            partial(make, n, extent.settings)
            for make, numbers in (
                (knobs.sampling, extent.sampling),
                (knobs.whitted, extent.whitted),
                (knobs.path, extent.path),
                (knobs.lens, extent.lens),
            )
            for n in numbers
        ),
        *([partial(knobs.cone, extent.settings)] if extent.cone else []),
    ]
    answers = []
    with study.stage("Error against time", len(jobs)) as advance:
        for make in jobs:
            trade = make()
            points, own_error = _measure(trade, extent.repeats)
            _report(study, trade, points, own_error)
            if trade.name == "sampling":
                answers += _answers(trade, points)
            del trade
            gc.collect()  # scenes that stay alive slow down the kernels of later ones
            advance(1)
    study.table(
        "settings",
        "Which settings for an error of x?",
        ("scene", "RMSE at most", "fastest setting", "its RMSE", "seconds"),
        answers,
        "Out of anti-aliasing modes, amounts and lattices; the error is that to a converged picture.",
    )
    cost.run(study, extent.cost)


def _measure(trade: knobs.Trade, repeats: int) -> tuple[list[Point], float]:
    """Every case of a trade, and the RMSE that the reference itself may have."""
    reference = trade.reference().image
    own = 0.0 if trade.check is trade.reference else _rmse(trade.check().image, reference)
    seen = None
    points = []
    for name, warm in measure(trade.cases, repeats=repeats).items():
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
            )
        )
    return points, own


def _rmse(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(image.astype(np.float64) - reference))))


def front(points: Sequence[Point]) -> list[Point]:
    """The settings that gain error over all faster ones, fastest first."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.rmse)):
        if not best or point.rmse < (1 - SAME) * best[-1].rmse:
            best.append(point)
    return best


# --------------------------------------------- What it says ---------------------------------------------


def _report(study: Study, trade: knobs.Trade, points: Sequence[Point], own_error: float) -> None:
    name = f"{trade.name}-{trade.scene}"
    ahead = front(points)
    rows = [
        (
            p.name,
            p.seconds,
            p.warm.spread,
            p.warm.result.timings.compile,
            p.warm.result.rays["primary"],
            p.rmse,
            p.rel_rmse,
            p.largest,
            p.flip,
            "yes" if p in ahead else "",
        )
        for p in points
    ]
    study.table(
        name,
        f"Scene {trade.scene}: {trade.title}",
        COLUMNS,
        rows,
        f"The reference's own error is about {own_error:.2g}. Seconds: median of warm runs, all settings in "
        f"turn.",
    )
    reading = _reading(trade, points, ahead, own_error)
    study.plot(name, f"Scene {trade.scene}: {trade.title}", _figure(points, ahead, own_error), reading)
    study.text(f"Scene {trade.scene}, {trade.title}: {reading}")
    _hold(study, trade, points, own_error)


def _reading(trade: knobs.Trade, points: Sequence[Point], ahead: Sequence[Point], own_error: float) -> str:
    """Two sentences that follow from the points."""
    fast, good = ahead[0], ahead[-1]
    first = (
        f"The fastest setting is {fast.name} ({1000 * fast.seconds:.3g} ms, RMSE {fast.rmse:.2g}), the one "
        f"of least error "
        f"{good.name} ({1000 * good.seconds:.3g} ms, {good.rmse:.2g})"
    )
    slope = _slope(ahead)
    first += (
        f"; between them the error falls with the time to the power {slope:.2g}."
        if slope is not None
        else "."
    )
    behind = [p for p in points if p not in ahead]
    if not behind:
        return f"{first} Every setting is on the front: each is right for some error."
    worst = max(behind, key=lambda p: _waste(p, ahead))
    waste = _waste(worst, ahead)
    return (
        f"{first} {len(behind)} of {len(points)} settings are beaten in both; the worst buy is {worst.name}, "
        f"{waste:.2g} times as long as a setting with no more error."
    )


def _slope(ahead: Sequence[Point]) -> float | None:
    """Exponent of the error over the time along the front; None where that says nothing."""
    usable = [p for p in ahead if p.rmse > 0]
    if len(usable) < 3 or usable[-1].seconds < 2 * usable[0].seconds:
        return None
    return float(np.polyfit(np.log([p.seconds for p in usable]), np.log([p.rmse for p in usable]), 1)[0])


def _waste(point: Point, ahead: Sequence[Point]) -> float:
    return max((point.seconds / p.seconds for p in ahead if p.rmse <= point.rmse), default=1.0)


def _answers(trade: knobs.Trade, points: Sequence[Point]) -> list[tuple[Any, ...]]:
    rows = []
    for limit in ANSWERS:
        good = [p for p in points if p.rmse <= limit]
        best = min(good, key=lambda p: p.seconds, default=None)
        rows.append(
            (trade.scene, limit, best.name, best.rmse, best.seconds)
            if best
            else (trade.scene, limit, "none of these", math.nan, math.nan)
        )
    return rows


def _figure(points: Sequence[Point], ahead: Sequence[Point], own_error: float) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    shown = [p for p in points if p.rmse > 0]
    for kind in dict.fromkeys(_kind(p.name) for p in shown):
        of_kind = [p for p in shown if _kind(p.name) == kind]
        axes.plot([p.seconds for p in of_kind], [p.rmse for p in of_kind], "o", markersize=5, label=kind)
    line = [p for p in ahead if p.rmse > 0]
    axes.plot(
        [p.seconds for p in line],
        [p.rmse for p in line],
        "-",
        color="0.3",
        linewidth=1,
        zorder=0,
        label="front",
    )
    for p in line:
        axes.annotate(p.name, (p.seconds, p.rmse), textcoords="offset points", xytext=(4, 4), fontsize=6)
    if own_error > 0:
        axes.axhline(own_error, color="0.6", linestyle=":", label="error of the reference")
    axes.set(xscale="log", yscale="log", xlabel="seconds, warm", ylabel="RMSE")
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


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
        amounts = sorted({int(p.name.split()[1][3:]) for p in points})
        least, most = (by_name[f"none aa={aa} centered"].rmse for aa in (amounts[0], amounts[-1]))
        # the error of a lattice at edges falls at least by the root of the samples
        study.at_most(
            f"{where}: RMSE at aa={amounts[-1]} / aa={amounts[0]}", most / least, 2 * amounts[0] / amounts[-1]
        )
        study.at_most(f"{where}: error of the reference / least error measured", own_error / most, 1)
    elif trade.name == "whitted":
        study.at_most(
            f"{where}: max error of the default cut-off",
            by_name[f"min_contribution={1 / 16:g}/255"].largest,
            0.5 / 255,
        )
        study.at_least(
            f"{where}: RMSE of one bounce less than none",
            by_name["max_depth=1"].rmse,
            by_name["max_depth=10"].rmse,
        )
    elif trade.name == "path":
        spp = sorted({int(p.name.split("=")[1]) for p in points if p.name.startswith("path")})
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
