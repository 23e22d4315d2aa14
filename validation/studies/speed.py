"""How fast: against Mitsuba's own plugins, against other ways, and against smaller tasks.

Each row is a pair of runs that take turns, and the median of the ratios of their seconds. A pair says how the
two must agree, else it would be no comparison: in light, picture or length of code.

- ``mrt_whitted`` at ``max_depth`` 1, without clamp and cut-off, against ``direct`` with as many samples of
  lights as there are lights and none of the BSDF: with point lights and no sky, either sends a camera ray and
  one shadow ray for each light (ours none to lights behind the surface). ``direct`` adds up its samples of
  point lights where it should average them (Mitsuba's issue 1861): its picture is as many times too bright,
  which costs it no time.
- ``mrt_bsdf`` against ``roughconductor``, both with F = 1, which makes them the same function, under ``path``
  in the scene as Mitsuba's own plugins render it.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.validation import renders
from mrt_mitsuba.validation.renders import load
from mrt_mitsuba.validation.studies import roughconductor
from mrt_mitsuba.validation.study import Study, Values, operations, ratio

TITLE = "Speed: against Mitsuba's own plugins, other ways and smaller tasks"

Run = Callable[..., Any]


class Extent(NamedTuple):
    """How much to measure."""

    width: int
    height: int
    spp: int
    scenes: Sequence[int]
    repeats: int
    growth: int  # how many times larger the larger task is, and of how many objects crowds are


# direct light alone, as Mitsuba's ``direct`` has it
DIRECT: Values = {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
FULL = Extent(400, 300, 16, (0, 1, 2, 3, 4), 11, 1000)
QUICK = Extent(48, 36, 16, (0,), 1, 16)


class Pair(NamedTuple):
    """Two runs to compare; ``agree`` says how far they are from what they must share: at most ``limit``."""

    name: str
    ours: Callable[[], Run]  # loads a scene
    other: Callable[[], Run]
    goal: float  # of the ratio of seconds
    agree: Callable[[Run, Run], float]
    limit: float
    why: str


def run(study: Study, *, quick: bool) -> None:
    """Fill the study. A quick one holds that pairs agree, and says nothing of goals."""
    extent = QUICK if quick else FULL
    rows = []
    runtime.use(runtime.FAST)
    # scenes are loaded when the turn of their pair comes
    for pair in study.each("Speed", [pair for part in PARTS for pair in part(extent)]):
        time, off = compare(pair, extent.repeats)
        study.at_most(f"{pair.name}: difference", off, pair.limit, pair.why)
        low = time["low"]
        high = time["high"]
        if not quick:
            note = f"quartiles {low:.3g} to {high:.3g} of {extent.repeats} ratios"
            study.goal(pair.name, time["ratio"], pair.goal, note, interval=(low, high))
        rows.append({"what": pair.name, **time, "goal": pair.goal})
    title = f"Seconds, {extent.width}x{extent.height}, {extent.spp} samples a pixel"
    study.records("speed", title, rows, "Taken in turn: medians, and quartiles of the ratio.", first=True)


def compare(pair: Pair, repeats: int) -> tuple[dict[str, float], float]:
    """Time a pair in turns, and say by how much it disagrees."""
    ours = pair.ours()
    other = pair.other()
    off = pair.agree(ours, other)
    time = ratio(ours, other, repeats=repeats)
    del ours, other
    gc.collect()  # scenes that stay alive slow down the kernels of later ones
    return time, off


def _render(nodes: Values, **options: Any) -> Run:
    return partial(mrt.render, load(nodes), **renders.ONE_RAY | options)


def against_mitsuba(extent: Extent) -> Iterator[Pair]:
    """Yield this project's plugins against Mitsuba's own, in the report's scenes.

    Both sides go the same way: ``mi.render``, the independent sampler, a film with a box filter.
    """
    # random lights and paths leave half a percent at the size of the quick study
    same = 0.03, "the same light, else it would be no comparison; the rest is noise. One light less shows"

    def nodes(number: int, flavor: str = "stock") -> Values:
        return mrt.scene_dict(number, width=extent.width, height=extent.height, flavor=flavor)

    def other_light(ours: Run, other: Run, factor: float = 1) -> float:
        brightness = np.mean(ours(), dtype=np.float64)
        return abs(np.mean(other(), dtype=np.float64) / brightness / factor - 1)

    def by(integrator: Values, number: int, flavor: str) -> Run:
        """Direct light in the scene of a flavour, with Mitsuba's lights in place of ours."""
        own = nodes(number, flavor)
        del own["sky"]  # direct would sample it, mrt_whitted does not
        lights = {name: node for name, node in nodes(number).items() if name.startswith("light_")}
        return renders.by_mitsuba(own | lights, extent.spp, integrator)

    def of(bsdf: Callable[[float], Values], number: int) -> Run:
        """The scene of Mitsuba's plugins, with a material in place of ``roughplastic``."""
        stock = nodes(number)
        keep = "specular_reflectance"
        plastics = {n: m for n, m in stock.items() if isinstance(m, dict) and m["type"] == "roughplastic"}
        metals = {name: bsdf(node["alpha"]) | {keep: node[keep]} for name, node in plastics.items()}
        return renders.by_mitsuba(stock | metals, extent.spp)

    for n in extent.scenes:
        lights = sum(key.startswith("light_") for key in nodes(n))
        direct = {"type": "direct", "emitter_samples": lights, "bsdf_samples": 0}
        brighter = partial(other_light, factor=lights)
        for flavor, whose in (("mrt", "our"), ("stock", "Mitsuba's")):
            name = f"mrt_whitted / direct, scene {n}, {whose} shapes and materials"
            yield Pair(
                name, partial(by, DIRECT, n, flavor), partial(by, direct, n, flavor), 0.9, brighter, *same
            )
        sides = partial(of, roughconductor.ours, n), partial(of, roughconductor.theirs, n)
        yield Pair(f"mrt_bsdf / roughconductor, scene {n}", *sides, 1.05, other_light, *same)


