"""How fast: against Mitsuba's own plugins, against other ways, and against smaller tasks.

Each row is a pair of runs that take turns, and the median of the ratios of their seconds. A pair says how the
two must agree, else it would be no comparison: in light, picture or length of code.

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
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.cores import usable_cores
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation.studies import roughconductor
from mrt_mitsuba.validation.tools import renders
from mrt_mitsuba.validation.tools.renders import load
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.timing import Ratio, operations, ratio

TITLE = "Speed: against Mitsuba's own plugins, other ways and smaller tasks"

# Means of pictures: random lights and paths leave half a percent at the size of the quick study; with one
# light, or one light's shadow, too few or too many it would be tens of percent
SAME_MEAN = 0.03
MOST_CODE = 1.05  # numbers are data, not code; a loop that is unrolled makes it as many times longer
INVISIBLE = 0.5 / 255  # half a step of an 8-bit picture, which is what the cut-off promises
OTHER_HITS = 2e-3  # share of pixels at outlines, where float32 goes either way

Run = Callable[..., Any]
PLAIN: dict[str, Any] = renders.ONE_RAY


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    size: tuple[int, int]
    spp: int
    scenes: Sequence[int]
    repeats: int
    growth: int  # how many times larger the larger task is, and of how many objects crowds are

    def nodes(self, number: int, **options: Any) -> dict[str, Any]:
        """Return a scene of the report as a dict, of the extent's size."""
        return mrt.scene_dict(number, width=self.size[0], height=self.size[1], **options)


FULL = Extent((400, 300), 16, (0, 1, 2, 3, 4), 11, 1000)
QUICK = Extent((96, 72), 16, (0,), 1, 50)


@dataclass(frozen=True)
class Pair:
    """Two runs to compare; ``agree`` says how far they are from what they must share: at most ``limit``."""

    name: str
    make: Callable[[], tuple[Run, Run]]
    goal: float  # of the ratio of seconds
    agree: Callable[[Run, Run], float] | None = None
    limit: float = 0.0
    why: str = ""


def run(study: Study, *, quick: bool) -> None:
    """Fill the study. A quick one holds that pairs agree, and says nothing of goals."""
    extent = QUICK if quick else FULL
    runtime.use(runtime.FAST)
    rows = []
    for pair in study.each("Speed", list(pairs(extent))):
        time, off = compare(pair, extent.repeats)
        if not quick:
            note = f"quartiles {time.low:.3g} and {time.high:.3g} of {extent.repeats} ratios"
            study.goal(pair.name, time.median, pair.goal, note, interval=(time.low, time.high))
        if off is not None:
            study.at_most(f"{pair.name}: difference", off, pair.limit, pair.why)
        quartiles = f"{time.low:.3g} to {time.high:.3g}"
        rows.append([pair.name, time.seconds, time.other_seconds, time.median, quartiles, pair.goal])
    columns = ["what", "s", "other, s", "ratio", "quartiles", "goal"]
    title = f"Seconds, {extent.size[0]}x{extent.size[1]}, {extent.spp} samples a pixel"
    study.table("speed", title, columns, rows, "Taken in turn, medians of ratios.", first=True)


def compare(pair: Pair, repeats: int) -> tuple[Ratio, float | None]:
    """Time a pair in turns, and say by how much it disagrees."""
    ours, other = pair.make()
    off = None if pair.agree is None else pair.agree(ours, other)
    time = ratio(ours, other, repeats=repeats)
    del ours, other
    gc.collect()  # scenes that stay alive slow down the kernels of later ones
    return time, off


def pairs(extent: Extent) -> Iterator[Pair]:
    """Yield all pairs; their scenes are loaded when their turn comes."""
    yield from against_mitsuba(extent)
    yield from other_ways(extent)
    yield from growth(extent)


# ----------------------------------------- Mitsuba's own plugins -----------------------------------------


def against_mitsuba(extent: Extent) -> Iterator[Pair]:
    """Yield this project's plugins against Mitsuba's own, in the report's scenes.

    Both sides go the same way: ``mi.render``, the independent sampler, a film with a box filter.
    """
    why = "the same light, else it would be no comparison; the rest is noise. One light less shows"
    for n in extent.scenes:
        for flavor, what in (
            ("mrt", "our shapes and materials"),
            ("stock", "Mitsuba's shapes and materials"),
        ):
            name = f"mrt_whitted / direct, scene {n}, {what}"
            bright = sum(key.startswith("light_") for key in extent.nodes(n))
            agree = partial(_other_light, factor=bright)
            yield Pair(name, partial(_direct, extent, n, flavor), 0.9, agree, SAME_MEAN, why)
        name = f"mrt_bsdf / roughconductor, scene {n}"
        make = partial(_other_material, extent, n)
        yield Pair(name, partial(make, "conductor"), 1.05, _other_light, SAME_MEAN, why)
        yield Pair(f"mrt_bsdf / roughplastic, scene {n}", partial(make, "plastic"), 1.05)


