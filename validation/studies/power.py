"""The power of the laws: for each, the least of faults of many sizes that it finds, quick and in full."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.checks.bsdf import check_bsdf
from mrt_mitsuba.validation.checks.law import Check
from mrt_mitsuba.validation.checks.shape import check_shape

DIFFUSE, GLASS = {"type": "diffuse"}, {"type": "dielectric"}
GLOSS = {"type": "roughconductor", "alpha": 0.2}
PLACE = (0.48, 0.36, 0.8)  # a direction away from all axes
DEGREE = 0.01745
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


class ChangedShape:
    """A shape whose answers are changed: "hit" of (si, ray), "test" of (found, ray), "bbox" of the box.

    Of positions and directions that are sampled "position" and "direction" (of the record and the random
    numbers), their densities "pdf_position" and "pdf_direction", and "area"; ``first``: a power of the first
    random number of positions.
    """

    def __init__(self, given: Any = None, *, first: float = 1.0, **changes: Callable[..., Any]) -> None:
        self.shape = mi.load_dict(given or {"type": "cube"})
        self.scene = mi.load_dict({"type": "scene", "shape": self.shape})
        self.first, self.changes = first, changes

    def changed(self, kind: str, value: Any, *more: Any) -> Any:
        return self.changes[kind](value, *more) if kind in self.changes else value

    def ray_intersect(self, ray: Any) -> Any:
        return self.changed("hit", self.scene.ray_intersect(ray), ray)

    def ray_test(self, ray: Any) -> Any:
        return self.changed("test", self.scene.ray_test(ray), ray)

    def bbox(self) -> Any:
        return self.changed("bbox", self.scene.bbox())

    def surface_area(self) -> Any:
        return self.changed("area", self.shape.surface_area())

    def sample_position(self, time: Any, sample: Any) -> Any:
        ps = self.shape.sample_position(time, mi.Point2f(sample.x**self.first, sample.y))
        return self.changed("position", ps, sample)

    def pdf_position(self, ps: Any) -> Any:
        return self.changed("pdf_position", self.shape.pdf_position(ps))

    def sample_direction(self, it: Any, sample: Any) -> Any:
        return self.changed("direction", self.shape.sample_direction(it, sample), sample)

    def pdf_direction(self, it: Any, ds: Any) -> Any:
        return self.changed("pdf_direction", self.shape.pdf_direction(it, ds))


def moved(**values: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Return a change of hits or samples: members are functions of it, and of the ray or the random numbers.

    ``shading`` is that normal.
    """

    def change(found: Any, source: Any) -> Any:
        for name, value in values.items():
            place, member = (found.sh_frame, "n") if name == "shading" else (found, name)
            setattr(place, member, value(found, source))
        return found

    return change


def tilted(n: Any, size: float) -> Any:
    """Return normals tilted by an angle."""
    return dr.normalize(n + size * mi.Normal3f(0.6, 0.48, 0.64))


class Fault(NamedTuple):
    """A fault in words, the law and figure that should find it, the least size, and what makes it."""

    figure: str
    what: str
    quick: float  # the least that a quick check finds, and a full one, as docs/check_your_plugin.md states
    full: float
    kind: str  # of ``changed_bsdf``, or "shape"
    change: Callable[[float], Any]  # of the size
    nested: dict[str, Any] | None = None

    @property
    def law(self) -> str:
        return self.figure.split(".")[0]


def scaled(record: Any, **factors: float) -> Any:
    """Return a sample some of whose members are multiplied."""
    for name, factor in factors.items():
        setattr(record, name, factor * getattr(record, name))
    return record


def _stairs(value: Any, cosines: Any, size: float) -> Any:
    return value * (1 + size * (dr.round(cosines / size) - cosines / size))


