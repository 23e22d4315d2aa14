"""``make bench-gpu``: the report's scenes and a million triangles on a device, against Mitsuba's integrators.

``mrt_whitted`` renders each scene with one ray a pixel; ``direct`` and ``path`` render it with Mitsuba's own
plugins in place of this project's (but for the mesh), one sample a pixel, in turns. They compute other light,
so the ratio says what a picture costs, not which is better.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.export import scene_dict
from mrt_mitsuba.validation.studies import growth
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.warm import Ratio, ratio

THEIRS: dict[str, dict[str, Any]] = {"direct": {"type": "direct"}, "path": {"type": "path", "max_depth": 6}}


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    sizes: Sequence[tuple[int, int]]
    scenes: Sequence[int]
    triangles: int
    repeats: int


FULL = Extent(((800, 600), (4096, 4096)), (0, 1, 2, 3, 4), 10**6, 7)
QUICK = Extent(((80, 60),), (0,), 1000, 1)


@dataclass(frozen=True)
class Row:
    """``mrt_whitted`` against one of Mitsuba's integrators."""

    scene: str
    width: int
    height: int
    other: str
    time: Ratio

    def __str__(self) -> str:
        size, t = f"{self.width}x{self.height}", self.time
        seconds = f"{1000 * t.seconds:>10.2f}{1000 * t.other_seconds:>10.2f}"
        return (
            f"{self.scene:<20}{size:<12}{self.other:<8}{seconds}{t.median:>8.2f}  {t.low:.2f} to {t.high:.2f}"
        )


HEADER = f"{'scene':<20}{'size':<12}{'other':<8}{'ours, ms':>10}{'other, ms':>10}{'ratio':>8}  quartiles"


def measure(variant: str, extent: Extent = FULL) -> Iterator[Row]:
    """Yield a row for each scene, size and integrator. Raises ``VariantError`` where there is no device."""
    from mrt_mitsuba import runtime

    runtime.use(variant)
    for width, height in extent.sizes:
        for name, ours, theirs in _scenes(extent, width, height):
            render = _ours(ours)
            for other, integrator in THEIRS.items():
                time = ratio(render, _theirs(theirs, integrator), repeats=extent.repeats)
                yield Row(name, width, height, other, time)
            del render
            gc.collect()  # scenes that stay alive slow down the kernels of later ones


def _scenes(extent: Extent, width: int, height: int) -> Iterator[tuple[str, Any, Any]]:
    for number in extent.scenes:
        nodes = (scene_dict(number, width=width, height=height, flavor=flavor) for flavor in ("mrt", "stock"))
        yield str(number), *map(load, nodes)
    hills = load(scene_dict(growth.SERIES["triangles"](extent.triangles)[0], width=width, height=height))
    yield f"{extent.triangles} triangles", hills, hills


def _ours(scene: Any) -> Callable[[], np.ndarray]:
    return lambda: mrt.render(scene, aa=1, aamode="none", lattice="report", focaldist=0).image


def _theirs(scene: Any, integrator: dict[str, Any]) -> Callable[[], np.ndarray]:
    chosen = mi.load_dict(integrator)
    return lambda: np.array(mi.render(scene, integrator=chosen, spp=1))


def as_dicts(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return rows for JSON."""
    return [asdict(row) for row in rows]
