"""The cost of rendering one of the report's scenes: seconds, kernels, rays, and the floor under it.

The floor is the time of its own rays, recorded, through Mitsuba's ray queries and nothing else. What a
picture costs beyond it goes into shading, planes, the bounce loop, means over pixels and Python.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.tools import kernels
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.warm import Ratio, Warm, measure, ratio


@dataclass
class Recorder:
    """Stands before a Mitsuba scene and keeps the rays that it is asked about."""

    scene: Any
    # For each wavefront: camera, mirror or shadow; whether it was said to be coherent; its rays
    waves: list[tuple[str, bool, Any]] = field(default_factory=list)
    single: list[tuple[int, Any, Any]] = field(default_factory=list)

    def ray_intersect_preliminary(self, ray: Any, coherent: Any, active: Any) -> Any:
        self._keep("mirror" if self.waves else "camera", ray, coherent, active)
        return self.scene.ray_intersect_preliminary(ray, coherent, active)

    def ray_test(self, ray: Any, coherent: Any, active: Any) -> Any:
        self._keep("shadow", ray, coherent, active)
        return self.scene.ray_test(ray, coherent, active)

    def shapes_dr(self) -> Any:
        return self.scene.shapes_dr()

    def _keep(self, kind: str, ray: Any, coherent: bool, active: Any) -> None:
        active = mi.Bool(active) & dr.full(mi.Bool, True, dr.width(ray.o))
        index = dr.compress(active)
        if dr.width(index) == 0:
            return
        if dr.width(index) == 1:
            # inside a loop, its mask would widen a single ray to all lanes
            dr.eval(ray, index)
            self.single.append((len(self.waves), ray, index))
            kept = None
        else:
            kept = dr.gather(mi.Ray3f, ray, index)
            dr.eval(kept)
        self.waves.append((kind, coherent, kept))

    def finish(self) -> None:
        """Take out single rays, which had to wait for the end of the loop."""
        for place, ray, index in self.single:
            kept = dr.gather(mi.Ray3f, ray, index)
            dr.eval(kept)
            self.waves[place] = (*self.waves[place][:2], kept)
        self.single.clear()

    def counts(self) -> dict[str, int]:
        """Return the number of rays of each kind."""
        counts: Counter[str] = Counter()
        for kind, _, rays in self.waves:
            counts[kind] += dr.width(rays)
        return dict(counts)

    def replay(self) -> None:
        """Ask again about all rays."""
        for kind, coherent, rays in self.waves:
            if kind == "shadow":
                dr.eval(self.scene.ray_test(rays, coherent))
            else:
                hit = self.scene.ray_intersect_preliminary(rays, coherent)
                dr.eval(hit.t, hit.shape)
        dr.sync_thread()


def record(scene: Any, **options: Any) -> Recorder:
    """Return the rays that a render by ``mrt_whitted`` asks Mitsuba about, by an integrator that records."""
    from mrt_mitsuba.plugins.whitted import MrtWhitted

    class Recording(MrtWhitted):
        recorder: Recorder

        def prepare(self, scene: Any, plan: Any = None, reading: Any = None) -> Any:
            data = super().prepare(scene, plan, reading)
            data.bvh = self.recorder = Recorder(data.bvh or scene)
            return data

    integrator = Recording(mi.Properties())
    # Loops and branches in Python, so that the rays of every bounce pass by here
    with (
        dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False),
        dr.scoped_set_flag(dr.JitFlag.SymbolicConditionals, False),
    ):
        mrt.render(scene, integrator=integrator, **options)
    integrator.recorder.finish()
    return integrator.recorder


@dataclass(frozen=True)
class SceneCost:
    """One scene with every pixel supersampled."""

    warm: Warm
    each: list[kernels.Kernel]
    recorded: dict[str, int]  # rays that Mitsuba was asked about, by kind
    counted: dict[str, int]  # rays that the integrator counted, by kind
    floor: Ratio  # of the render and of its rays alone, in turn

    @property
    def in_kernels(self) -> float:
        return sum(k.seconds for k in self.each)

    @property
    def compile(self) -> float:
        return sum(k.compile for k in self.each)

    @property
    def rays_per_second(self) -> float:
        return sum(self.counted.values()) / self.warm.seconds

    @property
    def share_off(self) -> float:
        """The share of the rays by which the recorded and the counted ones of a kind differ most."""
        kinds = {"primary": "camera", "mirror": "mirror", "shadow": "shadow"}
        off = max(abs(self.recorded.get(kinds[kind], 0) - count) for kind, count in self.counted.items())
        return off / sum(self.counted.values())


def scene_cost(number: int, size: tuple[int, int], aa: int, *, repeats: int) -> SceneCost:
    """Measure one of the report's scenes."""
    scene = load(mrt.scene_dict(number, width=size[0], height=size[1]))
    options: dict[str, Any] = {"aa": aa, "aamode": "none"}
    render = partial(mrt.render, scene, **options)
    each = kernels.profile(render, repeats=repeats)
    warm = measure({"": render}, repeats=repeats)[""]
    recorder = record(scene, **options)
    floor = ratio(render, recorder.replay, repeats=repeats)
    return SceneCost(warm, each, recorder.counts(), dict(render(count_rays=True).rays), floor)
