"""What the points of a trade between error and time say: two sentences that follow from them alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mrt_mitsuba.validation.tools.knobs import CUT_OFFS, DEPTHS, MODES
from mrt_mitsuba.validation.tools.points import INVISIBLE, SAME, Point, amounts, fastest

DEFAULT = "sobel aa=4 report"
DEFAULT_CUT_OFF = f"min_contribution={255 * CUT_OFFS[1]:g}/255"
NO_CUT_OFF = "min_contribution=0/255"


def reading(trade: str, points: Sequence[Point]) -> str:
    """Two sentences about the points of a trade of this name."""
    return _READINGS[trade](points, {p.name: p for p in points})


_ByName = dict[str, Point]


def _sampling(points: Sequence[Point], by_name: _ByName) -> str:
    default, most = by_name[DEFAULT], amounts(points, "aa=")[-1]
    better = fastest(points, (1 + SAME) * default.rmse)
    first = f"The default, {default}"
    if better is None or better.seconds >= (1 - SAME) * default.seconds:
        first += ", has less error than every faster setting."
    else:
        first += f", is matched by {better}, in {better.seconds / default.seconds:.0%} of its time."
    report, centered = (by_name[f"none aa={most} {lattice}"] for lattice in ("report", "centered"))
    if report.rmse > 1.5 * centered.rmse:
        second = (
            f"The report's lattice shifts the picture by up to half a pixel and keeps an RMSE of "
            f"{report.rmse:.2g} at aa={most}, where the centered one has {centered.rmse:.2g}"
        )
    else:
        second = f"Both lattices come to the same error at aa={most}, {centered.rmse:.2g}"
    detectors = [by_name[f"{mode} aa={most} centered"] for mode in MODES if mode != "none"]
    nearest = min(detectors, key=lambda p: p.rmse)
    missed = nearest.rmse / centered.rmse
    return (
        f"{first} {second}; of the adaptive modes {nearest.name.split()[0]} comes nearest to it, with "
        f"{missed:.2g} times the error in {nearest.seconds / centered.seconds:.0%} of the time."
    )


def _whitted(points: Sequence[Point], by_name: _ByName) -> str:
    default, whole = by_name[DEFAULT_CUT_OFF], by_name[NO_CUT_OFF]
    limits = [by_name[f"max_depth={depth}"] for depth in DEPTHS]
    enough = next((p for p in limits if p.rmse <= INVISIBLE), limits[-1])
    schlick = by_name["fresnel=schlick"]
    visible = (
        "not to be seen in 8 bits" if schlick.largest <= INVISIBLE else f"up to {schlick.largest:.2g} off"
    )
    return (
        f"The default cut-off takes {default.seconds / whole.seconds:.0%} of the time of none, for an RMSE "
        f"of {default.rmse:.2g}; {enough.name} is the least limit whose RMSE is below half a step of 8 bits, "
        f"and takes {enough.seconds / limits[-1].seconds:.0%} of the time of {limits[-1].name}. "
        f"Schlick's Fresnel term takes {schlick.seconds / default.seconds:.0%} of the time of the exact one "
        f"and is {visible}, RMSE {schlick.rmse:.2g}."
    )


def _path(points: Sequence[Point], by_name: _ByName) -> str:
    whitted, spp = by_name["mrt_whitted"], amounts(points, "spp=")
    unclamped = by_name["mrt_whitted, no clamp"]
    paths = [by_name[f"path spp={n}"] for n in spp]
    equal = fastest(paths, whitted.rmse)
    first = (
        f"mrt_whitted leaves an RMSE of {whitted.rmse:.2g} in {1000 * whitted.seconds:.3g} ms, "
        f"{unclamped.rmse:.2g} without its clamp; "
    )
    if equal is None:
        first += f"no path up to spp={spp[-1]} has less."
    else:
        times = equal.seconds / whitted.seconds
        first += f"{equal.name} has less, and takes {times:.2g} times as long."
    direct = by_name[f"direct spp={spp[-1]}"]
    second = (
        f"The error of path falls with its samples to the power {_slope(spp, [p.rmse for p in paths]):.2f}"
    )
    if direct.rmse > paths[-1].rmse:
        return f"{first} {second}; direct, without bounces, is left with {direct.rmse:.2g}."
    return f"{first} {second}; direct does no worse, with {direct.rmse:.2g}."


def _lens(points: Sequence[Point], by_name: _ByName) -> str:
    report, corrected = by_name["filter report"], by_name["filter corrected"]
    lenses = [p for p in points if p.name.startswith("thinlens")]
    equal = fastest(lenses, corrected.rmse)
    first = (
        f"The corrected filter is {corrected.rmse:.2g} off the lens in {1000 * corrected.seconds:.3g} ms, "
        f"the report's {report.rmse:.2g} in {1000 * report.seconds:.3g} ms."
    )
    if equal is None:
        return f"{first} No lens up to {lenses[-1].name} has less error than the corrected filter."
    return (
        f"{first} {equal.name} is the fastest lens with less error than the corrected filter, and takes "
        f"{equal.seconds / corrected.seconds:.2g} times as long."
    )


def _cone(points: Sequence[Point], by_name: _ByName) -> str:
    exact = by_name["analytic"]
    meshes = [p for p in points if p.name.endswith("segments")]
    enough = next((p for p in meshes if p.rmse <= INVISIBLE), None)
    first = (
        f"No mesh has an RMSE below half a step of 8 bits; the best is {meshes[-1]}."
        if enough is None
        else f"The coarsest mesh with an RMSE below half a step of 8 bits is {enough}."
    )
    other = enough or meshes[-1]
    return (
        f"{first} The analytic cone has no error and takes {exact.seconds / other.seconds:.2g} times as long "
        f"as {other.name}."
    )


def _slope(x: Sequence[float], y: Sequence[float]) -> float:
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


_READINGS: dict[str, Callable[[Sequence[Point], _ByName], str]] = {
    "sampling": _sampling,
    "whitted": _whitted,
    "path": _path,
    "lens": _lens,
    "cone": _cone,
}
