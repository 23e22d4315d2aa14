"""The power of the laws: for each, the least of faults of many sizes that it finds, quick and in full."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.checks.bsdf import check_bsdf
from mrt_mitsuba.validation.checks.shape import check_shape
from mrt_mitsuba.validation.tools.study import Study

TITLE = "The least faults that the laws of plugins find"

DIFFUSE, GLOSS = {"type": "diffuse"}, {"type": "roughconductor", "alpha": 0.2}
PLACE = (0.48, 0.36, 0.8)  # a direction away from all axes


def changed_bsdf(changes: Mapping[str, tuple[dict[str, Any], str, Any]]) -> type:
    """Return a class of BSDFs whose answers are those of another, changed: for ``register_bsdf``.

    ``changes``: by name, the dict of the BSDF, what is changed, and a function of it: "value" and "mode" of
    (value, wi, wo), "pdf" of (pdf, wi, wo), "eval", "pair" of the value, "sample" of (bs, weight, u, ctx).
    """

    class Changed(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.nested, name = props["nested"], props["change"]
            self.change: Any
            self.kind, self.change = changes[name][1:3] if name else ("", None)
            more = self.change if self.kind == "flags" else 0
            count = self.nested.component_count()
            self.m_components = [int(self.nested.flags(i)) | more for i in range(count)]
            self.m_flags = int(self.nested.flags()) | more

        def traverse(self, callback: Any) -> None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

        def changes(self, value: Any, ctx: Any, wi: Any, wo: Any) -> Any:
            alike = self.kind == "value" or (self.kind == "mode" and ctx.mode == mi.TransportMode.Importance)
            return self.change(value, wi, wo) if alike else value

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value = self.nested.eval(ctx, si, wo, True if self.kind == "active" else active)
            value = self.change(value) if self.kind == "eval" else value
            if self.kind == "part" and ctx.component == 0:
                value = self.change(value)
            return self.changes(value, ctx, si.wi, wo)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            pdf = self.nested.pdf(ctx, si, wo, active)
            return self.change(pdf, si.wi, wo) if self.kind == "pdf" else pdf

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value = self.eval(ctx, si, wo, active)
            return self.change(value) if self.kind == "pair" else value, self.pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            bs, weight = self.nested.sample(ctx, si, sample1, sample2, active)
            weight = self.changes(weight, ctx, si.wi, bs.wo)
            return self.change(bs, weight, sample2, ctx) if self.kind == "sample" else (bs, weight)

        def to_string(self) -> str:
            return f"Changed[{self.kind}]"

    return Changed


class ChangedShape:
    """A shape whose answers are changed: "hit" of (si, ray), "test" of (found, ray), "bbox" of the box.

    ``area``, ``first``: factors of the area, and a power of the first random number of positions.
    """

    def __init__(
        self, given: Any = None, *, area: float = 1.0, first: float = 1.0, **changes: Callable[..., Any]
    ) -> None:
        self.shape = mi.load_dict(given or {"type": "cube"})
        self.scene = mi.load_dict({"type": "scene", "shape": self.shape})
        self.area, self.first, self.changes = area, first, changes

    def ray_intersect(self, ray: Any) -> Any:
        si = self.scene.ray_intersect(ray)
        return self.changes["hit"](si, ray) if "hit" in self.changes else si

    def ray_test(self, ray: Any) -> Any:
        return self.changes.get("test", lambda found, ray: found)(self.scene.ray_test(ray), ray)

    def bbox(self) -> Any:
        return self.changes.get("bbox", lambda box: box)(self.scene.bbox())

    def surface_area(self) -> Any:
        return self.area * self.shape.surface_area()

    def sample_position(self, time: Any, sample: Any) -> Any:
        ps = self.shape.sample_position(time, mi.Point2f(sample.x**self.first, sample.y))
        ps.pdf /= self.area
        return ps

    def pdf_position(self, ps: Any) -> Any:
        return self.shape.pdf_position(ps) / self.area


@dataclass(frozen=True)
class Fault:
    """A fault in words, the law that should find it, its sizes from large to small, and what makes it."""

    law: str
    what: str
    sizes: Sequence[float]
    kind: str  # of ``changed_bsdf``, or "shape"
    change: Callable[[float], Any]  # of the size
    nested: dict[str, Any] | None = None


def _cone(wo: Any, sine: float) -> Any:
    return dr.norm(wo - mi.Vector3f(PLACE)) < sine


def _stairs(size: float) -> Any:
    def change(value: Any, wi: Any, wo: Any) -> Any:
        return value * (1 + size * (dr.round(wi.z * wo.z / size) - wi.z * wo.z / size))

    return change


def _moved(**values: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    def change(si: Any, ray: Any) -> Any:
        for name, value in values.items():
            setattr(si, name, value(si))
        return si

    return change


def _tilted(n: Any, size: float) -> Any:
    return dr.normalize(n + size * mi.Normal3f(0.6, 0.48, 0.64))


def _shading(size: float) -> Any:
    def change(si: Any, ray: Any) -> Any:
        si.sh_frame.n = _tilted(si.sh_frame.n, size)
        return si

    return change


PERCENTS = (0.1, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002)
SMALL = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
FAULTS: Sequence[Fault] = (
    Fault("sampling", "density too large where a tenth of the samples go", PERCENTS, "pdf",
          lambda s: lambda pdf, wi, wo: pdf * dr.select(wo.x > 0.687, 1 + s, 1)),
    Fault("sampling", "density too small in a cone of 1 degree", (0.9, 0.5, 0.3, 0.2, 0.1), "pdf",
          lambda s: lambda pdf, wi, wo: pdf * dr.select(_cone(wo, 0.01745), 1 - s, 1)),
    Fault("sampling", "density too large everywhere", PERCENTS, "pdf",
          lambda s: lambda pdf, wi, wo: (1 + s) * pdf),
    Fault("weights", "weight of a sample too large", SMALL, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, (1 + s) * weight)),
    Fault("eval_pdf", "value of eval_pdf() too large", SMALL, "pair",
          lambda s: lambda value: (1 + s) * value),
    Fault("energy", "albedo above 1", PERCENTS, "value",
          lambda s: lambda value, wi, wo: 2 * (1 + s) * value),
    Fault("energy", "value of eval() too large", PERCENTS, "eval", lambda s: lambda value: (1 + s) * value),
    Fault("reciprocity", "value that grows with the cosine of wi", SMALL, "value",
          lambda s: lambda value, wi, wo: value * (1 + s * wi.z)),
    Fault("reciprocity", "more light in the mode of importance", SMALL, "mode",
          lambda s: lambda value, wi, wo: (1 + s) * value),
    Fault("finite", "NaN for a share of the random numbers, at their end", SMALL, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, dr.select(u.x > 1 - s, dr.nan, weight))),
    Fault("roundoff", "stairs on a slope, of this height", SMALL, "value", _stairs),
    Fault("gradients", "derivative of values too large", PERCENTS, "value",
          lambda s: lambda value, wi, wo: value + s * (value - dr.detach(value))),
    Fault("gradients", "derivative of weights too large", PERCENTS, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, weight + s * (weight - dr.detach(weight)))),
    Fault("components", "a component brighter than its share", SMALL, "part",
          lambda s: lambda value: (1 + s) * value),
    Fault("variants", "values larger in scalar variants", SMALL, "value",
          lambda s: lambda value, wi, wo: value if dr.is_jit_v(value) else (1 + s) * value),
    Fault("hits", "ray_test() misses in this share of directions", SMALL, "shape",
          lambda s: {"test": lambda found, ray: found & (ray.d.x < 1 - 2 * s)}),
    Fault("surface", "hit points off, in sizes", SMALL, "shape",
          lambda s: {"hit": _moved(p=lambda si: si.p + 2 * 3**0.5 * s * si.n)}),
    Fault("surface", "hits too far away, in sizes", SMALL, "shape",
          lambda s: {"hit": lambda si, ray: _moved(t=lambda si: si.t + 2 * 3**0.5 * s,
                                                   p=lambda si: si.p + 2 * 3**0.5 * s * ray.d)(si, ray)}),
    Fault("normals", "normals tilted, in radians", SMALL, "shape",
          lambda s: {"hit": _moved(n=lambda si: _tilted(si.n, s))}),
    Fault("normals", "shading normals tilted, in radians", SMALL, "shape", lambda s: {"hit": _shading(s)}),
    Fault("normals", "dp_du too long", PERCENTS, "shape",
          lambda s: {"hit": _moved(dp_du=lambda si: (1 + s) * si.dp_du)}),
    Fault("watertight", "a slit of this width, in sizes", SMALL, "shape",
          lambda s: {"hit": _moved(t=lambda si: dr.select(dr.abs(si.p.x - 0.3) < 3**0.5 * s, dr.inf, si.t))}),
    Fault("far", "hits off by this part of a distance above a thousand", SMALL, "shape",
          lambda s: {"hit": lambda si, ray: _moved(
              p=lambda si: dr.select(si.t > 1000, si.p + s * si.t * si.n, si.p))(si, ray)}),
    Fault("finite", "NaN where a component of the direction is so small", (*SMALL, 1e-8, 1e-12), "shape",
          lambda s: {"hit": lambda si, ray: _moved(
              uv=lambda si: dr.select(dr.abs(ray.d.x) < s, dr.nan, si.uv))(si, ray)}),
    Fault("sampling", "area too large, and the density of positions too small", PERCENTS, "shape",
          lambda s: {"area": 1 + s}),
    Fault("sampling", "positions crowded to one side: u to the power of 1 and this", PERCENTS, "shape",
          lambda s: {"first": 1 + s}, {"type": "rectangle"}),
    Fault("bbox", "a box too small, in sizes", SMALL, "shape",
          lambda s: {"bbox": lambda box: mi.BoundingBox3f((1 - 2 * s) * box.min, (1 - 2 * s) * box.max)}),
)  # fmt: skip


def run(study: Study, *, quick: bool) -> None:
    """Look for the least size of each fault that is found; the largest must be, by a full check."""
    runtime.use(runtime.FAST)
    changes: dict[str, tuple[dict[str, Any], str, Any]] = {}
    before = mi.variant()
    for variant in (runtime.SLOW, before):
        mi.set_variant(variant)
        mi.register_bsdf("changed", changed_bsdf(changes))
    rows = []
    for fault in study.each("faults", FAULTS):
        least = [least_found(fault, changes, quick=True), np.nan if quick else least_found(fault, changes)]
        rows.append([fault.law, "shape" if fault.kind == "shape" else "BSDF", fault.what, *least])
        found = np.nanmin(least)
        name = f"{rows[-1][1]}, {fault.law}: {fault.what}"
        study.at_most(name, found, fault.sizes[0], "the largest that was tried must be found")
    note = "Sizes were tried in turn; the next smaller one was not found. inf: none was."
    study.table("power", TITLE, ["law", "of a", "fault", "least, quick", "least, in full"], rows, note)


def least_found(fault: Fault, changes: dict[str, Any], *, quick: bool = False) -> float:
    """Return the least size down to which a fault is found; infinity for none."""
    least = np.inf
    nested = GLOSS if fault.law == "gradients" else DIFFUSE
    for size in fault.sizes:
        if fault.kind == "shape":
            changed = ChangedShape(fault.nested, **fault.change(size))
            found = check_shape(changed, only=[fault.law], quick=quick)
        else:
            name = f"{fault.what} {size}"
            changes[name] = (nested, fault.kind, fault.change(size))
            given = {"type": "changed", "change": name, "nested": nested}
            found = check_bsdf(given, only=[fault.law], quick=quick)
        if not found.failed:
            break
        least = size
    return float(least)


if __name__ == "__main__":  # the table of docs/check_your_plugin.md
    shown = Study("power", TITLE)
    run(shown, quick="--quick" in sys.argv)
    for row in shown.tables["power"].rows:
        print("| " + " | ".join(str(value) for value in row) + " |")
