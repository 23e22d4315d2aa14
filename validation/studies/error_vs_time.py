"""Error against run time, for every setting that trades one for the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

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


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    jobs = [(name, number) for name in TRADES for number in ((0,) if quick else SCENES[name])]
    for name, number in study.each("Error against time", jobs):
        trade, where = TRADES[name](number, quick), f"scene {number}, {name}"
        scene, cases, title, truth = (trade.pop(key) for key in ("scene", "cases", "title", "truth"))
        bounds, judged = trade.pop("bounds"), trade.pop("judged", None)
        found = error_vs_time(scene, cases, repeats=1 if quick else 5, **trade)
        describe(study, found, where, f"Scene {number}: {title}", truth)
        if not found.failed:
            if judged:
                what, least = "error of the reference / least error it judges", found.points[judged].rmse
                why = (
                    "then it changes no error by more than an eighth, and the judge is better than the judged"
                )
                bounds.append((what, lambda _, f=found, e=least: f.reference_error / e, 0.5, why))
            for what, figure, most, why in bounds:
                study.at_most(f"{where}: {what}", figure(found.points), most, why)
        del scene, found  # what holds them is freed with them


def _scene(number: int, quick: bool, **options: Any) -> Options:
    """Return a scene of the report as a dict."""
    width, height = (40, 30) if quick else (240, 180)
    return mrt.scene_dict(number, width=width, height=height, **options)


# Each returns arguments of ``error_vs_time``; titles of the settings and of the reference; "bounds": what, a
# figure of the points by case, the most, why; and "judged", the case of least error, by a better reference
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
            (f"RMSE of {case} / {few}", lambda p, c=case: p[c].rmse / p[few].rmse, 2 * least / greatest, why)
            for case in (many, edges)
        ],
        "judged": many,
    }


def whitted(number: int, quick: bool) -> Options:
    """Return cut-off, bounce limit and form of the Fresnel factor, at the same samples."""

    def integrator(**parameters: Any) -> Options:
        return {"integrator": {"type": "mrt_whitted", **parameters}}

    cases = {f"min_contribution={255 * c:g}/255": integrator(min_contribution=c) for c in CUT_OFFS}
    default = list(cases)[1]
    cases |= {f"max_depth={depth}": integrator(max_depth=depth) for depth in DEPTHS}
    first, last = (f"max_depth={depth}" for depth in (DEPTHS[0], DEPTHS[-1]))
    why = "half a step of 8 bits, as promised; a cut-off that is 16 times too large leaves more"
    seen = "seen is 6e-4 (scene 9) and above; a limit that has no effect leaves 0"
    return {
        "scene": _scene(number, quick, fresnel="dielectric"),
        "title": "cut-off, bounce limit, Fresnel form",
        "truth": "no cut-off, max_depth=10, exact Fresnel, the same rays",
        "cases": {**cases, "fresnel=schlick": {"scene": _scene(number, quick)}},
        "reference": integrator(min_contribution=0.0),
        "shared": {"aa": 2, "aamode": "none", "lattice": "report"},
        "bounds": [
            ("largest error of the default cut-off", lambda p: p[default].difference.largest, INVISIBLE, why),
            (f"RMSE of {last} - that of {first}", lambda p: p[last].rmse - p[first].rmse, -3e-4, seen),
        ],
    }


def path(number: int, quick: bool) -> Options:
    """Return Mitsuba's path and direct at rising spp, and mrt_whitted, against converged path."""
    counts, most = ((1, 16), 256) if quick else ((1, 4, 16, 64), 2048)
    few, many = (f"path spp={spp}" for spp in (counts[0], counts[-1]))

    def off_theory(points: Points) -> float:
        return abs(points[many].rmse / points[few].rmse * (counts[-1] / counts[0]) ** 0.5 - 1)

    kinds = ("path", "direct")
    cases: dict[str, Options] = {
        f"{kind} spp={spp}": {"integrator": kind, "spp": spp} for kind in kinds for spp in counts
    }
    cases["mrt_whitted"] = {}
    cases["mrt_whitted, no clamp"] = {"integrator": {"type": "mrt_whitted", "clamp": False}}
    why = "theory: 1 / √spp; seen is 0.02, and a variance wrong by a third leaves 0.15"
    return {
        "scene": _scene(number, quick),
        "title": "Whitted, direct and path at rising spp",
        "truth": f"path with spp={most}",
        "cases": cases,
        "reference": {"integrator": "path", "spp": most},
        "shared": {"aa": 1, "aamode": "none"},
        "bounds": [(f"|RMSE of {many} / {few} / theory - 1|", off_theory, 0.15, why)],
        "judged": many,
    }


TRADES: dict[str, Callable[[int, bool], Options]] = {"sampling": sampling, "whitted": whitted, "path": path}
ALL = (0, 1, 2, 3, 4, 7, 9)
# Under path, scenes of broad highlights: elsewhere rare, very bright paths rule every mean square
SCENES = {"sampling": ALL, "whitted": ALL, "path": (0, 7, 9)}