def _other_light(ours: Run, other: Run, factor: float = 1) -> float:
    means = [float(np.mean(side(), dtype=np.float64)) for side in (ours, other)]
    return abs(means[1] / means[0] / factor - 1)


def _by_mitsuba(extent: Extent, nodes: dict[str, Any], integrator: Any = None) -> Run:
    """Return Mitsuba's own way to a picture [H, W, 3]; by default with the scene's integrator."""
    scene = load(nodes)
    chosen = scene.integrator() if integrator is None else mi.load_dict(integrator)
    return lambda: np.array(mi.render(scene, integrator=chosen, spp=extent.spp))


def _direct(extent: Extent, number: int, flavor: str) -> tuple[Run, Run]:
    """Return direct light in the scene of one of the flavours, but for its lights, which are Mitsuba's."""
    stock, nodes = (extent.nodes(number, flavor=name) for name in ("stock", flavor))
    lights = [name for name in nodes if name.startswith("light_")]
    nodes |= {name: stock[name] for name in lights}
    del nodes["sky"]  # direct would sample it, mrt_whitted does not
    ours = {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
    theirs = {"type": "direct", "emitter_samples": len(lights), "bsdf_samples": 0}
    return _by_mitsuba(extent, nodes, ours), _by_mitsuba(extent, nodes, theirs)


def _other_material(extent: Extent, number: int, kind: str) -> tuple[Run, Run]:
    """Return the scene of Mitsuba's plugins with our materials and with Mitsuba's.

    They are conductors with F = 1, or, of the kind "plastic", those of the scene.
    """
    stock, mine = extent.nodes(number, flavor="stock"), extent.nodes(number, fresnel="dielectric")
    sides = stock, stock.copy()
    for name, node in stock.copy().items():
        if not isinstance(node, dict) or node["type"] != "roughplastic":
            continue
        if kind == "plastic":
            sides[0][name] = mine[name] | {"alpha": node["alpha"]}
            continue
        for side, material in zip(sides, (roughconductor.ours, roughconductor.theirs), strict=True):
            side[name] = material(node["alpha"]) | {"specular_reflectance": node["specular_reflectance"]}
    return _by_mitsuba(extent, sides[0]), _by_mitsuba(extent, sides[1])


# ------------------------------------------------ Other ways ------------------------------------------------


def other_ways(extent: Extent) -> Iterator[Pair]:
    """Yield searches by our tree against Mitsuba's, what a plan leaves out, and a sweep against a loop."""
    count, (width, height) = extent.growth, extent.size
    size = {"width": width, "height": height}

    def of_crowd(kind: str, **options: Any) -> Run:
        return partial(mrt.render, load(renders.crowd(count, kind, **size)), **PLAIN | options)

    yield Pair(f"{count} cones / spheres", lambda: (of_crowd("cone"), of_crowd("sphere")), 4)
    yield Pair(
        f"{count} spheres in our tree / in Mitsuba's",
        lambda: (of_crowd("group", layers=["depth"]), of_crowd("sphere", layers=["depth"])),
        4,
        _other_hits,
        OTHER_HITS,
        "grazing rays may go either way in float32. One object in a thousand lost shows",
    )
    scene = partial(extent.nodes, 0)
    far = {"type": "mrt_cone", "apex": [1e3, 1, 0], "base_center": [1e3, 0, 0], "radius": 0.1}
    why = "half a step of an 8-bit picture; a lamp that is left out changes hundreds"

    def off(ours: Run, other: Run) -> float:
        return float(np.abs(ours().image - other().image).max())

    for what, change, options in (
        ("cone code", {"far": far}, {}),
        ("paths that cannot matter", {}, {"integrator": {"type": "mrt_whitted", "min_contribution": 0.0}}),
        ("layers", {}, {"layers": ["depth", "normal", "albedo", "direct", "reflection", "bounces"]}),
    ):
        make = partial(_left_out, scene, change, options)
        yield Pair(f"scene 0 without {what} / with", make, 1.05, off, INVISIBLE, why)
    if usable_cores() > 1 and extent.repeats > 1:  # workers take seconds to start
        key, values = "material_0.alpha", np.linspace(0.02, 0.5, max(3, count // 10)).tolist()
        small: dict[str, Any] = {**size, "aa": 2}

        def sweep() -> None:
            with TemporaryDirectory() as folder:
                mrt.sweep(3, folder, grid={key: values}, workers=2, progress=Progress(), **small)

        def loop() -> None:
            with TemporaryDirectory() as folder:
                for i, value in enumerate(values):
                    mrt.render(3, params={key: value}, **small).save(Path(folder, f"{i}.exr"))

        yield Pair("a sweep by two workers / a loop", lambda: (sweep, loop), 0.6)


def _left_out(scene: Callable[[], Any], change: dict[str, Any], more: dict[str, Any]) -> tuple[Run, Run]:
    without, forced = load(scene()), load(scene() | change)
    return partial(mrt.render, without, **PLAIN), partial(mrt.render, forced, **PLAIN, **more)


def _other_hits(ours: Run, other: Run) -> float:
    depths = [np.nan_to_num(side().layers["depth.Z"], posinf=1e6) for side in (ours, other)]
    return float(np.mean(np.abs(depths[0] - depths[1]) > 1e-3 * depths[1]))


# -------------------------------------------------- Growth --------------------------------------------------


def growth(extent: Extent) -> Iterator[Pair]:
    """Yield tasks against smaller ones; the code must not grow with them."""
    times = extent.growth
    small: dict[str, Any] = {"width": 40, "height": 30}
    side = round(times**0.5)
    larger = {name: value * side for name, value in small.items()}

    def of(nodes: dict[str, Any], **options: Any) -> Run:
        return partial(mrt.render, load(nodes), **PLAIN | options)

    def of_lights(count: int) -> Run:
        return of(renders.with_lights(count, **small))

    def of_triangles(count: int) -> Run:
        return of(renders.with_triangles(count, **small), aa=4)

    def longer_code(ours: Run, other: Run) -> float:
        return operations(ours) / operations(other) - 1

    for name, make, goal in (
        ("pixels", lambda: (of(mrt.scene_dict(3, **larger)), of(mrt.scene_dict(3, **small))), side * side),
        ("lights", lambda: (of_lights(16 * times), of_lights(16)), times),
        ("triangles", lambda: (of_triangles(100 * times), of_triangles(100)), 10),
    ):
        why = "numbers are data, not code; a loop that is unrolled makes it as many times longer"
        yield Pair(f"{times} times the {name}", make, goal, longer_code, MOST_CODE - 1, why)


# ------------------------------------------------- A device -------------------------------------------------


def on_device(variant: str, sizes: Sequence[tuple[int, int]], triangles: int) -> Iterator[Pair]:
    """Yield the report's scenes and many triangles in a variant, against Mitsuba's ``direct`` and ``path``.

    ``mrt_whitted`` renders with one ray a pixel; the others render the scene of Mitsuba's own plugins (but
    for the mesh), one sample a pixel. They compute other light: the ratio says what a picture costs, not
    which is better. Raises ``VariantError`` where there is no device.
    """
    runtime.use(variant)
    others: dict[str, dict[str, Any]] = {
        "direct": {"type": "direct"},
        "path": {"type": "path", "max_depth": 6},
    }

    def make(
        mine: Callable[[], Any], theirs: Callable[[], Any], integrator: dict[str, Any]
    ) -> tuple[Run, Run]:
        ours, stock, chosen = load(mine()), load(theirs()), mi.load_dict(integrator)
        return (
            lambda: mrt.render(ours, **PLAIN).image,
            lambda: np.array(mi.render(stock, integrator=chosen, spp=1)),
        )

    for width, height in sizes:
        size: dict[str, Any] = {"width": width, "height": height}
        flavors: dict[str, list[Callable[[], Any]]] = {
            f"scene {n}": [partial(mrt.scene_dict, n, flavor=f, **size) for f in ("mrt", "stock")]
            for n in range(5)
        }
        flavors[f"{triangles} triangles"] = [partial(renders.with_triangles, triangles, **size)] * 2
        for name, (mine, theirs) in flavors.items():
            for other, integrator in others.items():
                what = f"{name}, {width}x{height}, mrt_whitted / {other}"
                yield Pair(what, partial(make, mine, theirs, integrator), 1.0)
