"""Error against run time, for every setting that trades one for the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.work_precision import Point, describe, error_vs_time

TITLE = "Error against run time"

INVISIBLE = 0.5 / 255  # half a step of an 8-bit picture
MODES = ("none", "luma", "sobel", "geometry")
CUT_OFFS = (0.0, 1 / 16 / 255, 1 / 255, 4 / 255, 16 / 255)
DEPTHS = (1, 2, 3, 5, 10)

Options = dict[str, Any]
Points = Mapping[str, Point]


class Extent(NamedTuple):
    """How much to measure: how far the settings go, and scenes by trade."""

    size: tuple[int, int]
    amounts: Sequence[int]  # aa
    reference_aa: int  # an even multiple of each: at an odd one, lattices share samples and with them errors
    spp: Sequence[int]
    reference_spp: int
    scenes: Mapping[str, Sequence[int]]
    repeats: int

    def scene(self, number: int, **options: Any) -> Options:
        """Return a scene of the report as a dict, of the extent's size."""
        return mrt.scene_dict(number, width=self.size[0], height=self.size[1], **options)


ALL = (0, 1, 2, 3, 4, 7, 9)
# Under path, scenes of broad highlights: elsewhere rare, very bright paths rule every mean square
OF_TRADES = {"sampling": ALL, "whitted": ALL, "path": (0, 7, 9)}
FULL = Extent((240, 180), (1, 2, 4, 8), 48, (1, 4, 16, 64), 2048, OF_TRADES, 5)
QUICK = Extent((64, 48), (1, 4), 24, (1, 16), 512, dict.fromkeys(OF_TRADES, (0,)), 1)


class Trade(NamedTuple):
    """Settings of one kind on one scene, and the picture they strive for: arguments of ``error_vs_time``."""

    scene: Any
    title: str
    truth: str  # what the reference is
    cases: Mapping[str, Options]
    reference: Any
    shared: Options
    bounds: Sequence[tuple[str, Callable[[Points], float], float, str]]  # what, figure, the most, why
    judged: str = ""  # the case of least error, if the reference's own must be far below it


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    jobs = [(name, number) for name, numbers in extent.scenes.items() for number in numbers]
    for name, number in study.each("Error against time", jobs):
        trade, where = TRADES[name](number, extent), f"scene {number}, {name}"
        options: Options = {"reference": trade.reference, "shared": trade.shared}
        found = error_vs_time(trade.scene, trade.cases, repeats=extent.repeats, **options)
        describe(study, found, where, f"Scene {number}: {trade.title}", trade.truth)
        if not found.failed:
            for what, figure, most, why in trade.bounds:
                study.at_most(f"{where}: {what}", figure(found.points), most, why)
        if trade.judged and not found.failed:
            what = f"{where}: error of the reference / least error it judges"
            why = "then it changes no error by more than an eighth, and the judge is better than the judged"
            study.at_most(what, found.reference_error / found.points[trade.judged].rmse, 0.5, why)
        del trade, found  # the scenes with them


def sampling(number: int, extent: Extent) -> Trade:
    """Return which pixels get how many samples, and where in the pixel."""
    most, least, greatest = extent.reference_aa, extent.amounts[0], extent.amounts[-1]
    few, many = (f"none aa={aa} centered" for aa in (least, greatest))
    why = "an edge of the lattice is known to 1 / aa; twice that: samples that do not help leave 1"
    what = f"RMSE of {many} / {few}"
    return Trade(
        extent.scene(number),
        "anti-aliasing mode, aa and lattice",
        f"{most}x{most} centered samples in every pixel; its error: what three quarters of {most} change",
        {
            f"{mode} aa={aa} {lattice}": {"aa": aa, "aamode": mode, "lattice": lattice}
            for lattice in ("report", "centered")
            for mode in MODES
            for aa in extent.amounts
            if aa > 1 or mode == "none"
        },
        [{"aa": aa, "aamode": "none", "lattice": "centered"} for aa in (most, most * 3 // 4)],
        {},
        [(what, lambda points: points[many].rmse / points[few].rmse, 2 * least / greatest, why)],
        many,
    )


def whitted(number: int, extent: Extent) -> Trade:
    """Return cut-off, bounce limit and form of the Fresnel factor, at the same samples."""

    def integrator(**parameters: Any) -> Options:
        return {"integrator": {"type": "mrt_whitted", **parameters}}

    cases = {f"min_contribution={255 * c:g}/255": integrator(min_contribution=c) for c in CUT_OFFS}
    default = list(cases)[1]
    cases |= {f"max_depth={depth}": integrator(max_depth=depth) for depth in DEPTHS}
    first, last = (f"max_depth={depth}" for depth in (DEPTHS[0], DEPTHS[-1]))
    why = "half a step of 8 bits, as promised; a cut-off that is 16 times too large leaves more"
    seen = "seen is 6e-4 (scene 9) and above; a limit that has no effect leaves 0"
    return Trade(
        extent.scene(number, fresnel="dielectric"),
        "cut-off, bounce limit, Fresnel form",
        "no cut-off, max_depth=10, exact Fresnel, the same rays",
        {**cases, "fresnel=schlick": {"scene": extent.scene(number)}},
        integrator(min_contribution=0.0),
        {"aa": 2, "aamode": "none", "lattice": "report"},
        [
            ("largest error of the default cut-off", lambda p: p[default].difference.largest, INVISIBLE, why),
            (f"RMSE of {last} - that of {first}", lambda p: p[last].rmse - p[first].rmse, -3e-4, seen),
        ],
    )


def path(number: int, extent: Extent) -> Trade:
    """Return Mitsuba's path and direct at rising spp, and mrt_whitted, against converged path."""
    least, greatest = extent.spp[0], extent.spp[-1]
    few, many = (f"path spp={spp}" for spp in (least, greatest))

    def off_theory(points: Points) -> float:
        return abs(points[many].rmse / points[few].rmse * (greatest / least) ** 0.5 - 1)

    cases: dict[str, Options] = {
        f"{kind} spp={spp}": {"integrator": kind, "spp": spp}
        for kind in ("path", "direct")
        for spp in extent.spp
    }
    cases["mrt_whitted"] = {}
    cases["mrt_whitted, no clamp"] = {"integrator": {"type": "mrt_whitted", "clamp": False}}
    why = "theory: 1 / √spp; seen is 0.02, and a variance wrong by a third leaves 0.15"
    return Trade(
        extent.scene(number),
        "Whitted, direct and path at rising spp",
        f"path with spp={extent.reference_spp}",
        cases,
        {"integrator": "path", "spp": extent.reference_spp},
        {"aa": 1, "aamode": "none"},
        [(f"|RMSE of {many} / {few} / theory - 1|", off_theory, 0.15, why)],
        many,
    )


TRADES: dict[str, Callable[[int, Extent], Trade]] = {"sampling": sampling, "whitted": whitted, "path": path}
