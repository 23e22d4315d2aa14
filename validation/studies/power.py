"""The power of the laws: for each, the least of faults of many sizes that it finds, quick and in full."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.checks.bsdf import check_bsdf
from mrt_mitsuba.validation.checks.law import Check
from mrt_mitsuba.validation.checks.shape import check_shape

AS_IS: tuple[dict[str, Any], str, Any] = ({}, "", lambda value, *_: value)


def changed_bsdf(changes: Mapping[str, tuple[dict[str, Any], str, Any]]) -> type:
    """Return a class of BSDFs whose answers are those of another, changed: for ``register_bsdf``.

    ``changes``: by name, the dict of the BSDF, what is changed, and a function: of (value, ctx, wi, wo) for
    "eval", "pdf", what eval_pdf() alone gives ("pair"), or values and weights ("value"); of (bs, weight, u,
    ctx) for "sample". "flags" are added, to components as well or to the "whole" alone; "active" is
    overlooked; an "update" adds a component.
    """

    class Changed(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.nested, name = props["nested"], props["change"]
            _, self.kind, self.change = changes.get(name, AS_IS)[:3]
            more = self.change if self.kind == "flags" else 0
            count = self.nested.component_count()
            self.m_components = [int(self.nested.flags(i)) | more for i in range(count)]
            self.m_flags = int(self.nested.flags()) | (self.change if self.kind in ("flags", "whole") else 0)

        def traverse(self, callback: Any) -> None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            if self.kind == "update":
                self.m_components = [*self.m_components, self.m_flags]

        def changed(self, kinds: Sequence[str], value: Any, *where: Any) -> Any:
            return self.change(value, *where) if self.kind in kinds else value

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value = self.nested.eval(ctx, si, wo, True if self.kind == "active" else active)
            return self.changed(("eval", "value"), value, ctx, si.wi, wo)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.changed(("pdf",), self.nested.pdf(ctx, si, wo, active), ctx, si.wi, wo)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            pair = self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)
            return self.changed(("pair",), pair, ctx, si.wi, wo)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            bs, weight = self.nested.sample(ctx, si, sample1, sample2, active)
            weight = self.changed(("value",), weight, ctx, si.wi, bs.wo)
            return self.change(bs, weight, sample2, ctx) if self.kind == "sample" else (bs, weight)

        def to_string(self) -> str:
            return f"Changed[{self.kind}]"

    return Changed


TRACED = ("ray_intersect", "ray_test", "bbox")
SAMPLED = ("surface_area", "sample_position", "pdf_position", "sample_direction", "pdf_direction")


class ChangedShape:
    """A shape some of whose methods are changed: functions of what they return and of their arguments."""

    def __init__(self, given: Any = None, **changes: Callable[..., Any]) -> None:
        self.shape = mi.load_dict(given or {"type": "cube"})
        self.scene = mi.load_dict({"type": "scene", "shape": self.shape})
        self.changes = changes

    def __getattr__(self, name: str) -> Any:
        if name not in TRACED + SAMPLED:
            raise AttributeError(name)
        sound = getattr(self.scene if name in TRACED else self.shape, name)
        change = self.changes.get(name, AS_IS[2])
        return lambda *given: change(sound(*given), *given)


def put(record: Any, **members: Any) -> Any:
    """Return a hit or a sample with other values of some members."""
    for name, value in members.items():
        setattr(record, name, value)
    return record


class Fault:
    """A fault in words, with the figure of a law that should find it.

    ``full`` and ``quick``: the least size that such checks find, as docs/check_your_plugin.md states.
    ``changes``: by a kind of ``changed_bsdf`` or methods of ``ChangedShape``, functions of the size and of
    what is changed; ``nested``: what is changed, if not a diffuse BSDF or a cube.
    """

    def __init__(
        self, figure: str, what: str, full: float, *, quick: float = 0, nested: Any = None, **changes: Any
    ) -> None:
        self.figure, self.what, self.full, self.quick = figure, what, full, quick or full
        self.nested, self.changes = nested, changes
        self.kind = "shape" if changes.keys() <= {*TRACED, *SAMPLED} else "BSDF"

    def check(self, size: float, *, quick: bool) -> Check:
        """Check a plugin with the fault by the law of its figure. Needs ``register``."""
        changes, law = {kind: partial(change, size) for kind, change in self.changes.items()}, self.figure
        options: dict[str, Any] = {"only": [law.split(".")[0]], "quick": quick}
        if self.kind == "shape":
            return check_shape(ChangedShape(self.nested, **changes), **options)
        nested, name = self.nested or {"type": "diffuse"}, f"{self.what} {size}"
        FAULTY[name] = (nested, *next(iter(changes.items())))
        return check_bsdf({"type": "faulty", "change": name, "nested": nested}, **options)

    def least_found(self, *, quick: bool) -> float:
        """Return the least size down to which it is found, by steps; infinity for none."""
        least = np.inf
        for factor in (3, 2, 1, 0.5, 0.3, 0.1):
            size = factor * (self.quick if quick else self.full)
            if np.isinf(size) or not self.check(size, quick=quick).failed:
                break
            least = size
        return float(least)


FAULTY: dict[str, tuple[dict[str, Any], str, Any]] = {}  # by name, the changes of the BSDF "faulty"


def register(*variants: str) -> None:
    """Register the BSDF "faulty" in variants; the last one becomes current."""
    for variant in variants:
        runtime.use(variant)
        mi.register_bsdf("faulty", changed_bsdf(FAULTY))


GLASS, GLOSS = {"type": "dielectric"}, {"type": "roughconductor", "alpha": 0.2}
SIZE = 2 * 3**0.5  # of the cube: its diagonal
DEGREE = 0.01745
PLACE = (0.48, 0.36, 0.8)  # a direction away from all axes


def tilted(n: Any, size: float) -> Any:
    """Return normals tilted by an angle."""
    return dr.normalize(n + size * mi.Normal3f(0.6, 0.48, 0.64))


def by_mode(s: float, value: Any, ctx: Any, wi: Any, wo: Any) -> Any:
    """Return values that are larger in the mode of importance."""
    return value * (1 + s * (ctx.mode == mi.TransportMode.Importance))


FAULTS: Sequence[Fault] = (
    Fault("sampling.cells", "density too large where a tenth of the samples go", 0.03, quick=0.1,
          pdf=lambda s, pdf, ctx, wi, wo: pdf * dr.select(wo.x > 0.687, 1 + s, 1)),
    Fault("sampling.small", "density too small in a cone of 1 degree", 0.5, quick=np.inf,
          pdf=lambda s, pdf, ctx, wi, wo:
              pdf * (1 - min(s, 0.9) * (dr.norm(wo - mi.Vector3f(PLACE)) < DEGREE))),
    Fault("sampling.integral", "density too large everywhere", 0.01, pdf=lambda s, pdf, *_: (1 + s) * pdf),
    Fault("weights.density", "density that a sample states too large", 3e-3,
          sample=lambda s, bs, weight, *_: (put(bs, pdf=(1 + s) * bs.pdf), weight)),
    Fault("weights.weight", "weight of a sample too large", 3e-3,
          sample=lambda s, bs, weight, *_: (bs, (1 + s) * weight)),
    Fault("weights.discrete", "probability of a single direction too small", 5e-3,
          nested={"type": "conductor"},
          sample=lambda s, bs, weight, *_: (put(bs, pdf=(1 - s) * bs.pdf), weight)),
    Fault("eval_pdf.value", "value of eval_pdf() too large in one channel", 1e-4,
          pair=lambda s, pair, *_: (pair[0] * mi.Color3f(1 + s, 1, 1), pair[1])),
    Fault("eval_pdf.density", "density of eval_pdf() too large", 2e-4, nested=GLOSS,
          pair=lambda s, pair, *_: (pair[0], (1 + s) * pair[1])),
    Fault("energy.largest", "albedo above 1", 0.01, value=lambda s, value, *_: 2 * (1 + s) * value),
    Fault("energy.apart", "value of eval() too large", 0.02, eval=lambda s, value, *_: (1 + s) * value),
    Fault("reciprocity.swapped", "value that grows with the cosine of wi", 3e-3,
          value=lambda s, value, ctx, wi, wo: value * (1 + s * wi.z)),
    Fault("reciprocity.modes", "more light in the mode of importance", 3e-3, value=by_mode),
    Fault("reciprocity.medium", "index of refraction of reflected light", 3e-7,
          sample=lambda s, bs, weight, *_: (put(bs, eta=(1 + s) * bs.eta), weight)),
    Fault("reciprocity.single", "more light through glass from one side", 3e-3, nested=GLASS,
          value=lambda s, value, ctx, wi, wo: value * (1 + s * (wi.z > 0))),
    Fault("reciprocity.single_modes", "more light through glass in the mode of importance", 3e-3,
          nested=GLASS, value=by_mode),
    Fault("finite.samples", "NaN for a share of the random numbers, at their end", 1e-6,
          sample=lambda s, bs, weight, u, ctx: (bs, dr.select(u.x > 1 - s, dr.nan, weight))),
    Fault("finite.values", "negative value where both cosines are so near to 1", 1e-6,
          value=lambda s, value, ctx, wi, wo: dr.select(dr.minimum(wi.z, wo.z) > 1 - s, -1, 1) * value),
    Fault("roundoff.lost", "stairs on a slope, of this height", 3e-4, value=lambda s, value, ctx, wi, wo:
              value * (1 + s * (dr.round(wi.z * wo.z / s) - wi.z * wo.z / s))),
    Fault("gradients.values", "derivative of values too large", 0.03, nested=GLOSS,
          value=lambda s, value, *_: value + s * (value - dr.detach(value))),
    Fault("gradients.weights", "derivative of weights too large", 0.03, nested=GLOSS,
          sample=lambda s, bs, weight, *_: (bs, weight + s * (weight - dr.detach(weight)))),
    Fault("components.sum", "a component brighter than its share", 1e-4,
          eval=lambda s, value, ctx, *_: value * (1 + s * (ctx.component == 0))),
    Fault("variants.same", "values larger in scalar variants", 3e-3,
          value=lambda s, value, *_: value if dr.is_jit_v(value) else (1 + s) * value),
    Fault("hits.ray_test", "ray_test() misses in this share of directions", 1e-5,
          ray_test=lambda s, found, ray: found & (ray.d.x < 1 - 2 * s)),
    Fault("surface.on_ray", "hit points off the ray, in sizes", 1e-5,
          ray_intersect=lambda s, si, ray: put(si, p=si.p + SIZE * s * si.n)),
    Fault("surface.near_by", "hit points off, in sizes", 5e-7,
          ray_intersect=lambda s, si, ray: put(si, p=si.p + SIZE * s * si.n)),
    Fault("surface.behind", "hits too far away, in sizes", 5e-7,
          ray_intersect=lambda s, si, ray: put(si, t=si.t + SIZE * s, p=si.p + SIZE * s * ray.d)),
    Fault("surface.missed", "a least distance for this share of directions", 3e-3,
          ray_intersect=lambda s, si, ray:
              put(si, t=dr.select((si.t < 0.01) & (ray.d.x > 1 - 2 * s), dr.inf, si.t))),
    Fault("normals.outwards", "normals inwards on this share of most faces", 3e-3,
          ray_intersect=lambda s, si, ray:
              put(si, n=dr.select((si.p.x > 1 - 2 * s) & (si.n.x < 0.5), -1, 1) * si.n)),
    Fault("normals.length", "normals too long", 3e-5,
          ray_intersect=lambda s, si, ray: put(si, n=(1 + s) * si.n)),
    Fault("normals.slant", "normals tilted, in radians", 3e-3,
          ray_intersect=lambda s, si, ray: put(si, n=tilted(si.n, s))),
    Fault("normals.slope", "normals tilted as well as derivatives, in radians", 0.03,
          ray_intersect=lambda s, si, ray: put(si, n=tilted(si.n, s))),
    Fault("normals.shading", "shading normals tilted, in radians", 3e-3,
          ray_intersect=lambda s, si, ray: put(si, sh_frame=mi.Frame3f(tilted(si.sh_frame.n, s)))),
    Fault("normals.step", "dp_du too long", 0.02,
          ray_intersect=lambda s, si, ray: put(si, dp_du=(1 + s) * si.dp_du)),
    Fault("watertight.out", "a slit of this width, in sizes", 3e-5, quick=1e-4,
          ray_intersect=lambda s, si, ray:
              put(si, t=dr.select(dr.abs(si.p.x - 0.3) < SIZE * s / 2, dr.inf, si.t))),
    Fault("watertight.odd", "a slit of this width in one face, in sizes", 6e-3,
          ray_intersect=lambda s, si, ray:
              put(si, t=dr.select((dr.abs(si.p.x - 0.3) < SIZE * s / 2) & (si.n.z > 0.5), dr.inf, si.t))),
    Fault("far.missed", "hits off by this part of a distance above a thousand", 1e-5,
          ray_intersect=lambda s, si, ray:
              put(si, p=dr.select(si.t > 1000, si.p + s * si.t * si.n, si.p))),
    Fault("far.missed", "misses from afar in this share of directions", 3e-3,
          ray_intersect=lambda s, si, ray:
              put(si, t=dr.select((si.t > 1000) & (ray.d.x > 1 - 2 * s), dr.inf, si.t))),
    Fault("finite.bad", "NaN where a component of the direction is so small", 1e-12,
          ray_intersect=lambda s, si, ray: put(si, uv=dr.select(dr.abs(ray.d.x) < s, dr.nan, si.uv))),
    Fault("sampling.crossings", "area too large, and the density of positions too small", 0.01, quick=0.02,
          surface_area=lambda s, area: (1 + s) * area, pdf_position=lambda s, pdf, ps: pdf / (1 + s),
          sample_position=lambda s, ps, *_: put(ps, pdf=ps.pdf / (1 + s))),
    Fault("sampling.area", "surface_area() too large", 3e-3, surface_area=lambda s, area: (1 + s) * area),
    Fault("sampling.position", "pdf_position() too large", 3e-3,
          pdf_position=lambda s, pdf, ps: (1 + s) * pdf),
    Fault("sampling.spread", "positions crowded to one side: u to the power of 1 and this", 0.03, quick=0.1,
          nested={"type": "rectangle"}, sample_position=lambda s, ps, time, u:
              put(ps, p=mi.Point3f(2 * u.x ** (1 + s) - 1, ps.p.y, 0))),
    Fault("sampling.off", "positions off the surface, in sizes", 1e-5,
          sample_position=lambda s, ps, *_: put(ps, p=ps.p + SIZE * s * ps.n)),
    Fault("sampling.normal", "normals of positions tilted, in radians", 0.1,
          sample_position=lambda s, ps, *_: put(ps, n=tilted(ps.n, s))),
    Fault("sampling.direction", "pdf_direction() too large", 0.02,
          pdf_direction=lambda s, pdf, *_: (1 + s) * pdf),
    Fault("sampling.misses", "distances too short for this share of directions", 0.02,
          sample_direction=lambda s, ds, it, u: put(ds, dist=ds.dist * dr.select(u.x < s, 0.99, 1))),
    Fault("sampling.angle", "density of directions too small", 0.03, quick=0.2,
          pdf_direction=lambda s, pdf, *_: pdf / (1 + s),
          sample_direction=lambda s, ds, *_: put(ds, pdf=ds.pdf / (1 + s))),
    Fault("bbox.outside", "a box too small above, in sizes", 3e-5,
          bbox=lambda s, box: mi.BoundingBox3f(box.min, (1 - 2 * s) * box.max)),
    Fault("bbox.outside", "a box too small below, in sizes", 3e-5,
          bbox=lambda s, box: mi.BoundingBox3f((1 - 2 * s) * box.min, box.max)),
)  # fmt: skip

if __name__ == "__main__":  # the table of docs/check_your_plugin.md; inf: none was found
    register(runtime.SLOW, runtime.FAST)
    print("| law | for a | fault | quick | full |\n|---|---|---|---|---|")
    for fault in FAULTS:
        found = " | ".join(f"{fault.least_found(quick=quick):.1g}" for quick in (True, False))
        print(f"| {fault.figure.split('.')[0]} | {fault.kind} | {fault.what} | {found} |", flush=True)
