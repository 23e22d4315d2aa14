"""Error against run time, for every setting that trades one for the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from mrt_mitsuba.validation.tools import knobs
from mrt_mitsuba.validation.tools.precision import Findings, Point
from mrt_mitsuba.validation.tools.precision_page import describe
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.work_precision import error_vs_time

TITLE = "Error against run time"

ANSWERS = (0.03, 0.01, 0.003, 0.001)  # RMSE that the page finds settings for
INVISIBLE = 0.5 / 255  # half a step of an 8-bit picture
# Scenes whose highlights are broad: elsewhere rare, very bright paths rule the mean square of every picture
TAME = (0, 7, 9)
PICTURES = ("path", "lens")  # trades whose cases look different in the same time


@dataclass(frozen=True)
class Extent:
    """How much to measure: scenes by the trade of ``knobs.TRADES``."""

    settings: knobs.Extent
    scenes: Mapping[str, Sequence[int]]
    repeats: int


SCENES = (0, 1, 2, 3, 4, 7, 9)
FULL = Extent(
    knobs.Extent((240, 180), (1, 2, 4, 8), 48, (1, 4, 16, 64), 2048),
    {"sampling": SCENES, "whitted": SCENES, "path": TAME, "lens": (3, 4)},
    5,
)
QUICK = Extent(
    knobs.Extent((64, 48), (1, 4), 24, (1, 16), 512),
    {"sampling": (0,), "whitted": (0,), "path": (0,), "lens": (3,)},
    1,
)


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    jobs = [(name, number) for name, numbers in extent.scenes.items() for number in numbers]
    samplings: dict[int, Findings] = {}
    for name, number in study.each("Error against time", jobs):
        trade = knobs.TRADES[name](number, extent.settings)
        found = error_vs_time(
            trade.scene,
            trade.cases,
            reference=trade.reference,
            repeats=extent.repeats,
            shared=trade.shared,
            strips=name in PICTURES and not quick,
        )
        where = f"scene {number}, {name}"
        describe(study, found, where, f"Scene {number}: {trade.title}", trade.truth)
        if not found.failed:
            HOLD[name](study, where, found)
        if name == "sampling":
            samplings[number] = found
        del trade, found  # the scenes with them
    if extent.repeats > 1:  # else a disturbance would decide
        _answer(study, samplings)


def fastest(points: Iterable[Point], error: float) -> Point | None:
    """Return the fastest case with an RMSE of at most so much."""
    return min((p for p in points if p.rmse <= error), key=lambda p: p.seconds, default=None)


def for_all(samplings: Sequence[Mapping[str, Point]], error: float) -> str:
    """Return the case that stays within an error in every scene in the least time of all together."""
    good = [name for name in samplings[0] if all(points[name].rmse <= error for points in samplings)]
    seconds = {name: sum(points[name].seconds for points in samplings) for name in good}
    best = min(seconds, key=seconds.__getitem__, default=None)
    return f"{best}: {1000 * seconds[best]:.3g} ms" if best else "none of these"


def _answer(study: Study, samplings: Mapping[int, Findings]) -> None:
    """Add which settings to take for which error: in each scene, and one that does for all of them."""
    rows = []
    for number, found in samplings.items():
        best = [fastest(found.points.values(), error) for error in ANSWERS]
        shown = (f"{p.name}: {1000 * p.seconds:.3g} ms" if p else "none of these" for p in best)
        rows.append([number, *shown])
    if len(samplings) > 1:
        every = [found.points for found in samplings.values()]
        rows.append(["all of these", *(for_all(every, error) for error in ANSWERS)])
    columns = ["scene", *(f"RMSE at most {error:g}" for error in ANSWERS)]
    note = "The fastest of all modes of anti-aliasing, amounts and lattices: aamode, aa, lattice."
    study.table("choose", "Which settings for an error of x?", columns, rows, note, first=True)


# ------------------- What must hold: facts that no load on the machine changes -------------------


def _rmse(found: Findings, name: str) -> float:
    return found.points[name].rmse


def _of_number(names: Iterable[str], pattern: str) -> list[str]:
    """Return the cases of a name with a number in it, "none aa={} centered", by that number."""
    before, after = pattern.split("{}")
    words = [n for n in names if n.startswith(before) and n.endswith(after)]
    return sorted(words, key=lambda n: float(n[len(before) : len(n) - len(after)]))


def _hold_reference(study: Study, where: str, found: Findings, least: float) -> None:
    what = f"{where}: error of the reference / least error it judges"
    why = "then it changes no error by more than an eighth, and the judge is better than the judged"
    study.at_most(what, found.reference_error / least, 0.5, why)


def _hold_sampling(study: Study, where: str, found: Findings) -> None:
    few, *_, many = _of_number(found.points, "none aa={} centered")
    amounts = [float(name.split()[1][3:]) for name in (few, many)]
    what = f"{where}: RMSE of {many} / {few}"
    why = "an edge of the lattice is known to 1 / aa; twice that: samples that do not help leave 1"
    study.at_most(what, _rmse(found, many) / _rmse(found, few), 2 * amounts[0] / amounts[1], why)
    _hold_reference(study, where, found, _rmse(found, many))


def _hold_whitted(study: Study, where: str, found: Findings) -> None:
    cut_off = f"min_contribution={255 * knobs.CUT_OFFS[1]:g}/255"
    what = f"{where}: largest error of the default cut-off"
    why = "half a step of 8 bits, as promised; a cut-off that is 16 times too large leaves more"
    study.at_most(what, found.points[cut_off].difference.largest, INVISIBLE, why)
    first, *_, last = knobs.DEPTHS
    what = f"{where}: RMSE of max_depth={first} - that of {last}"
    why = "seen is 6e-4 (scene 9) and above; a limit that has no effect leaves 0"
    study.at_least(what, _rmse(found, f"max_depth={first}") - _rmse(found, f"max_depth={last}"), 3e-4, why)


def _hold_path(study: Study, where: str, found: Findings) -> None:
    few, *_, many = _of_number(found.points, "path spp={}")
    spp = [float(name.split("=")[1]) for name in (few, many)]
    what = f"{where}: |RMSE of {many} / {few} / theory - 1|"
    why = "theory: 1 / √spp; seen is 0.02, and a variance wrong by a third leaves 0.15"
    study.at_most(what, abs(_rmse(found, many) / _rmse(found, few) / (spp[0] / spp[1]) ** 0.5 - 1), 0.15, why)
    _hold_reference(study, where, found, _rmse(found, many))


def _hold_lens(study: Study, where: str, found: Findings) -> None:
    ratio = _rmse(found, "filter corrected") / _rmse(found, "filter report")
    study.at_most(f"{where}: RMSE of corrected / report", ratio, 1, "the corrected filter is no worse")


HOLD = {"sampling": _hold_sampling, "whitted": _hold_whitted, "path": _hold_path, "lens": _hold_lens}
