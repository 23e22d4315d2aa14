"""The speed of this project's plugins against that of Mitsuba's own on the same scenes.

Both sides of a comparison go the same way: ``mi.render``, the independent sampler, the same samples a pixel,
the same film with a box filter. They take turns, and the result is the median of the ratios of neighbours.

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
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.studies import roughconductor
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import Ratio, ratio

TITLE = "Speed against Mitsuba's own plugins"

DIRECT_GOAL = 0.9
PATH_GOAL = 1.05

# For means of pictures: random lights and paths leave half a percent at the size of the quick study; with one
# light, or one light's shadow, too few or too many it would be tens of percent
SAME_MEAN = 0.03


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    size: tuple[int, int]
    spp: int
    scenes: Sequence[int]
    repeats: int

    def nodes(self, number: int, flavor: str, **options: Any) -> dict[str, Any]:
        """Return a scene of the report as a dict, of the extent's size."""
        return mrt.scene_dict(number, width=self.size[0], height=self.size[1], flavor=flavor, **options)

    def render(self, nodes: Any, integrator: Any = None) -> Callable[[], np.ndarray]:
        """Return Mitsuba's own way to a picture [H, W, 3]; by default with the scene's integrator."""
        scene = load(nodes)
        chosen = scene.integrator() if integrator is None else mi.load_dict(integrator)
        return lambda: np.array(mi.render(scene, integrator=chosen, spp=self.spp))


FULL = Extent((400, 300), 16, (0, 1, 2, 3, 4), 11)
QUICK = Extent((96, 72), 16, (0,), 3)


@dataclass(frozen=True)
class Pair:
    """Two renders to compare: their names in a table, what is aimed at, and whether they are alike."""

    ours: str
    theirs: str
    scene: str
    goal: float
    brightness: float | None  # of their picture over ours, but for noise; None: other materials
    render_ours: Callable[[], np.ndarray]
    render_theirs: Callable[[], np.ndarray]

    @property
    def name(self) -> str:
        return f"{self.ours} / {self.theirs}, scene {self.scene}"


@dataclass(frozen=True)
class Finding:
    """The result of comparing a pair."""

    pair: Pair
    time: Ratio
    means: float  # of the pictures, theirs over ours

    def row(self) -> dict[str, Any]:
        """Return what the study's table has."""
        pair, time = self.pair, self.time
        names = {"ours": pair.ours, "theirs": pair.theirs, "scene": pair.scene}
        seconds = {"ours, s": time.seconds, "theirs, s": time.other_seconds, "ratio": time.median}
        return {**names, **seconds, "quartiles": f"{time.low:.3g} to {time.high:.3g}", "goal": pair.goal}

    def as_dict(self) -> dict[str, Any]:
        """Return what the benchmark's file has."""
        return {**asdict(self.time), "goal": self.pair.goal}


def run(study: Study, *, quick: bool) -> None:
    """Fill the study. A quick one holds the pictures alike, and says nothing of goals."""
    extent = QUICK if quick else FULL
    found = []
    with study.stage("Against Mitsuba's plugins", PAIRS * len(extent.scenes)) as advance:
        for one in compare(extent):
            found.append(one)
            advance(1)
    for one in found:
        time, name = one.time, one.pair.name
        if not quick:
            note = f"quartiles {time.low:.3g} and {time.high:.3g} of {extent.repeats} ratios"
            study.goal(name, time.median, one.pair.goal, note, interval=(time.low, time.high))
        if one.pair.brightness is not None:
            off = abs(one.means / one.pair.brightness - 1)
            note = "the same light, else it would be no comparison; the rest is noise. One light less shows"
            study.at_most(f"{name}: difference of the means", off, SAME_MEAN, note)
    title = f"Seconds of ours over theirs, {extent.size[0]}x{extent.size[1]}, {extent.spp} samples a pixel"
    rows = [one.row() for one in found]
    study.records("rivals", title, rows, "Taken in turn, medians of ratios.", first=True)


def compare(extent: Extent) -> Iterator[Finding]:
    """Compare all pairs, one scene after the other."""
    mrt.register()
    for number in extent.scenes:
        for make in (direct, conductor, plastic):
            for pair in make(number, extent):
                yield compare_pair(pair, extent.repeats)
                del pair
                gc.collect()  # scenes that stay alive slow down the kernels of later ones


PAIRS = 4  # of one scene


def compare_pair(pair: Pair, repeats: int) -> Finding:
    """Time a pair in turn, and take the means of its pictures."""
    sides = (pair.render_ours, pair.render_theirs)
    time = ratio(*sides, repeats=repeats)
    means = [float(run().mean(dtype=np.float64)) for run in sides]
    return Finding(pair, time, means[1] / means[0])


def direct(number: int, extent: Extent) -> Iterator[Pair]:
    """Yield direct light in the scene of our plugins but for its lights, and in that of Mitsuba's own."""
    for flavor, what in (("mrt", "our shapes and materials"), ("stock", "Mitsuba's shapes and materials")):
        stock, nodes = extent.nodes(number, "stock"), extent.nodes(number, flavor)
        lights = [name for name in nodes if name.startswith("light_")]
        nodes |= {name: stock[name] for name in lights}
        del nodes["sky"]  # direct would sample it, mrt_whitted does not
        ours = {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
        theirs = {"type": "direct", "emitter_samples": len(lights), "bsdf_samples": 0}
        renders = (extent.render(nodes, integrator) for integrator in (ours, theirs))
        yield Pair("mrt_whitted", "direct", f"{number}, {what}", DIRECT_GOAL, len(lights), *renders)


def conductor(number: int, extent: Extent) -> Iterator[Pair]:
    """Yield the scene with every material a conductor with F = 1."""
    renders = []
    for material in (roughconductor.ours, roughconductor.theirs):
        nodes = extent.nodes(number, "stock")
        for name in _plastics(nodes):
            colour = {"specular_reflectance": nodes[name]["specular_reflectance"]}
            nodes[name] = material(nodes[name]["alpha"]) | colour
        renders.append(extent.render(nodes))
    yield Pair("mrt_bsdf", "roughconductor", str(number), PATH_GOAL, 1, *renders)


def plastic(number: int, extent: Extent) -> Iterator[Pair]:
    """Yield the scene's materials as they are, and as Mitsuba's nearest."""
    mine, stock = extent.nodes(number, "mrt", fresnel="dielectric"), extent.nodes(number, "stock")
    materials = {name: mine[name] | {"alpha": stock[name]["alpha"]} for name in _plastics(stock)}
    renders = (extent.render(nodes) for nodes in (stock | materials, stock))
    yield Pair("mrt_bsdf", "roughplastic", str(number), PATH_GOAL, None, *renders)


def _plastics(nodes: dict[str, Any]) -> list[str]:
    return [n for n, node in nodes.items() if isinstance(node, dict) and node["type"] == "roughplastic"]
