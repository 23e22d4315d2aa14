"""The floor under a render: its own rays, recorded, through Mitsuba's ray queries and nothing else.

What a picture costs beyond it goes into shading, planes, the bounce loop, means over pixels and Python.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.tools.warm import Ratio, ratio


@dataclass
class Recorder:
    """Stands before a Mitsuba scene and keeps the rays that it is asked about."""

    scene: Any
    kinds: list[str] = field(default_factory=list)  # of each wavefront: camera, mirror, shadow
    coherent: list[bool] = field(default_factory=list)  # the hint given with it
    rays: list[Any] = field(default_factory=list)
    single: list[tuple[int, Any, Any]] = field(default_factory=list)

    def ray_intersect_preliminary(self, ray: Any, coherent: Any, active: Any) -> Any:
        self._keep("mirror" if self.kinds else "camera", ray, coherent, active)
        return self.scene.ray_intersect_preliminary(ray, coherent, active)

    def ray_test(self, ray: Any, coherent: Any, active: Any) -> Any:
        self._keep("shadow", ray, coherent, active)
        return self.scene.ray_test(ray, coherent, active)

    def _keep(self, kind: str, ray: Any, coherent: bool, active: Any) -> None:
        """Keep the rays that are asked about, one after the other."""
        import drjit as dr
        import mitsuba as mi

        active = mi.Bool(active) & dr.full(mi.Bool, True, dr.width(ray.o))
        index = dr.compress(active)
        if dr.width(index) == 0:
            return
        if dr.width(index) == 1:
            # inside a loop, its mask would widen a single ray to all lanes
            dr.eval(ray, index)
            self.single.append((len(self.rays), ray, index))
            kept = None
        else:
            kept = dr.gather(mi.Ray3f, ray, index)
            dr.eval(kept)
        self.kinds.append(kind)
        self.coherent.append(coherent)
        self.rays.append(kept)

    def finish(self) -> None:
        """Take out single rays, which had to wait for the end of the loop."""
        import drjit as dr
        import mitsuba as mi

        for place, ray, index in self.single:
            self.rays[place] = dr.gather(mi.Ray3f, ray, index)
            dr.eval(self.rays[place])
        self.single.clear()

    def counts(self) -> dict[str, int]:
        """Rays of each kind."""
        import drjit as dr

        counts: Counter[str] = Counter()
        for kind, rays in zip(self.kinds, self.rays, strict=True):
            counts[kind] += dr.width(rays)
        return dict(counts)

    def replay(self) -> None:
        """Ask again about all rays."""
        import drjit as dr

        for kind, coherent, rays in zip(self.kinds, self.coherent, self.rays, strict=True):
            if kind == "shadow":
                dr.eval(self.scene.ray_test(rays, coherent))
            else:
                hit = self.scene.ray_intersect_preliminary(rays, coherent)
                dr.eval(hit.t, hit.shape)
        dr.sync_thread()


@dataclass(frozen=True)
class Floor:
    """A render over the ray queries alone, and its rays by kind."""

    time: Ratio
    rays: dict[str, int]


def record(scene: Any, **options: Any) -> Recorder:
    """The rays that a render of a loaded Mitsuba scene by ``mrt_whitted`` asks Mitsuba about."""
    import drjit as dr

    integrator = scene.integrator()
    prepared = integrator.prepare(scene)
    before = prepared.bvh
    recorder = Recorder(before or scene)
    prepared.bvh = recorder
    try:
        # Loops and branches in Python, so that the rays of every bounce pass by here
        with (
            dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False),
            dr.scoped_set_flag(dr.JitFlag.SymbolicConditionals, False),
        ):
            mrt.render(scene, **options)
    finally:
        prepared.bvh = before
    recorder.finish()
    return recorder


def floor(scene: Any, *, repeats: int = 3, **options: Any) -> Floor:
    """Record a render of a scene, then replay its rays and render again in turn."""
    recorder = record(scene, **options)
    time = ratio(partial(mrt.render, scene, **options), recorder.replay, repeats=repeats)
    return Floor(time, recorder.counts())