SIZE = 2 * 3**0.5  # of the cube: its diagonal
FAULTS: Sequence[Fault] = (
    Fault("sampling.cells", "density too large where a tenth of the samples go", 0.1, 0.03, "pdf",
          lambda s: lambda pdf, ctx, wi, wo: pdf * dr.select(wo.x > 0.687, 1 + s, 1)),
    Fault("sampling.small", "density too small in a cone of 1 degree", np.inf, 0.5, "pdf",
          lambda s: lambda pdf, ctx, wi, wo:
              pdf * (1 - min(s, 0.9) * (dr.norm(wo - mi.Vector3f(PLACE)) < DEGREE))),
    Fault("sampling.integral", "density too large everywhere", 0.01, 0.01, "pdf",
          lambda s: lambda pdf, ctx, wi, wo: (1 + s) * pdf),
    Fault("weights.density", "density that a sample states too large", 3e-3, 3e-3, "sample",
          lambda s: lambda bs, weight, u, ctx: (scaled(bs, pdf=1 + s), weight)),
    Fault("weights.weight", "weight of a sample too large", 3e-3, 3e-3, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, (1 + s) * weight)),
    Fault("weights.discrete", "probability of a single direction too small", 5e-3, 5e-3, "sample",
          lambda s: lambda bs, weight, u, ctx: (scaled(bs, pdf=1 - s), weight), {"type": "conductor"}),
    Fault("eval_pdf.value", "value of eval_pdf() too large in one channel", 1e-4, 1e-4, "pair",
          lambda s: lambda pair, ctx, wi, wo: (pair[0] * mi.Color3f(1 + s, 1, 1), pair[1])),
    Fault("eval_pdf.density", "density of eval_pdf() too large", 2e-4, 2e-4, "pair",
          lambda s: lambda pair, ctx, wi, wo: (pair[0], (1 + s) * pair[1]), GLOSS),
    Fault("energy.largest", "albedo above 1", 0.01, 0.01, "value",
          lambda s: lambda value, ctx, wi, wo: 2 * (1 + s) * value),
    Fault("energy.apart", "value of eval() too large", 0.02, 0.02, "eval",
          lambda s: lambda value, ctx, wi, wo: (1 + s) * value),
    Fault("reciprocity.swapped", "value that grows with the cosine of wi", 3e-3, 3e-3, "value",
          lambda s: lambda value, ctx, wi, wo: value * (1 + s * wi.z)),
    Fault("reciprocity.modes", "more light in the mode of importance", 3e-3, 3e-3, "value",
          lambda s: lambda value, ctx, wi, wo: value * (1 + s * (ctx.mode == mi.TransportMode.Importance))),
    Fault("reciprocity.medium", "index of refraction of reflected light", 3e-7, 3e-7, "sample",
          lambda s: lambda bs, weight, u, ctx: (scaled(bs, eta=1 + s), weight)),
    Fault("reciprocity.single", "more light through glass from one side", 3e-3, 3e-3, "value",
          lambda s: lambda value, ctx, wi, wo: value * (1 + s * (wi.z > 0)), GLASS),
    Fault("reciprocity.single_modes", "more light through glass in the mode of importance", 3e-3, 3e-3,
          "value", lambda s: lambda value, ctx, wi, wo:
              value * (1 + s * (ctx.mode == mi.TransportMode.Importance)), GLASS),
    Fault("finite.samples", "NaN for a share of the random numbers, at their end", 1e-6, 1e-6, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, dr.select(u.x > 1 - s, dr.nan, weight))),
    Fault("finite.values", "negative value where both cosines are so near to 1", 1e-6, 1e-6, "value",
          lambda s: lambda value, ctx, wi, wo: dr.select(dr.minimum(wi.z, wo.z) > 1 - s, -1, 1) * value),
    Fault("roundoff.lost", "stairs on a slope, of this height", 3e-4, 3e-4, "value",
          lambda s: lambda value, ctx, wi, wo: _stairs(value, wi.z * wo.z, s)),
    Fault("gradients.values", "derivative of values too large", 0.03, 0.03, "value",
          lambda s: lambda value, ctx, wi, wo: value + s * (value - dr.detach(value)), GLOSS),
    Fault("gradients.weights", "derivative of weights too large", 0.03, 0.03, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, weight + s * (weight - dr.detach(weight))), GLOSS),
    Fault("components.sum", "a component brighter than its share", 1e-4, 1e-4, "eval",
          lambda s: lambda value, ctx, wi, wo: value * (1 + s * (ctx.component == 0))),
    Fault("variants.same", "values larger in scalar variants", 3e-3, 3e-3, "value",
          lambda s: lambda value, ctx, wi, wo: value if dr.is_jit_v(value) else (1 + s) * value),
    Fault("hits.ray_test", "ray_test() misses in this share of directions", 1e-5, 1e-5, "shape",
          lambda s: {"test": lambda found, ray: found & (ray.d.x < 1 - 2 * s)}),
    Fault("surface.on_ray", "hit points off the ray, in sizes", 1e-5, 1e-5, "shape",
          lambda s: {"hit": moved(p=lambda si, ray: si.p + SIZE * s * si.n)}),
    Fault("surface.near_by", "hit points off, in sizes", 1e-6, 1e-6, "shape",
          lambda s: {"hit": moved(p=lambda si, ray: si.p + SIZE * s * si.n)}),
    Fault("surface.behind", "hits too far away, in sizes", 1e-6, 1e-6, "shape",
          lambda s: {"hit": moved(t=lambda si, ray: si.t + SIZE * s,
                                  p=lambda si, ray: si.p + SIZE * s * ray.d)}),
    Fault("surface.missed", "a least distance for this share of directions", 3e-3, 3e-3, "shape",
          lambda s: {"hit": moved(
              t=lambda si, ray: dr.select((si.t < 0.01) & (ray.d.x > 1 - 2 * s), dr.inf, si.t))}),
    Fault("normals.outwards", "normals inwards on this share of most faces", 3e-3, 3e-3, "shape",
          lambda s: {"hit": moved(n=lambda si, ray: dr.select(
              (si.p.x > 1 - 2 * s) & (si.n.x < 0.5), -1, 1) * si.n)}),
    Fault("normals.length", "normals too long", 3e-5, 3e-5, "shape",
          lambda s: {"hit": moved(n=lambda si, ray: (1 + s) * si.n)}),
    Fault("normals.slant", "normals tilted, in radians", 3e-3, 3e-3, "shape",
          lambda s: {"hit": moved(n=lambda si, ray: tilted(si.n, s))}),
    Fault("normals.slope", "normals tilted as well as derivatives, in radians", 0.03, 0.03, "shape",
          lambda s: {"hit": moved(n=lambda si, ray: tilted(si.n, s))}),
    Fault("normals.shading", "shading normals tilted, in radians", 3e-3, 3e-3, "shape",
          lambda s: {"hit": moved(shading=lambda si, ray: tilted(si.sh_frame.n, s))}),
    Fault("normals.step", "dp_du too long", 0.02, 0.02, "shape",
          lambda s: {"hit": moved(dp_du=lambda si, ray: (1 + s) * si.dp_du)}),
    Fault("watertight.out", "a slit of this width, in sizes", 1e-4, 3e-5, "shape",
          lambda s: {"hit": moved(
              t=lambda si, ray: dr.select(dr.abs(si.p.x - 0.3) < SIZE * s / 2, dr.inf, si.t))}),
    Fault("watertight.odd", "a slit of this width in one face, in sizes", 6e-3, 6e-3, "shape",
          lambda s: {"hit": moved(t=lambda si, ray: dr.select(
              (dr.abs(si.p.x - 0.3) < SIZE * s / 2) & (si.n.z > 0.5), dr.inf, si.t))}),
    Fault("far.missed", "hits off by this part of a distance above a thousand", 1e-5, 1e-5, "shape",
          lambda s: {"hit": moved(p=lambda si, ray: dr.select(si.t > 1000, si.p + s * si.t * si.n, si.p))}),
    Fault("far.missed", "misses from afar in this share of directions", 3e-3, 3e-3, "shape",
          lambda s: {"hit": moved(
              t=lambda si, ray: dr.select((si.t > 1000) & (ray.d.x > 1 - 2 * s), dr.inf, si.t))}),
    Fault("finite.bad", "NaN where a component of the direction is so small", 1e-12, 1e-12, "shape",
          lambda s: {"hit": moved(uv=lambda si, ray: dr.select(dr.abs(ray.d.x) < s, dr.nan, si.uv))}),
    Fault("sampling.crossings", "area too large, and the density of positions too small", 0.02, 0.01, "shape",
          lambda s: {"area": lambda area: (1 + s) * area, "pdf_position": lambda pdf: pdf / (1 + s),
                     "position": moved(pdf=lambda ps, u: ps.pdf / (1 + s))}),
    Fault("sampling.area", "surface_area() too large", 3e-3, 3e-3, "shape",
          lambda s: {"area": lambda area: (1 + s) * area}),
    Fault("sampling.position", "pdf_position() too large", 3e-3, 3e-3, "shape",
          lambda s: {"pdf_position": lambda pdf: (1 + s) * pdf}),
    Fault("sampling.spread", "positions crowded to one side: u to the power of 1 and this", 0.1, 0.03,
          "shape",
          lambda s: {"first": 1 + s}, {"type": "rectangle"}),
    Fault("sampling.off", "positions off the surface, in sizes", 1e-5, 1e-5, "shape",
          lambda s: {"position": moved(p=lambda ps, u: ps.p + SIZE * s * ps.n)}),
    Fault("sampling.normal", "normals of positions tilted, in radians", 0.1, 0.1, "shape",
          lambda s: {"position": moved(n=lambda ps, u: tilted(ps.n, s))}),
    Fault("sampling.direction", "pdf_direction() too large", 0.02, 0.02, "shape",
          lambda s: {"pdf_direction": lambda pdf: (1 + s) * pdf}),
    Fault("sampling.misses", "distances too short for this share of directions", 0.02, 0.02, "shape",
          lambda s: {"direction": moved(dist=lambda ds, u: ds.dist * dr.select(u.x < s, 0.99, 1))}),
    Fault("sampling.angle", "density of directions too small", 0.1, 0.03, "shape",
          lambda s: {"pdf_direction": lambda pdf: pdf / (1 + s),
                     "direction": moved(pdf=lambda ds, u: ds.pdf / (1 + s))}),
    Fault("bbox.outside", "a box too small above, in sizes", 3e-5, 3e-5, "shape",
          lambda s: {"bbox": lambda box: mi.BoundingBox3f(box.min, (1 - 2 * s) * box.max)}),
    Fault("bbox.outside", "a box too small below, in sizes", 3e-5, 3e-5, "shape",
          lambda s: {"bbox": lambda box: mi.BoundingBox3f((1 - 2 * s) * box.min, box.max)}),
)  # fmt: skip


