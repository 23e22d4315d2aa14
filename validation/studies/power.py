"""The power of the laws: for each, the least of faults of many sizes that it finds, quick and in full.

A new row is a call at the end, with a function of the fault's size and of what it changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.checks.bsdf import check_bsdf
from mrt_mitsuba.validation.checks.emitter import check_emitter
from mrt_mitsuba.validation.checks.law import Check, Description
from mrt_mitsuba.validation.checks.shape import check_shape

Change = Callable[..., Any]  # makes a wrong answer of a plugin's: numbers, or a record of some
Changes = tuple[Description, str, Any]  # the BSDF that is changed, the kind of change, and the change


def unchanged(value, *_):
    return value


AS_IS: Changes = ({}, "", unchanged)


def changed_bsdf(changes):
    """A class of BSDFs whose answers are those of another, changed: for ``register_bsdf``.

    ``changes``: by name, the dict of the BSDF, what is changed, and a function: of (value, ctx, wi, wo) for
    "eval", "pdf", what eval_pdf() alone gives ("pair"), or values and weights ("value"); of (bs, weight, u,
    ctx) for "sample"; of the random numbers u for "u"; of ctx for "context". "flags" are added, to components
    as well or to the "whole" alone; "active" is overlooked; an "update" adds a component.
    """

    class Changed(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.nested = props["nested"]
            _, self.kind, self.change = changes.get(props["change"], AS_IS)[:3]
            more = self.change if self.kind == "flags" else 0
            count = self.nested.component_count()
            self.m_components = [int(self.nested.flags(i)) | more for i in range(count)]
            self.m_flags = int(self.nested.flags())
            if self.kind in ("flags", "whole"):
                self.m_flags |= self.change

        def traverse(self, callback):
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            if self.kind == "update":
                self.m_components = [*self.m_components, self.m_flags]

        def changed(self, kinds, value, *where):
            return self.change(value, *where) if self.kind in kinds else value

        def eval(self, ctx, si, wo, active=True):
            asked = self.changed(("context",), ctx)
            value = self.nested.eval(asked, si, wo, True if self.kind == "active" else active)
            return self.changed(("eval", "value"), value, ctx, si.wi, wo)

        def pdf(self, ctx, si, wo, active=True):
            asked = self.changed(("context",), ctx)
            return self.changed(("pdf",), self.nested.pdf(asked, si, wo, active), ctx, si.wi, wo)

        def eval_pdf(self, ctx, si, wo, active=True):
            pair = self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)
            return self.changed(("pair",), pair, ctx, si.wi, wo)

        def sample(self, ctx, si, sample1, sample2, active=True):
            asked = self.changed(("context",), ctx)
            u = self.changed(("u",), sample2)
            bs, weight = self.nested.sample(asked, si, sample1, u, active)
            weight = self.changed(("value",), weight, ctx, si.wi, bs.wo)
            if self.kind == "sample":
                return self.change(bs, weight, sample2, ctx)
            return bs, weight

        def to_string(self):
            return f"Changed[{self.kind}]"

    return Changed


TRACED = ("ray_intersect", "ray_test", "bbox")
SAMPLED = ("surface_area", "sample_position", "pdf_position", "sample_direction", "pdf_direction")


class ChangedShape:
    """A shape some of whose methods are changed: functions of what they return and of their arguments."""

    def __init__(self, given=None, **changes):
        self.shape = mi.load_dict(given or {"type": "cube"})
        self.scene = mi.load_dict({"type": "scene", "shape": self.shape})
        self.changes = changes

    def __getattr__(self, name):
        if name not in TRACED + SAMPLED:
            raise AttributeError(name)
        sound = getattr(self.scene if name in TRACED else self.shape, name)
        change = self.changes.get(name, unchanged)

        def method(*given):
            return change(sound(*given), *given)

        return method


def changed_sky(changes):
    """A class of emitters, constant all around but for changes of what its methods return.

    ``changes``: functions of the samples of directions and their random numbers ("direction"), of their
    weights and these ("weight"), of densities and the directions ("pdf"), of what eval_direction() ("value")
    and eval() ("seen") return.
    """

    def changed(kind, value, *more):
        return changes[kind](value, *more) if kind in changes else value

    class Sky(mi.Emitter):
        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.m_flags = mi.EmitterFlags.Infinite
            self.sound = mi.load_dict({"type": "constant"})

        def eval(self, si, active=True):
            return changed("seen", self.sound.eval(si, active))

        def sample_direction(self, it, sample, active=True):
            ds, weight = self.sound.sample_direction(it, sample, active)
            ds.emitter = mi.EmitterPtr(self)
            return changed("direction", ds, sample), changed("weight", weight, sample)

        def pdf_direction(self, it, ds, active=True):
            return changed("pdf", self.sound.pdf_direction(it, ds, active), ds)

        def eval_direction(self, it, ds, active=True):
            return changed("value", self.sound.eval_direction(it, ds, active))

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return "Sky"

    return Sky


def put(record, **members):
    """A hit or a sample with other values of some members."""
    for name, value in members.items():
        setattr(record, name, value)
    return record


@dataclass(frozen=True)
class Fault:
    """A fault in words, with the figure of a law that should find it.

    ``full`` and ``quick``: the least size that such checks find, as docs/check_your_plugin.md states.
    ``changes``: by a kind of ``changed_bsdf`` or ``changed_sky``, or methods of ``ChangedShape``, functions
    of the size and of what is changed; ``nested``: what is changed, if not a diffuse BSDF or a cube.
    """

    kind: str  # "BSDF", "shape" or "emitter"
    figure: str
    what: str
    full: float
    changes: Mapping[str, Change]
    quick: float | None = None  # as in full
    nested: Description | None = None

    @property
    def least_quick(self) -> float:
        return self.full if self.quick is None else self.quick

    def check(self, size: float, *, quick: bool) -> Check:
        """Check a plugin with the fault by the law of its figure. Needs ``register``."""
        changes = {kind: partial(change, size) for kind, change in self.changes.items()}
        only = [self.figure.split(".")[0]]
        if self.kind == "shape":
            return check_shape(ChangedShape(self.nested, **changes), only=only, quick=quick)
        if self.kind == "emitter":
            mi.register_emitter("faulty_sky", changed_sky(changes))
            return check_emitter({"type": "faulty_sky"}, only=only, quick=quick)
        nested = self.nested or {"type": "diffuse"}
        name = f"{self.what} {size}"
        ((kind, change),) = changes.items()
        FAULTY[name] = (nested, kind, change)
        return check_bsdf({"type": "faulty", "change": name, "nested": nested}, only=only, quick=quick)

    def least_found(self, *, quick: bool) -> float:
        """The least size that fails, tried from three times that in the table down; infinity for none."""
        least = np.inf
        for factor in FACTORS:
            size = factor * (self.least_quick if quick else self.full)
            if np.isinf(size) or not self.check(size, quick=quick).failed:
                break
            least = size
        return float(least)


FACTORS = (3, 2, 1, 0.5, 0.3, 0.1)
FAULTY: dict[str, Changes] = {}  # by name, the changes of the BSDF "faulty"


def register(*variants: str) -> None:
    """Register the BSDF "faulty" in variants; the last one becomes current."""
    for variant in variants:
        runtime.use(variant)
        mi.register_bsdf("faulty", changed_bsdf(FAULTY))


GLASS = {"type": "dielectric"}
GLOSS = {"type": "roughconductor", "alpha": 0.2}
SIZE = 2 * 3**0.5  # of the cube: its diagonal
DEGREE = 0.01745
PLACE = (0.48, 0.36, 0.8)  # a direction away from all axes

# ------------------------------------ Changes, of a size and a value -----------------------------------


def larger(size, value, *_):
    return (1 + size) * value


def smaller(size, value, *_):
    return value / (1 + size)


def member(name, change):
    """A change of a member of a record; what comes with the record stays."""

    def apply(size, record, *given):
        return put(record, **{name: change(size, getattr(record, name))})

    return apply


def of_sample(change):
    """A change of records as one of the samples of a BSDF, whose weight stays."""

    def apply(size, bs, weight, *_):
        return change(size, bs), weight

    return apply


def of_weight(change):
    """A change of the weights of samples of a BSDF, by their random numbers."""

    def apply(size, bs, weight, u, _):
        return bs, change(size, weight, u)

    return apply


def in_tenth(size, pdf, ctx, wi, wo):
    """Larger where a tenth of the samples of a diffuse BSDF go."""
    return pdf * dr.select(wo.x > 0.687, 1 + size, 1)


def in_cone(size, pdf, ctx, wi, wo):
    inside = dr.norm(wo - mi.Vector3f(PLACE)) < DEGREE
    return pdf * dr.select(inside, 1 - min(size, 0.9), 1)


def no_density(size, pdf, ctx, wi, wo):
    """0 in a slice of azimuth, so many degrees wide."""
    azimuth = dr.atan2(wo.y, wo.x)
    return dr.select((azimuth > 1) & (azimuth < 1 + size * DEGREE), 0, pdf)


def around_slice(size, bs):
    """Samples of a diffuse BSDF that keep out of a slice of azimuth, so many degrees wide."""
    azimuth = dr.atan2(bs.wo.y, bs.wo.x)
    slice_ = size * DEGREE
    squeezed = 1 + slice_ + (azimuth + dr.pi) * (1 - slice_ / (2 * dr.pi))
    radius = dr.hypot(bs.wo.x, bs.wo.y)
    wo = mi.Vector3f(radius * dr.cos(squeezed), radius * dr.sin(squeezed), bs.wo.z)
    return put(bs, wo=wo)


def stairs_of(size, u):
    """Random numbers in steps."""
    return mi.Point2f(dr.floor(u.x / size) * size, u.y)


def no_number(size, weight, u):
    """NaN for a share of the random numbers."""
    return dr.select((u.x > 0.3) & (u.x < 0.3 + size), dr.nan, weight)


def no_number_at_the_end(size, weight, u):
    return dr.select(u.x > 1 - size, dr.nan, weight)


def weight_in_stairs(size, weight, u):
    odd = dr.floor(16 * u.x) - 2 * dr.floor(8 * u.x)
    return weight * (1 + size * odd)


def first_channel(size, pair, *_):
    value, pdf = pair
    return value * mi.Color3f(1 + size, 1, 1), pdf


def density_of_pair(size, pair, *_):
    value, pdf = pair
    return value, (1 + size) * pdf


def too_bright(size, value, *_):
    """A diffuse BSDF of albedo 0.5 that reflects more than arrives."""
    return 2 * (1 + size) * value


def with_cosine(size, value, ctx, wi, wo):
    return value * (1 + size * wi.z)


def from_one_side(size, value, ctx, wi, wo):
    return value * (1 + size * (wi.z > 0))


def by_mode(size, value, ctx, *_):
    """Larger in the mode of importance."""
    return value * (1 + size * (ctx.mode == mi.TransportMode.Importance))


def by_component(size, value, ctx, *_):
    return value * (1 + size * (ctx.component == 0))


def by_mask(size, value, ctx, *_):
    """Larger where lobes are asked for by their types."""
    every = mi.BSDFContext().type_mask
    return value * (1 + size * (ctx.type_mask != every))


def without_mask(size, ctx):
    """The types of lobes are ignored, whatever the size."""
    other = mi.BSDFContext()
    other.mode = ctx.mode
    other.component = ctx.component
    return other


def by_variant(size, value, *_):
    """Larger in scalar variants."""
    return value if dr.is_jit_v(value) else (1 + size) * value


def negative_next_to_normal(size, value, ctx, wi, wo):
    return dr.select(dr.minimum(wi.z, wo.z) > 1 - size, -1, 1) * value


def stairs_on_slope(size, value, ctx, wi, wo):
    slope = wi.z * wo.z / size
    return value * (1 + size * (dr.round(slope) - slope))


def steeper(size, value, *_):
    """The same number, with a larger derivative."""
    return value + size * (value - dr.detach(value))


def tilted(size, n):
    """Normals tilted by an angle."""
    return dr.normalize(n + size * mi.Normal3f(0.6, 0.48, 0.64))


def tilted_frame(size, frame):
    return mi.Frame3f(tilted(size, frame.n))


def off_surface(size, record, *_):
    return put(record, p=record.p + SIZE * size * record.n)


def too_far(size, si, ray):
    return put(si, t=si.t + SIZE * size, p=si.p + SIZE * size * ray.d)


def off_from_afar(size, si, ray):
    return put(si, p=dr.select(si.t > 1000, si.p + size * si.t * si.n, si.p))


def in_share(size, ray):
    """Rays of a share of the directions."""
    return ray.d.x > 1 - 2 * size


def missed_in_share(size, met, ray):
    return met & ~in_share(size, ray)


def missed(where):
    """A change of hits that are missed in some places."""

    def apply(size, si, ray):
        return put(si, t=dr.select(where(size, si, ray), dr.inf, si.t))

    return apply


def close(size, si, ray):
    return (si.t < 0.01) & in_share(size, ray)


def afar(size, si, ray):
    return (si.t > 1000) & in_share(size, ray)


def slit(size, si, ray):
    return dr.abs(si.p.x - 0.3) < SIZE * size / 2


def slit_above(size, si, ray):
    return slit(size, si, ray) & (si.n.z > 0.5)


def inwards(size, si, ray):
    turned = (si.p.x > 1 - 2 * size) & (si.n.x < 0.5)
    return put(si, n=dr.select(turned, -1, 1) * si.n)


def no_number_along_axis(size, si, ray):
    return put(si, uv=dr.select(dr.abs(ray.d.x) < size, dr.nan, si.uv))


def no_number_in_place(size, si, ray):
    """NaN for about a share of the rays, in one direction."""
    inside = (ray.d.x > 0.3) & (ray.d.x < 0.3 + 2 * size)
    return put(si, uv=dr.select(inside, dr.nan, si.uv))


def crowded(size, ps, time, u):
    """Positions on a square, crowded to one side."""
    return put(ps, p=mi.Point3f(2 * u.x ** (1 + size) - 1, ps.p.y, 0))


def crowded_azimuth(size, ps, time, u):
    """Positions on a unit sphere, crowded to one azimuth."""
    azimuth = 2 * dr.pi * u.y ** (1 + size)
    radius = dr.hypot(ps.p.x, ps.p.y)
    p = mi.Point3f(radius * dr.cos(azimuth), radius * dr.sin(azimuth), ps.p.z)
    return put(ps, p=p, n=mi.Normal3f(p))


def crowded_directions(size, ds, it, u):
    """Directions turned around the one to the middle, to crowd at one azimuth."""
    frame = mi.Frame3f(dr.normalize(-mi.Vector3f(it.p)))
    local = frame.to_local(ds.d)
    turn = dr.atan2(local.y, local.x) / (2 * dr.pi) + 0.5
    azimuth = 2 * dr.pi * turn ** (1 + size)
    radius = dr.hypot(local.x, local.y)
    d = frame.to_world(mi.Vector3f(radius * dr.cos(azimuth), radius * dr.sin(azimuth), local.z))
    return put(ds, d=d, p=it.p + ds.dist * d)


def too_short(size, ds, it, u):
    return put(ds, dist=ds.dist * dr.select(u.x < size, 0.99, 1))


def lower_top(size, box):
    return mi.BoundingBox3f(box.min, (1 - 2 * size) * box.max)


def higher_bottom(size, box):
    return mi.BoundingBox3f((1 - 2 * size) * box.min, box.max)


def in_hole(size, d):
    """Directions in a cone, so many degrees across."""
    return dr.norm(d - mi.Vector3f(PLACE)) < size * DEGREE / 2


def around_hole(size, ds, u):
    """Directions that are never in a cone: they go the other way."""
    d = dr.select(in_hole(size, ds.d), -ds.d, ds.d)
    return put(ds, p=ds.p + ds.dist * (d - ds.d), d=d)


def no_density_in_hole(size, pdf, ds):
    return dr.select(in_hole(size, ds.d), 0, pdf)


def no_density_of_sample(size, ds, u):
    ds = around_hole(size, ds, u)
    return put(ds, pdf=no_density_in_hole(size, ds.pdf, ds))


# ------------------------------------------------ Faults ----------------------------------------------


FAULTS: list[Fault] = []


def add_fault(kind, figure, what, full, *, quick=None, nested=None, **changes):
    """Add a fault that changes some answers of a kind of plugins."""
    FAULTS.append(Fault(kind, figure, what, full, changes, quick, nested))


bsdf_fault = partial(add_fault, "BSDF")
shape_fault = partial(add_fault, "shape")
sky_fault = partial(add_fault, "emitter")  # of a constant sky

larger_pdf = of_sample(member("pdf", larger))
smaller_pdf = of_sample(member("pdf", smaller))
larger_eta = of_sample(member("eta", larger))
tilted_normal = member("n", tilted)

# Samples of BSDFs
bsdf_fault(
    "sampling.cells",
    "density too large where a tenth of the samples go",
    0.03,
    quick=0.1,
    pdf=in_tenth,
)
bsdf_fault("sampling.small", "density too small in a cone of 1 degree", 0.5, quick=np.inf, pdf=in_cone)
bsdf_fault(
    "sampling.slices",
    "samples keep out of a slice of azimuth, in degrees",
    0.3,
    quick=np.inf,
    sample=of_sample(around_slice),
)
bsdf_fault("sampling.dark", "no density in a slice of azimuth, in degrees", 0.3, pdf=no_density)
bsdf_fault("sampling.still", "directions in stairs, in random numbers", 1e-5, u=stairs_of)
bsdf_fault("sampling.integral", "density too large everywhere", 0.01, pdf=larger)
bsdf_fault("weights.density", "density that a sample states too large", 3e-3, sample=larger_pdf)
bsdf_fault("weights.weight", "weight of a sample too large", 3e-3, sample=of_weight(larger))
bsdf_fault("weights.weight", "weight of a sample in stairs", 3e-3, sample=of_weight(weight_in_stairs))
bsdf_fault(
    "weights.discrete",
    "probability of a single direction too small",
    5e-3,
    nested={"type": "conductor"},
    sample=smaller_pdf,
)
bsdf_fault(
    "finite.samples",
    "NaN for a share of the random numbers, at their end",
    1e-6,
    sample=of_weight(no_number_at_the_end),
)
bsdf_fault(
    "finite.million",
    "NaN for a share of the random numbers, anywhere",
    1e-6,
    quick=4e-6,
    sample=of_weight(no_number),
)

# Values of BSDFs
bsdf_fault("eval_pdf.value", "value of eval_pdf() too large in one channel", 1e-4, pair=first_channel)
bsdf_fault("eval_pdf.density", "density of eval_pdf() too large", 2e-4, nested=GLOSS, pair=density_of_pair)
bsdf_fault("energy.largest", "albedo above 1", 0.01, value=too_bright)
bsdf_fault("energy.apart", "value of eval() too large", 0.02, eval=larger)
bsdf_fault("reciprocity.swapped", "value that grows with the cosine of wi", 3e-3, value=with_cosine)
bsdf_fault("reciprocity.modes", "more light in the mode of importance", 3e-3, value=by_mode)
bsdf_fault("reciprocity.medium", "index of refraction of reflected light", 3e-7, sample=larger_eta)
bsdf_fault(
    "reciprocity.single",
    "more light through glass from one side",
    3e-3,
    nested=GLASS,
    value=from_one_side,
)
bsdf_fault(
    "reciprocity.single_modes",
    "more light through glass in the mode of importance",
    3e-3,
    nested=GLASS,
    value=by_mode,
)
bsdf_fault(
    "finite.values",
    "negative value where both cosines are so near to 1",
    1e-6,
    value=negative_next_to_normal,
)
bsdf_fault("roundoff.lost", "stairs on a slope, of this height", 3e-4, value=stairs_on_slope)
bsdf_fault("gradients.values", "derivative of values too large", 0.03, nested=GLOSS, value=steeper)
bsdf_fault(
    "gradients.weights",
    "derivative of weights too large",
    0.03,
    nested=GLOSS,
    sample=of_weight(steeper),
)
bsdf_fault("components.sum", "a component brighter than its share", 1e-4, eval=by_component)
bsdf_fault("components.masked", "lobes brighter where they are asked for by type", 1e-4, eval=by_mask)
bsdf_fault("components.masked_samples", "types of lobes ignored", 1, context=without_mask)
bsdf_fault("variants.same", "values larger in scalar variants", 3e-3, value=by_variant)

# Hits of shapes
shape_fault(
    "hits.ray_test",
    "ray_test() misses in this share of directions",
    1e-5,
    ray_test=missed_in_share,
)
shape_fault("surface.on_ray", "hit points off the ray, in sizes", 1e-5, ray_intersect=off_surface)
shape_fault("surface.near_by", "hit points off, in sizes", 5e-7, ray_intersect=off_surface)
shape_fault("surface.behind", "hits too far away, in sizes", 5e-7, ray_intersect=too_far)
shape_fault(
    "surface.missed",
    "a least distance for this share of directions",
    3e-3,
    ray_intersect=missed(close),
)
shape_fault("normals.outwards", "normals inwards on this share of most faces", 3e-3, ray_intersect=inwards)
shape_fault("normals.length", "normals too long", 3e-5, ray_intersect=member("n", larger))
shape_fault("normals.slant", "normals tilted, in radians", 3e-3, ray_intersect=tilted_normal)
shape_fault(
    "normals.slope",
    "normals tilted as well as derivatives, in radians",
    0.03,
    ray_intersect=tilted_normal,
)
shape_fault(
    "normals.shading",
    "shading normals tilted, in radians",
    3e-3,
    ray_intersect=member("sh_frame", tilted_frame),
)
shape_fault("normals.step", "dp_du too long", 0.02, ray_intersect=member("dp_du", larger))
shape_fault(
    "watertight.out",
    "a slit of this width, in sizes",
    3e-5,
    quick=1e-4,
    ray_intersect=missed(slit),
)
shape_fault(
    "watertight.odd",
    "a slit of this width in one face, in sizes",
    6e-3,
    ray_intersect=missed(slit_above),
)
shape_fault(
    "far.missed",
    "hits off by this part of a distance above a thousand",
    1e-5,
    ray_intersect=off_from_afar,
)
shape_fault(
    "far.missed",
    "misses from afar in this share of directions",
    3e-3,
    ray_intersect=missed(afar),
)
shape_fault(
    "finite.bad",
    "NaN where a component of the direction is so small",
    1e-12,
    ray_intersect=no_number_along_axis,
)
shape_fault(
    "finite.million",
    "NaN for a share of the rays",
    2e-6,
    quick=2e-5,
    ray_intersect=no_number_in_place,
)
shape_fault("bbox.outside", "a box too small above, in sizes", 3e-5, bbox=lower_top)
shape_fault("bbox.outside", "a box too small below, in sizes", 3e-5, bbox=higher_bottom)

# Samples of shapes
shape_fault(
    "sampling.crossings",
    "area too large, and the density of positions too small",
    0.01,
    quick=0.02,
    surface_area=larger,
    pdf_position=smaller,
    sample_position=member("pdf", smaller),
)
shape_fault("sampling.area", "surface_area() too large", 3e-3, surface_area=larger)
shape_fault("sampling.position", "pdf_position() too large", 3e-3, pdf_position=larger)
shape_fault(
    "sampling.spread",
    "positions crowded to one side: u to the power of 1 and this",
    0.03,
    quick=0.1,
    nested={"type": "rectangle"},
    sample_position=crowded,
)
shape_fault(
    "sampling.spread",
    "positions on a sphere crowded at one azimuth: u to the power of 1 and this",
    0.03,
    quick=0.1,
    nested={"type": "sphere"},
    sample_position=crowded_azimuth,
)
shape_fault("sampling.off", "positions off the surface, in sizes", 1e-5, sample_position=off_surface)
shape_fault("sampling.normal", "normals of positions tilted, in radians", 0.1, sample_position=tilted_normal)
shape_fault("sampling.direction", "pdf_direction() too large", 0.02, pdf_direction=larger)
shape_fault(
    "sampling.misses",
    "distances too short for this share of directions",
    0.02,
    sample_direction=too_short,
)
shape_fault(
    "sampling.aim",
    "directions to a sphere crowded at one azimuth: u to the power of 1 and this",
    0.05,
    quick=0.1,
    nested={"type": "sphere"},
    sample_direction=crowded_directions,
)
shape_fault(
    "sampling.angle",
    "density of directions too small",
    0.03,
    quick=0.2,
    pdf_direction=smaller,
    sample_direction=member("pdf", smaller),
)

# A sky
sky_fault(
    "sampling.small",
    "directions keep out of a cone, in degrees across",
    3,
    direction=around_hole,
)
sky_fault(
    "sampling.dark",
    "no density in a cone, in degrees across",
    3,
    direction=no_density_of_sample,
    pdf=no_density_in_hole,
)
sky_fault("density.same", "pdf_direction() too large", 3e-3, pdf=larger)
sky_fault("weights.weight", "weight of a sample too large", 3e-3, weight=larger)
sky_fault("finite.million", "NaN for a share of the random numbers", 1e-6, quick=4e-6, weight=no_number)


if __name__ == "__main__":  # the table of docs/check_your_plugin.md; inf: none was found
    register(runtime.SLOW, runtime.FAST)
    print("| law | for a | fault | quick | full |\n|---|---|---|---|---|")
    for fault in FAULTS:
        quick, full = (f"{fault.least_found(quick=quick):.1g}" for quick in (True, False))
        law = fault.figure.split(".")[0]
        print(f"| {law} | {fault.kind} | {fault.what} | {quick} | {full} |", flush=True)
