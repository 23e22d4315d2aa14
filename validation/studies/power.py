"""The power of the laws: for each, the least of faults of many sizes that it finds, quick and in full."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
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
DEGREE = 0.01745
AS_IS: tuple[dict[str, Any], str, Any] = ({}, "", lambda value, *_: value)


def changed_bsdf(changes: Mapping[str, tuple[dict[str, Any], str, Any]]) -> type:
    """Return a class of BSDFs whose answers are those of another, changed: for ``register_bsdf``.

    ``changes``: by name, the dict of the BSDF, what is changed, and a function: of (value, ctx, wi, wo) for
    "eval", "pdf", the value of eval_pdf() alone ("pair"), or values and weights ("value"); of (bs, weight, u,
    ctx) for "sample". "flags" are added; "active" is overlooked.
    """

    class Changed(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.nested, name = props["nested"], props["change"]
            _, self.kind, self.change = changes.get(name, AS_IS)[:3]
            more = self.change if self.kind == "flags" else 0
            count = self.nested.component_count()
            self.m_components = [int(self.nested.flags(i)) | more for i in range(count)]
            self.m_flags = int(self.nested.flags()) | more

        def traverse(self, callback: Any) -> None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

        def changed(self, kinds: Sequence[str], value: Any, *where: Any) -> Any:
            return self.change(value, *where) if self.kind in kinds else value

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value = self.nested.eval(ctx, si, wo, True if self.kind == "active" else active)
            return self.changed(("eval", "value"), value, ctx, si.wi, wo)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.changed(("pdf",), self.nested.pdf(ctx, si, wo, active), ctx, si.wi, wo)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value = self.changed(("pair",), self.eval(ctx, si, wo, active), ctx, si.wi, wo)
            return value, self.pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            bs, weight = self.nested.sample(ctx, si, sample1, sample2, active)
            weight = self.changed(("value",), weight, ctx, si.wi, bs.wo)
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

    def changed(self, kind: str, value: Any, *more: Any) -> Any:
        return self.changes[kind](value, *more) if kind in self.changes else value

    def ray_intersect(self, ray: Any) -> Any:
        return self.changed("hit", self.scene.ray_intersect(ray), ray)

    def ray_test(self, ray: Any) -> Any:
        return self.changed("test", self.scene.ray_test(ray), ray)

    def bbox(self) -> Any:
        return self.changed("bbox", self.scene.bbox())

    def surface_area(self) -> Any:
        return self.area * self.shape.surface_area()

    def sample_position(self, time: Any, sample: Any) -> Any:
        ps = self.shape.sample_position(time, mi.Point2f(sample.x**self.first, sample.y))
        ps.pdf /= self.area
        return ps

    def pdf_position(self, ps: Any) -> Any:
        return self.shape.pdf_position(ps) / self.area


def moved(**values: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Return a change of hits: members are functions of the hit and the ray. ``shading`` is that normal."""

    def change(si: Any, ray: Any) -> Any:
        for name, value in values.items():
            place, member = (si.sh_frame, "n") if name == "shading" else (si, name)
            setattr(place, member, value(si, ray))
        return si

    return change


def tilted(n: Any, size: float) -> Any:
    """Return normals tilted by an angle."""
    return dr.normalize(n + size * mi.Normal3f(0.6, 0.48, 0.64))


def _stairs(value: Any, cosines: Any, size: float) -> Any:
    return value * (1 + size * (dr.round(cosines / size) - cosines / size))


