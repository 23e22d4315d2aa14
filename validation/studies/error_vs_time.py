"""Error against run time, for every setting that trades one for the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.study import Study, Values
from mrt_mitsuba.validation.work_precision import Findings, describe, error_vs_time

TITLE = "Error against run time"

BOX = "Cornell box"
SCENES = (0, 1, 2, 3, 4, 7, 9, BOX)
# Scenes of broad highlights: elsewhere rare, very bright paths dominate every mean square of ``path``
CALM = (0, 7, 9)

Number = int | str  # of a scene of the report, or ``BOX``


@dataclass(frozen=True)
class Cost:
    """Amount of work of the study; in full by default."""

    size: tuple[int, int] = (400, 300)  #: of pictures, pixels
    path_size: tuple[int, int] = (240, 180)  #: of those that paths make
    amounts: tuple[int, ...] = (1, 2, 4, 8)  #: of ``aa``
    most: int = 48  #: ``aa`` of the reference
    counts: tuple[int, ...] = (4, 16, 64)  #: of rays a pixel, with each of Mitsuba's samplers
    path_spp: int = 2048  #: of the reference by paths
    repeats: int = 5
    rounds: tuple[int, ...] = (8, 16, 64)  #: rays a pixel where they go to noise
    targets: tuple[str, ...] = ("4%", "2%", "1%")
    samplers: tuple[str, ...] = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")


QUICK = Cost(
    size=(40, 30),
    path_size=(40, 30),
    amounts=(1, 4),
    most=24,
    counts=(1, 16),
    path_spp=256,
    repeats=1,
    rounds=(),
    targets=(),
    samplers=("independent",),
)
DOCS = Cost(
    size=(300, 225),
    path_size=(160, 120),
    most=16,
    counts=(4, 16),
    path_spp=1024,
    repeats=3,
    rounds=(16,),
    targets=("8%", "4%"),
)


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    for number in study.each(TITLE, (0,) if quick else SCENES):
        for title, found in scene_findings(number, QUICK if quick else Cost()).items():
            describe(study, found, title, title)


def scene_findings(number: Number, cost: Cost) -> dict[str, Findings]:
    """Return the findings of a scene by title, against references by ``mrt_whitted`` and by ``path``.

    The Cornell box has ``path`` only; scenes in which rare bright paths dominate the error of ``path`` have
    ``mrt_whitted`` only.
    """
    if number == BOX:
        return {f"{BOX}, light paths": path(number, cost)}
    found = {f"Scene {number}, rays as in the report": sampling(number, cost)}
    if number in CALM:
        found[f"Scene {number}, light paths"] = path(number, cost)
    return found


def _scene(number: Number, size: tuple[int, int]) -> Values:
    """Return a scene of the report, or Mitsuba's Cornell box, as a dict."""
    width, height = size
    if isinstance(number, int):
        return mrt.scene_dict(number, width=width, height=height)
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": height, "height": height}
    return box


def _rounds(cost: Cost, **options: Any) -> dict[str, Values]:
    """Return adaptive renders, of a number of rays or to an error."""
    own = {"aa": None, "lattice": None, **options}
    cases = {f"adaptive, spp={spp}": {**own, "aamode": "noise", "spp": spp} for spp in cost.rounds}
    for target in cost.targets:
        case = {**own, "aamode": None, "target": target, "maxspp": 4 * max(cost.rounds)}
        cases[f"adaptive to a target, {target}"] = case
    return cases


MODES = {"none": "every pixel", "luma": "luma edges", "sobel": "Sobel edges", "geometry": "geometry edges"}


def sampling(number: Number, cost: Cost) -> Findings:
    """Measure numbers of samples on both lattices, modes of anti-aliasing, and adaptive sampling."""
    cases = _rounds(cost, focaldist=0)
    for aa in cost.amounts:
        shared = {"aa": aa, "focaldist": 0}
        cases[f"report's lattice, aa={aa}"] = {**shared, "aamode": "none", "lattice": "report"}
        for mode, title in MODES.items():
            if mode == "none" or aa > 1:
                cases[f"{title}, aa={aa}"] = {**shared, "aamode": mode, "lattice": "centered"}
    truth = {"aa": cost.most, "aamode": "none", "lattice": "centered", "focaldist": 0}
    return error_vs_time(_scene(number, cost.size), cases, reference=truth, repeats=cost.repeats)


def path(number: Number, cost: Cost) -> Findings:
    """Measure Mitsuba's path and direct with its samplers, and mrt_whitted, against a converged path."""
    nodes = _scene(number, cost.path_size)
    cases = _rounds(cost, integrator="path")
    for spp in cost.counts:
        for sampler in cost.samplers:
            sensor = nodes["sensor"] | {"sampler": {"type": sampler}}
            own = {"scene": nodes | {"sensor": sensor}, "integrator": "path"}
            cases[f"path, {sampler}, spp={spp}"] = own | {"spp": spp}
        if number != BOX:
            cases[f"direct, spp={spp}"] = {"integrator": "direct", "spp": spp}
    if number != BOX:
        cases["mrt_whitted"] = {}
    return error_vs_time(
        nodes,
        cases,
        reference={"integrator": "path", "spp": cost.path_spp},
        shared={"aa": 1, "aamode": "none"},
        repeats=cost.repeats,
    )