FACTORS = (3, 2, 1, 0.5, 0.3, 0.1)  # of the size that is stated


def least_found(fault: Fault, changes: dict[str, Any], *, quick: bool) -> float:
    """Return the least size down to which a fault is found, by steps; infinity for none."""
    least = np.inf
    for size in (factor * (fault.quick if quick else fault.full) for factor in FACTORS):
        if np.isinf(size) or not check(fault, size, changes, quick=quick).failed:
            break
        least = size
    return float(least)


def check(fault: Fault, size: float, changes: dict[str, Any], *, quick: bool) -> Check:
    """Check a plugin with a fault of a size by its law; ``changes``: those of the registered BSDF."""
    if fault.kind == "shape":
        changed = ChangedShape(fault.nested, **fault.change(size))
        return check_shape(changed, only=[fault.law], quick=quick)
    nested = fault.nested or DIFFUSE
    name = f"{fault.what} {size}"
    changes[name] = (nested, fault.kind, fault.change(size))
    given = {"type": "changed", "change": name, "nested": nested}
    return check_bsdf(given, only=[fault.law], quick=quick)


if __name__ == "__main__":  # the table of docs/check_your_plugin.md; inf: none was found
    registered: dict[str, Any] = {}
    for variant in (runtime.SLOW, runtime.FAST):
        runtime.use(variant)
        mi.register_bsdf("changed", changed_bsdf(registered))
    print("| law | for a | fault | quick | full |\n|---|---|---|---|---|")
    for fault in FAULTS:
        least = [least_found(fault, registered, quick=quick) for quick in (True, False)]
        kind = "shape" if fault.kind == "shape" else "BSDF"
        print(f"| {fault.law} | {kind} | {fault.what} | {least[0]:.1g} | {least[1]:.1g} |", flush=True)
