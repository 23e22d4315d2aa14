"""Plugins with mistakes that checks must find: what is changed of a sound one, and the figures it exceeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.plugins.microfacet import tan2_theta
from mrt_mitsuba.plugins.variants import is_jit, updatable
from mrt_mitsuba.validation.laws import bsdf, emitter, shape
from mrt_mitsuba.validation.laws.faults import GLOSS, put

MIRROR = {"type": "conductor"}


def unchanged(value, *_):
    return value


# --------------------- Plugins whose answers are those of sound ones, changed ---------------------


def changed_bsdf(kind="", change=unchanged):
    """A class of BSDFs whose answers are those of another, changed: for ``register_bsdf``.

    ``change`` is a function, by its kind: of (value, ctx, wi, wo) for "eval", "pdf", what eval_pdf() alone
    gives ("pair"), or values and weights ("value"); of (bs, weight, u, ctx) for "sample"; of what
    eval_null_transmission() gives for "null"; of the random numbers u for "u"; of ctx for "context". "flags"
    are added, to components as well or to the "whole" alone; "active" is overlooked; an "update" adds a
    component.
    """

    def changed(kinds, value, *where):
        return change(value, *where) if kind in kinds else value

    class Changed(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.nested = props["nested"]
            more = change if kind == "flags" else 0
            count = self.nested.component_count()
            self.m_components = [int(self.nested.flags(i)) | more for i in range(count)]
            self.m_flags = int(self.nested.flags())
            if kind in ("flags", "whole"):
                self.m_flags |= change

        def traverse(self, callback):
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            if kind == "update":
                self.m_components = [*self.m_components, self.m_flags]

        def eval(self, ctx, si, wo, active=True):
            asked = changed(("context",), ctx)
            value = self.nested.eval(asked, si, wo, True if kind == "active" else active)
            return changed(("eval", "value"), value, ctx, si.wi, wo)

        def pdf(self, ctx, si, wo, active=True):
            asked = changed(("context",), ctx)
            return changed(("pdf",), self.nested.pdf(asked, si, wo, active), ctx, si.wi, wo)

        def eval_pdf(self, ctx, si, wo, active=True):
            pair = self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)
            return changed(("pair",), pair, ctx, si.wi, wo)

        def eval_null_transmission(self, si, active=True):
            return changed(("null",), self.nested.eval_null_transmission(si, active))

        def sample(self, ctx, si, sample1, sample2, active=True):
            asked = changed(("context",), ctx)
            bs, weight = self.nested.sample(asked, si, sample1, changed(("u",), sample2), active)
            weight = changed(("value",), weight, ctx, si.wi, bs.wo)
            return change(bs, weight, sample2, ctx) if kind == "sample" else (bs, weight)

        def to_string(self):
            return f"Changed[{kind}]"

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
    weights, these and the samples ("weight"), of densities and the samples ("pdf"), of what eval_direction()
    ("value") and eval() ("seen") return.
    """

    def changed(kind, value, *more):
        return changes.get(kind, unchanged)(value, *more)

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
            return changed("direction", ds, sample), changed("weight", weight, sample, ds)

        def pdf_direction(self, it, ds, active=True):
            return changed("pdf", self.sound.pdf_direction(it, ds, active), ds)

        def eval_direction(self, it, ds, active=True):
            return changed("value", self.sound.eval_direction(it, ds, active))

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return "Sky"

    return Sky


def stale_bsdf():
    """A class of BSDFs that ignore updates of their parameter."""
    changed = changed_bsdf()

    class Stale(changed):
        def __init__(self, props):
            self.alpha = updatable(props.get("alpha", 0.2))
            props["nested"] = mi.load_dict({**GLOSS, "alpha": props.get("alpha", 0.2)})
            changed.__init__(self, props)

        def traverse(self, callback):
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)

    return Stale


def registered(kind, name, make):
    """Register a class in both kinds of variants, in place of the one before."""
    for variant in (runtime.SLOW, mi.variant()):
        runtime.use(variant)
        getattr(mi, f"register_{kind}")(name, make())
    return {"type": name}


def faulty_bsdf(nested=None, **changes):
    """The dict of a BSDF with a change."""
    ((kind, change),) = changes.items()
    if kind == "stale":
        return registered("bsdf", "stale", stale_bsdf)
    given = registered("bsdf", "faulty", partial(changed_bsdf, kind, change))
    return given | {"nested": nested or {"type": "diffuse"}}


def faulty_sky(nested=None, **changes):
    """The dict of a constant sky with changes."""
    return registered("emitter", "faulty_sky", partial(changed_sky, changes))