def other_ways(extent: Extent) -> Iterator[Pair]:
    """Yield searches by our tree against Mitsuba's, and what a plan leaves out."""
    size: Values = {"width": extent.width, "height": extent.height}

    def crowd(kind: str) -> Run:
        return _render(renders.crowd(extent.growth, kind, **size), layers=["depth"])

    def other_hits(ours: Run, other: Run) -> float:
        depths = [np.nan_to_num(side().layers["depth.Z"], posinf=1e6) for side in (ours, other)]
        return float(np.mean(abs(depths[0] - depths[1]) > 1e-3 * depths[1]))

    def off(ours: Run, other: Run) -> float:
        return float(abs(ours().image - other().image).max())

    why = "grazing rays may go either way in float32. One object in a thousand lost shows"
    name = f"{extent.growth} spheres in our tree / in Mitsuba's"
    yield Pair(name, partial(crowd, "group"), partial(crowd, "sphere"), 4, other_hits, 2e-3, why)
    far = {"type": "mrt_cone", "apex": [1e3, 1, 0], "base_center": [1e3, 0, 0], "radius": 0.1}
    layers = {"layers": ["depth", "normal", "albedo", "direct", "reflection", "bounces"]}
    why = "half a step of an 8-bit picture; a lamp that is left out changes hundreds"
    nodes = mrt.scene_dict(0, **size)
    for what, change, options in (("cone code", {"far": far}, {}), ("layers", {}, layers)):
        name = f"scene 0 without {what} / with"
        whole = partial(left_out, nodes, change, options)
        yield Pair(name, partial(_render, nodes), whole, 1.05, off, 0.5 / 255, why)


def left_out(nodes: Values, change: Values, more: Values) -> Run:
    """A render of a scene with what its plan leaves out."""
    return _render(nodes | change, **more)


def growth(extent: Extent) -> Iterator[Pair]:
    """Yield tasks against smaller ones; the code must not grow with them."""
    times = extent.growth
    side = round(extent.growth**0.5)
    small = {"width": 40, "height": 30}

    def longer_code(ours: Run, other: Run) -> float:
        return sum(operations(ours)) / sum(operations(other)) - 1

    def pixels(n: int) -> Run:
        return _render(mrt.scene_dict(3, width=40 * n, height=30 * n))

    def lights(n: int) -> Run:
        return _render(renders.with_lights(16 * n, **small))

    def triangles(n: int) -> Run:
        return _render(renders.with_triangles(100 * n, **small), aa=4)

    why = "numbers are data, not code; a loop that is unrolled makes it as many times longer"
    for task, factor, goal in ((pixels, side, side * side), (lights, times, times), (triangles, times, 10)):
        name = f"{times} times the {task.__name__}"
        yield Pair(name, partial(task, factor), partial(task, 1), goal, longer_code, 0.05, why)


PARTS = (against_mitsuba, other_ways, growth)