SIZE = 2 * 3**0.5  # of the cube: its diagonal
PERCENTS = (0.1, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002)
SMALL = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
# A fault: the law that should find it, in words, its sizes from large to small, what is changed (of
# ``changed_bsdf``, or "shape"), what makes it of a size, and which shape, if not a cube
FAULTS: Sequence[tuple[Any, ...]] = (
    ("sampling", "density too large where a tenth of the samples go", PERCENTS, "pdf",
          lambda s: lambda pdf, ctx, wi, wo: pdf * dr.select(wo.x > 0.687, 1 + s, 1)),
    ("sampling", "density too small in a cone of 1 degree", (0.9, 0.5, 0.3, 0.2, 0.1), "pdf",
          lambda s: lambda pdf, ctx, wi, wo: pdf * (1 - s * (dr.norm(wo - mi.Vector3f(PLACE)) < DEGREE))),
    ("sampling", "density too large everywhere", PERCENTS, "pdf",
          lambda s: lambda pdf, ctx, wi, wo: (1 + s) * pdf),
    ("weights", "weight of a sample too large", SMALL, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, (1 + s) * weight)),
    ("eval_pdf", "value of eval_pdf() too large", SMALL, "pair",
          lambda s: lambda value, ctx, wi, wo: (1 + s) * value),
    ("energy", "albedo above 1", PERCENTS, "value",
          lambda s: lambda value, ctx, wi, wo: 2 * (1 + s) * value),
    ("energy", "value of eval() too large", PERCENTS, "eval",
          lambda s: lambda value, ctx, wi, wo: (1 + s) * value),
    ("reciprocity", "value that grows with the cosine of wi", SMALL, "value",
          lambda s: lambda value, ctx, wi, wo: value * (1 + s * wi.z)),
    ("reciprocity", "more light in the mode of importance", SMALL, "value",
          lambda s: lambda value, ctx, wi, wo: value * (1 + s * (ctx.mode == mi.TransportMode.Importance))),
    ("finite", "NaN for a share of the random numbers, at their end", SMALL, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, dr.select(u.x > 1 - s, dr.nan, weight))),
    ("roundoff", "stairs on a slope, of this height", SMALL, "value",
          lambda s: lambda value, ctx, wi, wo: _stairs(value, wi.z * wo.z, s)),
    ("gradients", "derivative of values too large", PERCENTS, "value",
          lambda s: lambda value, ctx, wi, wo: value + s * (value - dr.detach(value))),
    ("gradients", "derivative of weights too large", PERCENTS, "sample",
          lambda s: lambda bs, weight, u, ctx: (bs, weight + s * (weight - dr.detach(weight)))),
    ("components", "a component brighter than its share", SMALL, "eval",
          lambda s: lambda value, ctx, wi, wo: value * (1 + s * (ctx.component == 0))),
    ("variants", "values larger in scalar variants", SMALL, "value",
          lambda s: lambda value, ctx, wi, wo: value if dr.is_jit_v(value) else (1 + s) * value),
    ("hits", "ray_test() misses in this share of directions", SMALL, "shape",
          lambda s: {"test": lambda found, ray: found & (ray.d.x < 1 - 2 * s)}),
    ("surface", "hit points off, in sizes", SMALL, "shape",
          lambda s: {"hit": moved(p=lambda si, ray: si.p + SIZE * s * si.n)}),
    ("surface", "hits too far away, in sizes", SMALL, "shape",
          lambda s: {"hit": moved(t=lambda si, ray: si.t + SIZE * s,
                                  p=lambda si, ray: si.p + SIZE * s * ray.d)}),
    ("normals", "normals tilted, in radians", SMALL, "shape",
          lambda s: {"hit": moved(n=lambda si, ray: tilted(si.n, s))}),
    ("normals", "shading normals tilted, in radians", SMALL, "shape",
          lambda s: {"hit": moved(shading=lambda si, ray: tilted(si.sh_frame.n, s))}),
    ("normals", "dp_du too long", PERCENTS, "shape",
          lambda s: {"hit": moved(dp_du=lambda si, ray: (1 + s) * si.dp_du)}),
    ("watertight", "a slit of this width, in sizes", SMALL, "shape",
          lambda s: {"hit": moved(
              t=lambda si, ray: dr.select(dr.abs(si.p.x - 0.3) < SIZE * s / 2, dr.inf, si.t))}),
    ("far", "hits off by this part of a distance above a thousand", SMALL, "shape",
          lambda s: {"hit": moved(p=lambda si, ray: dr.select(si.t > 1000, si.p + s * si.t * si.n, si.p))}),
    ("finite", "NaN where a component of the direction is so small", (*SMALL, 1e-8, 1e-12), "shape",
          lambda s: {"hit": moved(uv=lambda si, ray: dr.select(dr.abs(ray.d.x) < s, dr.nan, si.uv))}),
    ("sampling", "area too large, and the density of positions too small", PERCENTS, "shape",
          lambda s: {"area": 1 + s}),
    ("sampling", "positions crowded to one side: u to the power of 1 and this", PERCENTS, "shape",
          lambda s: {"first": 1 + s}, {"type": "rectangle"}),
    ("bbox", "a box too small, in sizes", SMALL, "shape",
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

    def finds(fault: tuple[Any, ...], size: float, quick: bool) -> bool:
        law, what, _, kind, change, *shape = fault
        if kind == "shape":
            return bool(check_shape(ChangedShape(*shape, **change(size)), only=[law], quick=quick).failed)
        nested, name = GLOSS if law == "gradients" else DIFFUSE, f"{what} {size}"
        changes[name] = (nested, kind, change(size))
        given = {"type": "changed", "change": name, "nested": nested}
        return bool(check_bsdf(given, only=[law], quick=quick).failed)

    rows = []
    for fault in study.each("faults", FAULTS):
        law, what, sizes, kind, *_ = fault
        least = []
        for fast in (True,) if quick else (True, False):
            found = list(takewhile(lambda size, fast=fast, fault=fault: finds(fault, size, fast), sizes))
            least.append(found[-1] if found else np.inf)
        rows.append([law, "shape" if kind == "shape" else "BSDF", what, *least])
        name = f"{rows[-1][1]}, {law}: {what}"
        study.at_most(name, min(least), sizes[0], "the largest that was tried must be found")
    note = "Sizes were tried in turn; the next smaller one was not found. inf: none was."
    columns = ["law", "of a", "fault", "least, quick", "least, in full"]
    study.table("power", TITLE, columns[: len(rows[0])], rows, note)


if __name__ == "__main__":  # the table of docs/check_your_plugin.md
    shown = Study("power", TITLE)
    run(shown, quick="--quick" in sys.argv)
    for row in shown.tables["power"]["rows"]:
        print("| " + " | ".join(str(value) for value in row) + " |")