@dataclass(frozen=True)
class Kind:
    """A kind of plugins: how to check them, their laws by name, and a plugin with a fault."""

    check: Callable
    laws: Mapping
    faulty: Callable

    def check_fault(self, fault, *, quick):
        """Check a plugin with a fault, three times as large as documented, by the law that should find it."""
        size = 3 * (fault.quick if quick else fault.full)
        changes = {name: partial(change, size) for name, change in fault.changes.items()}
        return self.check(self.faulty(fault.nested, **changes), only=[fault.law], quick=quick)


KINDS = {
    "BSDF": Kind(mrt.check_bsdf, bsdf.LAWS, faulty_bsdf),
    "shape": Kind(mrt.check_shape, shape.LAWS, ChangedShape),
    "emitter": Kind(mrt.check_emitter, emitter.LAWS, faulty_sky),
}


def exceeded(check):
    """The figures of laws that are beyond their limits."""
    return {
        f"{law.name}.{part.criterion}" for law in check.laws.values() for part in law.parts if not part.holds
    }


class Mistake:
    """Changes of a sound plugin, the figures that exceed their limits, and laws to try besides theirs."""

    def __init__(self, kind, figures, nested=None, *, besides=(), **changes):
        self.kind = KINDS[kind]
        self.figures = set(figures.split())
        self.nested = nested
        self.laws = {figure.split(".")[0] for figure in self.figures}.union(besides)
        self.changes = changes


# reciprocity and components cost least, and fail for many mistakes by mistake
bsdf_with = partial(Mistake, "BSDF", besides={"reciprocity", "components"})
shape_with = partial(Mistake, "shape", besides=set(shape.LAWS) - {"sampling"})
sky_with = partial(Mistake, "emitter", besides=emitter.LAWS)


# --------------------- Values and weights of BSDFs: of (value, ctx, wi, wo) ---------------------


def no_number_in_sharp_lobes(value, ctx, wi, wo):
    return dr.select(value > 1e5, dr.nan, value)


def steep(value, ctx, wi, wo):
    attached = dr.select(wo.x > 0.7, value - dr.detach(value), 0)
    return value + dr.sqrt(dr.maximum(0, attached))


def across(value, ctx, wi, wo):
    """Light or density where light would go through the surface."""
    return value + dr.select(wi.z * wo.z < 0, 0.1 * abs(wo.z), 0)


def cancelling(value, ctx, wi, wo):
    """The slope of the half vector from a cosine near 1, as in the report."""
    h = wi + wo
    cosine = dr.normalize(h).z
    lost = dr.exp(100 * (tan2_theta(h) + 1 - 1 / dr.square(cosine)))
    return dr.select(value > 0, value * lost, 0)


def by_an_index_that_is_no_number(value, ctx, wi, wo):
    """A table over the half vector, which there is none of where wo = -wi."""
    index = mi.Int32(dr.normalize(wi + wo).z) if is_jit() else 0
    return value * dr.gather(mi.Float, mi.Float(1, 1), index) if is_jit() else value


SWITCHES: list[int] = []  # of variants, so far


def by_switches(value, ctx, wi, wo):
    if not SWITCHES:
        mi.detail.add_variant_callback(lambda *_: SWITCHES.append(1))
        SWITCHES.append(1)
    return value * (1 + 1e-3 * (len(SWITCHES) % 4))


# --------------------- Samples of BSDFs: of (bs, weight, u, ctx) ---------------------


def with_the_densitys_derivative(bs, weight, u, ctx):
    return bs, weight * dr.select(bs.pdf > 0, bs.pdf / dr.detach(bs.pdf), 1)


def turned(bs, weight, u, ctx):
    wo = bs.wo
    return put(bs, wo=mi.Vector3f(0.8 * wo.x - 0.6 * wo.y, 0.6 * wo.x + 0.8 * wo.y, wo.z)), weight


def of_next_component(bs, weight, u, ctx):
    return put(bs, sampled_component=bs.sampled_component + 1), weight


# --------------------- Hits of shapes: of (si, ray) ---------------------


def deaf_to_its_limit(si, ray):
    return ChangedShape().ray_intersect(mi.Ray3f(ray.o, ray.d))


def deaf_test(found, ray):
    return found | (ray.maxt < 0)


def rounded(si, ray):
    """A distance as the difference of two large numbers."""
    si.t = (1000 + si.t) - 1000
    return put(si, p=ray(si.t))


def facing(si, ray):
    """Normals that are the ray's doing."""
    side = dr.select(dr.dot(si.n, ray.d) > 0, mi.Float(-1), 1)
    si.n = side * si.n
    si.sh_frame.n = side * si.sh_frame.n
    return si


def shaded_from_below(si, ray):
    return put(si, sh_frame=mi.Frame3f(-si.n))


