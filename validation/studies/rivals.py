"""The speed of this project's plugins against that of Mitsuba's own on the same scenes.

Both sides of a comparison go the same way: ``mi.render``, the independent sampler, the same samples a pixel,
the same film with a box filter. They take turns, and what is told is the median of the ratios of neighbours.

- ``mrt_whitted`` at ``max_depth`` 1, without clamp and cut-off, against ``direct`` with as many samples of
  lights as there are lights and none of the BSDF: with point lights and no sky, either sends a camera ray and
  one shadow ray for each light (ours none to lights behind the surface). ``direct`` adds up its samples of
  point lights where it should average them (Mitsuba's issue 1861): its picture is as many times too bright,
  which costs it no time.
- ``mrt_bsdf`` against ``roughconductor``, both with F = 1, which makes them the same function, and against
  ``roughplastic``, its nearest relative, under ``path`` in the scene as Mitsuba's own plugins render it.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.studies import roughconductor
from mrt_mitsuba.validation.tools.kernels import seconds_in_kernels
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import Ratio, ratio

TITLE = "Speed against Mitsuba's own plugins"

DIRECT_GOAL = 0.9
PATH_GOAL = 1.05

# Of means of pictures: random lights and paths leave half a percent at the size of the quick study; with one
# light, or one light's shadow, too few or too many it would be tens of percent
SAME_MEAN = 0.03


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    size: tuple[int, int]
    spp: int
    scenes: Sequence[int]
    repeats: int


FULL = Extent((400, 300), 16, (0, 1, 2, 3, 4), 11)
QUICK = Extent((96, 72), 16, (0,), 3)


@dataclass(frozen=True)
class Pair:
    """Two renders to compare: how they are told in a table, what is aimed at, and whether they are alike."""

    ours: str
    theirs: str
    scene: str
    goal: float | None
    brightness: float | None  # of their picture over ours, but for noise; None: other materials, no telling
    render_ours: Callable[[], np.ndarray]
    render_theirs: Callable[[], np.ndarray]

    @property
    def name(self) -> str:
        return f"{self.ours} / {self.theirs}, scene {self.scene}"


@dataclass(frozen=True)
class Finding:
    """What comparing a pair gave."""

    pair: Pair
    time: Ratio
    kernels: float  # ratio of the seconds in kernels
    means: float  # of the pictures, theirs over ours

    def as_dict(self) -> dict[str, Any]:
        """As the benchmark's file has it."""
        goal = {} if self.pair.goal is None else {"goal": self.pair.goal}
        return {"kernels": self.kernels, **asdict(self.time), **goal}


def run(study: Study, *, quick: bool) -> None:
    """Fill the study."""
    extent = QUICK if quick else FULL
    width, height = extent.size
    with study.stage("Against Mitsuba's plugins", PAIRS * len(extent.scenes)) as advance:
        found = []
        for one in compare(extent):
            found.append(one)
            advance(1)
    for one in found:
        if one.pair.goal is not None:
            study.goal(
                one.pair.name,
                one.time.median,
                one.pair.goal,
                f"quartiles {one.time.low:.3g} and {one.time.high:.3g} of {extent.repeats} ratios",
                interval=(one.time.low, one.time.high),
            )
        if one.pair.brightness is not None:
            off = abs(one.means / one.pair.brightness - 1)
            note = "the same light, else it would be no comparison; the rest is noise"
            study.at_most(f"{one.pair.name}: difference of the means", off, SAME_MEAN, note)
    study.table(
        "rivals",
        f"Seconds of ours over theirs, {width}x{height}, {extent.spp} samples a pixel",
        (
            "ours",
            "theirs",
            "scene",
            "ours, s",
            "theirs, s",
            "ratio",
            "quartiles",
            "in kernels",
            "goal",
            "met",
        ),
        [_row(one) for one in found],
        "Taken in turn, medians of ratios. In kernels: the ratio without what Python and Dr.Jit do before "
        "kernels start, which does not grow with the picture.",
        first=True,
    )
    for sentence in _sentences(found):
        study.text(sentence)


def _row(one: Finding) -> tuple[Any, ...]:
    pair, time = one.pair, one.time
    goal = ("none", "") if pair.goal is None else (pair.goal, "yes" if time.median <= pair.goal else "no")
    quartiles = f"{time.low:.3g} to {time.high:.3g}"
    seconds = (time.seconds, time.other_seconds)
    return (pair.ours, pair.theirs, pair.scene, *seconds, time.median, quartiles, one.kernels, *goal)


