"""Error against run time, for every setting that trades one for the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.work_precision import Findings, describe, error_vs_time

TITLE = "Error against run time"

MODES = ("none", "luma", "sobel", "geometry")
PROMISED = 1 / 16 / 255  # a sixteenth of a step of an 8-bit picture
CUT_OFFS = (0.0, PROMISED, 1 / 255, 4 / 255, 16 / 255)
DEPTHS = (1, 2, 3, 5, 10)

Options = dict[str, Any]


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    jobs = [(name, number) for name in TRADES for number in ((0,) if quick else SCENES[name])]
    for name, number in study.each("Error against time", jobs):
        trade, where = TRADES[name](number, quick), f"scene {number}, {name}"
        scene, cases, *titles, bounds = map(trade.pop, ("scene", "cases", "title", "truth", "bounds"))
        found = error_vs_time(scene, cases, repeats=1 if quick else 5, **trade)
        describe(study, found, where, f"Scene {number}: {titles[0]}", titles[1])
        for what, figure, most, why in () if found.failed else bounds:
            study.at_most(f"{where}: {what}", figure(found), most, why)
        del scene, found  # what holds them is freed with them


def rmse(found: Findings, case: str) -> float:
    """Return the error of a case."""
    return found.points[case].rmse


def judged(case: str) -> tuple[Any, ...]:
    """Return the bound of the reference's error, by the case of least error."""
    why = "then it changes no error by more than an eighth, and the judge is better than the judged"
    what = "error of the reference / least error it judges"
    return what, lambda found: found.reference_error / rmse(found, case), 0.5, why


def _scene(number: int, quick: bool, **options: Any) -> Options:
    """Return a scene of the report as a dict."""
    width, height = (40, 30) if quick else (240, 180)
    return mrt.scene_dict(number, width=width, height=height, **options)


# Each returns arguments of ``error_vs_time``; titles of settings and reference; "bounds": what, a figure of
# the findings, the most, why
def sampling(number: int, quick: bool) -> Options:
    """Return which pixels get how many samples, and where in the pixel."""
    # the reference: an even multiple of each, since odd ones share samples and with them errors
    amounts, most = ((1, 4), 24) if quick else ((1, 2, 4, 8), 48)
    least, greatest = amounts[0], amounts[-1]
    ends = (("none", least), ("none", greatest), ("sobel", greatest))
    few, many, edges = (f"{mode} aa={aa} centered" for mode, aa in ends)
    why = "an edge of the lattice is known to 1 / aa; twice that: samples that do not help leave 1"
    return {
        "scene": _scene(number, quick),
        "title": "anti-aliasing mode, aa and lattice",
        "truth": f"{most}x{most} centered samples a pixel; its error: that of three quarters of {most}",
        "cases": {
            f"{mode} aa={aa} {lattice}": {"aa": aa, "aamode": mode, "lattice": lattice}
            for lattice in ("report", "centered")
            for mode in MODES
            for aa in amounts
            if aa > 1 or mode == "none"
        },
        "reference": [{"aa": aa, "aamode": "none", "lattice": "centered"} for aa in (most, most * 3 // 4)],
        "bounds": [
            (f"RMSE of {many} / {few}", lambda f: rmse(f, many) / rmse(f, few), 2 * least / greatest, why),
            (f"RMSE of {edges} / {few}", lambda f: rmse(f, edges) / rmse(f, few), 2 * least / greatest, why),
            judged(many),
        ],
    }


def whitted(number: int, quick: bool) -> Options:
    """Return cut-off, bounce limit and form of the Fresnel factor, at the same samples."""

    def integrator(**parameters: Any) -> Options:
        return {"integrator": {"type": "mrt_whitted", **parameters}}

    cases = {f"min_contribution={255 * c:g}/255": integrator(min_contribution=c) for c in CUT_OFFS}
    default = list(cases)[1]
    cases |= {f"max_depth={depth}": integrator(max_depth=depth) for depth in DEPTHS}
    first, last = (f"max_depth={depth}" for depth in (DEPTHS[0], DEPTHS[-1]))
    what, why = "largest error of the default cut-off", "as promised; one 16 times too large leaves more"
    seen = "seen is 6e-4 (scene 9) and above; a limit that has no effect leaves 0"
    return {
        "scene": _scene(number, quick, fresnel="dielectric"),
        "title": "cut-off, bounce limit, Fresnel form",
        "truth": "no cut-off, max_depth=10, exact Fresnel, the same rays",
        "cases": {**cases, "fresnel=schlick": {"scene": _scene(number, quick)}},
        "reference": integrator(min_contribution=0.0),
        "shared": {"aa": 2, "aamode": "none", "lattice": "report"},
        "bounds": [
            (what, lambda f: f.points[default].difference.largest, PROMISED, why),
            (f"RMSE of {last} - that of {first}", lambda f: rmse(f, last) - rmse(f, first), -3e-4, seen),
        ],
    }


def path(number: int, quick: bool) -> Options:
    """Return Mitsuba's path and direct at rising spp, and mrt_whitted, against converged path."""
    counts, most = ((1, 16), 256) if quick else ((1, 4, 16, 64), 2048)
    few, many = (f"path spp={spp}" for spp in (counts[0], counts[-1]))
    gain = (counts[-1] / counts[0]) ** 0.5
    what = f"|RMSE of {many} / {few} / theory - 1|"
    why = "theory: 1 / √spp; seen is 0.02, and a variance wrong by a third leaves 0.15"
    return {
        "scene": _scene(number, quick),
        "title": "Whitted, direct and path at rising spp",
        "truth": f"path with spp={most}",
        "cases": {
            **{f"{k} spp={n}": {"integrator": k, "spp": n} for k in ("path", "direct") for n in counts},
            "mrt_whitted": {},
            "mrt_whitted, no clamp": {"integrator": {"type": "mrt_whitted", "clamp": False}},
        },
        "reference": {"integrator": "path", "spp": most},
        "shared": {"aa": 1, "aamode": "none"},
        "bounds": [
            (what, lambda f: abs(rmse(f, many) / rmse(f, few) * gain - 1), 0.15, why),
            judged(many),
        ],
    }


TRADES: dict[str, Callable[[int, bool], Options]] = {"sampling": sampling, "whitted": whitted, "path": path}
ALL = (0, 1, 2, 3, 4, 7, 9)
# Under path, scenes of broad highlights: elsewhere rare, very bright paths rule every mean square
SCENES = {"sampling": ALL, "whitted": ALL, "path": (0, 7, 9)}
