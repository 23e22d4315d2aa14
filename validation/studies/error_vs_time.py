"""Error against run time, for every setting that trades one for the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.tools.precision import Point, describe
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.work_precision import error_vs_time

TITLE = "Error against run time"

ANSWERS = (0.03, 0.01, 0.003, 0.001)  # RMSE that the page finds settings for
INVISIBLE = 0.5 / 255  # half a step of an 8-bit picture
MODES = ("none", "luma", "sobel", "geometry")
CUT_OFFS = (0.0, 1 / 16 / 255, 1 / 255, 4 / 255, 16 / 255)
DEPTHS = (1, 2, 3, 5, 10)

Options = dict[str, Any]
Points = Mapping[str, Point]


@dataclass(frozen=True)
class Extent:
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


@dataclass(frozen=True)
class Trade:
    """Settings of one kind on one scene, and the picture they strive for: arguments of ``error_vs_time``."""

    scene: Any
    title: str
    truth: str  # what the reference is
    cases: Mapping[str, Options]
    reference: Any
    shared: Options
    hold: Callable[[Study, str, Points], float | None]  # states bounds; returns the least error to be judged


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    jobs = [(name, number) for name, numbers in extent.scenes.items() for number in numbers]
    samplings: dict[Any, Points] = {}
    for name, number in study.each("Error against time", jobs):
        trade = TRADES[name](number, extent)
        options: Options = {"reference": trade.reference, "shared": trade.shared}
        found = error_vs_time(trade.scene, trade.cases, repeats=extent.repeats, **options)
        where = f"scene {number}, {name}"
        describe(study, found, where, f"Scene {number}: {trade.title}", trade.truth)
        least = None if found.failed else trade.hold(study, where, found.points)
        if least is not None:
            what = f"{where}: error of the reference / least error it judges"
            why = "then it changes no error by more than an eighth, and the judge is better than the judged"
            study.at_most(what, found.reference_error / least, 0.5, why)
        if name == "sampling":
            samplings[number] = found.points
        del trade, found  # the scenes with them
    if extent.repeats > 1:  # else a disturbance would decide
        choose(study, samplings)


def choose(study: Study, samplings: Mapping[Any, Points]) -> None:
    """Add which settings to take for which error: in each scene, and one that does for all of them."""
    rows = [[number, *(best([points], e) for e in ANSWERS)] for number, points in samplings.items()]
    if len(samplings) > 1:
        rows.append(["all of these", *(best([*samplings.values()], e) for e in ANSWERS)])
    columns = ["scene", *(f"RMSE at most {error:g}" for error in ANSWERS)]
    note = "The fastest of all modes of anti-aliasing, amounts and lattices: aamode, aa, lattice."
    study.table("choose", "Which settings for an error of x?", columns, rows, note, first=True)


def best(scenes: Sequence[Points], error: float) -> str:
    """Return the case that stays within an error in every scene in the least time of all together."""
    good = [name for name in scenes[0] if all(points[name].rmse <= error for points in scenes)]
    seconds = {name: sum(points[name].seconds for points in scenes) for name in good}
    fastest = min(seconds, key=seconds.__getitem__, default=None)
    return f"{fastest}: {1000 * seconds[fastest]:.3g} ms" if fastest else "none of these"


def sampling(number: int, extent: Extent) -> Trade:
    """Return which pixels get how many samples, and where in the pixel."""
    most = extent.reference_aa

    def hold(study: Study, where: str, points: Points) -> float:
        least, greatest = extent.amounts[0], extent.amounts[-1]
        few, many = (f"none aa={aa} centered" for aa in (least, greatest))
        what, ratio = f"{where}: RMSE of {many} / {few}", points[many].rmse / points[few].rmse
        why = "an edge of the lattice is known to 1 / aa; twice that: samples that do not help leave 1"
        study.at_most(what, ratio, 2 * least / greatest, why)
        return points[many].rmse

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
        hold,
    )


def whitted(number: int, extent: Extent) -> Trade:
    """Return cut-off, bounce limit and form of the Fresnel factor, at the same samples."""

    def integrator(**parameters: Any) -> Options:
        return {"integrator": {"type": "mrt_whitted", **parameters}}

    def hold(study: Study, where: str, points: Points) -> None:
        cut_off = points[f"min_contribution={255 * CUT_OFFS[1]:g}/255"]
        why = "half a step of 8 bits, as promised; a cut-off that is 16 times too large leaves more"
        what = f"{where}: largest error of the default cut-off"
        study.at_most(what, cut_off.difference.largest, INVISIBLE, why)
        first, last = (f"max_depth={depth}" for depth in (DEPTHS[0], DEPTHS[-1]))
        what = f"{where}: RMSE of {first} - that of {DEPTHS[-1]}"
        why = "seen is 6e-4 (scene 9) and above; a limit that has no effect leaves 0"
        study.at_least(what, points[first].rmse - points[last].rmse, 3e-4, why)

    cases = {f"min_contribution={255 * c:g}/255": integrator(min_contribution=c) for c in CUT_OFFS}
    cases |= {f"max_depth={depth}": integrator(max_depth=depth) for depth in DEPTHS}
    return Trade(
        extent.scene(number, fresnel="dielectric"),
        "cut-off, bounce limit, Fresnel form",
        "no cut-off, max_depth=10, exact Fresnel, the same rays",
        {**cases, "fresnel=schlick": {"scene": extent.scene(number)}},
        integrator(min_contribution=0.0),
        {"aa": 2, "aamode": "none", "lattice": "report"},
        hold,
    )


def path(number: int, extent: Extent) -> Trade:
    """Return Mitsuba's path and direct at rising spp, and mrt_whitted, against converged path."""

    def hold(study: Study, where: str, points: Points) -> float:
        least, greatest = extent.spp[0], extent.spp[-1]
        few, many = (f"path spp={spp}" for spp in (least, greatest))
        ratio = points[many].rmse / points[few].rmse * (greatest / least) ** 0.5
        why = "theory: 1 / √spp; seen is 0.02, and a variance wrong by a third leaves 0.15"
        study.at_most(f"{where}: |RMSE of {many} / {few} / theory - 1|", abs(ratio - 1), 0.15, why)
        return points[many].rmse

    cases: dict[str, Options] = {
        f"{kind} spp={spp}": {"integrator": kind, "spp": spp}
        for kind in ("path", "direct")
        for spp in extent.spp
    }
    cases["mrt_whitted"] = {}
    cases["mrt_whitted, no clamp"] = {"integrator": {"type": "mrt_whitted", "clamp": False}}
    return Trade(
        extent.scene(number),
        "Whitted, direct and path at rising spp",
        f"path with spp={extent.reference_spp}",
        cases,
        {"integrator": "path", "spp": extent.reference_spp},
        {"aa": 1, "aamode": "none"},
        hold,
    )


TRADES: dict[str, Callable[[int, Extent], Trade]] = {"sampling": sampling, "whitted": whitted, "path": path}