def _sentences(found: Sequence[Finding]) -> Iterator[str]:
    """What follows from the figures, a sentence for each kind of comparison."""
    for kind in dict.fromkeys((one.pair.ours, one.pair.theirs) for one in found):
        of_kind = [one for one in found if (one.pair.ours, one.pair.theirs) == kind]
        low, high = (pick(of_kind, key=lambda one: one.time.median) for pick in (min, max))
        text = (
            f"{kind[0]} takes {low.time.median:.2g} (scene {low.pair.scene}) to {high.time.median:.2g} "
            f"(scene {high.pair.scene}) times as long as {kind[1]}, its kernels alone "
            f"{min(one.kernels for one in of_kind):.2g} to {max(one.kernels for one in of_kind):.2g} times"
        )
        goal = of_kind[0].pair.goal
        if goal is not None:
            met = sum(one.time.median <= goal for one in of_kind)
            text += f"; the goal, {goal:g}, is met in {met} of {len(of_kind)} scenes"
        yield f"{text}."


def compare(extent: Extent) -> Iterator[Finding]:
    """Compare all pairs, one scene after the other."""
    mrt.register()
    for number in extent.scenes:
        for make in (_direct, _conductor, _plastic):
            for pair in make(number, extent):
                yield _compare(pair, extent.repeats)
                del pair
                gc.collect()  # scenes that stay alive slow down the kernels of later ones


PAIRS = 4  # of one scene


def _compare(pair: Pair, repeats: int) -> Finding:
    time = ratio(pair.render_ours, pair.render_theirs, repeats=repeats)
    kernels = [seconds_in_kernels(run) for run in (pair.render_ours, pair.render_theirs)]
    means = [float(run().mean(dtype=np.float64)) for run in (pair.render_ours, pair.render_theirs)]
    return Finding(pair, time, kernels[0] / kernels[1], means[1] / means[0])


def _direct(number: int, extent: Extent) -> Iterator[Pair]:
    """Direct light in the scene of our plugins but for its lights, and in that of Mitsuba's own."""
    for flavor, what in (("mrt", "our shapes and materials"), ("stock", "Mitsuba's shapes and materials")):
        stock, nodes = _nodes(number, extent, "stock"), _nodes(number, extent, flavor)
        lights = [name for name in nodes if name.startswith("light_")]
        nodes |= {name: stock[name] for name in lights}
        del nodes["sky"]  # direct would sample it, mrt_whitted does not
        scene = load(nodes)
        ours = {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
        theirs = {"type": "direct", "emitter_samples": len(lights), "bsdf_samples": 0}
        renders = (_render(scene, extent, integrator) for integrator in (ours, theirs))
        yield Pair("mrt_whitted", "direct", f"{number}, {what}", DIRECT_GOAL, len(lights), *renders)


def _conductor(number: int, extent: Extent) -> Iterator[Pair]:
    """Every material a conductor with F = 1."""
    scenes = []
    for conductor in (roughconductor.ours, roughconductor.theirs):
        nodes = _nodes(number, extent, "stock")
        for name, node in nodes.items():
            if _is(node, "roughplastic"):
                colour = {"specular_reflectance": node["specular_reflectance"]}
                nodes[name] = conductor(node["alpha"]) | colour
        scenes.append(load(nodes))
    renders = (_render(scene, extent) for scene in scenes)
    yield Pair("mrt_bsdf", "roughconductor", str(number), PATH_GOAL, 1, *renders)


def _plastic(number: int, extent: Extent) -> Iterator[Pair]:
    """The scene's materials as they are, and as Mitsuba's nearest."""
    mine, stock = _nodes(number, extent, "mrt", fresnel="dielectric"), _nodes(number, extent, "stock")
    alphas = {name: node["alpha"] for name, node in stock.items() if _is(node, "roughplastic")}
    materials = {name: mine[name] | {"alpha": alpha} for name, alpha in alphas.items()}
    renders = (_render(load(nodes), extent) for nodes in (stock | materials, stock))
    yield Pair("mrt_bsdf", "roughplastic", str(number), PATH_GOAL, None, *renders)


def _is(node: Any, kind: str) -> bool:
    return isinstance(node, dict) and node["type"] == kind


def _nodes(number: int, extent: Extent, flavor: str, **options: Any) -> dict[str, Any]:
    width, height = extent.size
    return mrt.scene_dict(number, width=width, height=height, flavor=flavor, **options)


def _render(scene: Any, extent: Extent, integrator: Any = None) -> Callable[[], np.ndarray]:
    """Mitsuba's own way to a picture [H, W, 3]; by default with the scene's integrator."""
    import mitsuba as mi

    chosen = scene.integrator() if integrator is None else mi.load_dict(integrator)
    return partial(_picture, scene, chosen, extent.spp)


def _picture(scene: Any, integrator: Any, spp: int) -> np.ndarray:
    import mitsuba as mi

    return np.array(mi.render(scene, integrator=integrator, spp=spp))