def below(si, ray):
    return put(si, p=si.p - 2e-3 * si.n)


def seen_from_inside(si, ray):
    return put(si, t=dr.select(dr.dot(si.n, ray.d) > 0, dr.inf, si.t))


def beyond_a_table(si, ray):
    index = dr.select(ray.d.x == 0, mi.UInt32(9), 0)
    return put(si, uv=si.uv * dr.gather(mi.Float, mi.Float(1, 1), index))


# --------------------- Skies ---------------------


def darker(light):
    return 0.99 * light


def upwards(ds, u):
    d = mi.Vector3f(ds.d.x, ds.d.y, abs(ds.d.z))
    return put(ds, p=ds.p + ds.dist * (d - ds.d), d=d)


def nearer(ds, u):
    return put(ds, dist=0.995 * ds.dist)


def too_long(ds, u):
    return put(ds, d=1.0005 * ds.d)


def no_number(weight, u, ds):
    return dr.select(u.x > 0.99, dr.nan, weight)


def nowhere_a_number(light):
    return dr.nan * light


def negative(weight, u, ds):
    return -weight


def beyond_a_table_of_light(weight, u, ds):
    index = dr.select(u.x > 0.99, mi.UInt32(9), 0)
    return weight * dr.gather(mi.Float, mi.Float(1, 1), index) if is_jit() else weight


MISTAKES: dict[str, Mistake] = {
    "BSDF: cancelling half vector": bsdf_with("roundoff.lost", GLOSS, value=cancelling),
    "BSDF: NaN at the least roughness": bsdf_with("finite.results", GLOSS, value=no_number_in_sharp_lobes),
    "BSDF: index that is no number": bsdf_with("finite.reads", value=by_an_index_that_is_no_number),
    "BSDF: derivatives that are NaN": bsdf_with("gradients.values gradients.broken", GLOSS, value=steep),
    # whatever types of lobes are asked for
    "BSDF: light through the surface": bsdf_with(
        "components.values components.masked sampling.dark", eval=across
    ),
    "BSDF: another value after each switch": bsdf_with("switch.same", value=by_switches),
    "BSDF: mirror turned": bsdf_with("reciprocity.returns", MIRROR, sample=turned),
    "BSDF: next component": bsdf_with("components.samples", sample=of_next_component),
    # of directions that move with the roughness
    "BSDF: derivative of the density in weights": bsdf_with(
        "gradients.mean", GLOSS, sample=with_the_densitys_derivative
    ),
    "BSDF: updates ignored": bsdf_with("gradients.reached", stale=None),
    "BSDF: black back": bsdf_with("components.dark", flags=+mi.BSDFFlags.BackSide),
    "BSDF: a flag of no component": bsdf_with("components.flags", whole=+mi.BSDFFlags.Null),
    "BSDF: a component more with each update": bsdf_with("components.updated", update=None),
    "BSDF: active ignored": bsdf_with("eval_pdf.inactive", active=None),
    "shape: none": shape_with(""),
    "shape: normal towards the ray": shape_with("normals.turned", ray_intersect=facing),
    "shape: shading normal on the other side": shape_with(
        "normals.side normals.shading", ray_intersect=shaded_from_below
    ),
    # ray_test knows nothing of it
    "shape: met from outside only": shape_with(
        "hits.ray_test watertight.blind", ray_intersect=seen_from_inside
    ),
    "shape: a read beyond a table": shape_with("finite.reads", ray_intersect=beyond_a_table),
    "shape: maxt ignored": shape_with(
        "hits.ray_intersect", ray_intersect=deaf_to_its_limit, ray_test=deaf_test
    ),
    "shape: hit point below the surface": shape_with(
        "surface.on_ray surface.near_by surface.again surface.missed", ray_intersect=below
    ),
    # differences of hit points suffer as well
    "shape: digits lost": shape_with("surface.behind normals.slope normals.step", ray_intersect=rounded),
    "sky: none": sky_with(""),
    "sky: seen 0.99 times as bright": sky_with("weights.seen", seen=darker),
    "sky: half of it": sky_with("sampling.small sampling.slices", direction=upwards),
    "sky: wrong distance": sky_with("sampling.place", direction=nearer),
    "sky: direction too long": sky_with("sampling.place sampling.slices finite.bad", direction=too_long),
    "sky: NaN": sky_with("finite.bad", weight=no_number),
    "sky: negative": sky_with("finite.bad weights.weight", weight=negative),
    "sky: NaN where it is seen": sky_with("finite.seen", seen=nowhere_a_number),
    "sky: a read beyond a table": Mistake("emitter", "finite.reads", weight=beyond_a_table_of_light),
}
