"""Mistakes of BSDFs that checks must find, by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mrt_mitsuba.plugins.microfacet import tan2_theta
from mrt_mitsuba.plugins.variants import is_jit, updatable
from mrt_mitsuba.validation.studies.power import changed_bsdf

DIFFUSE = {"type": "diffuse"}
MIRROR = {"type": "conductor"}
GLOSS = {"type": "roughconductor"}


@dataclass(frozen=True)
class Mistake:
    """A change of a sound BSDF, as ``changed_bsdf`` takes it, and the figures that exceed their limits."""

    kind: str
    change: Any
    figures: set[str]
    nested: dict = field(default_factory=lambda: DIFFUSE)


# --------------------- Changes of values and weights: of (value, ctx, wi, wo) ---------------------


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


SWITCHES = [0]  # of variants, so far


def _switched(*variants):
    SWITCHES[0] += 1


def by_switches(value, ctx, wi, wo):
    return value * (1 + 1e-3 * (SWITCHES[0] % 4))


# --------------------- Changes of samples: of (bs, weight, u, ctx) ---------------------


def with_the_densitys_derivative(bs, weight, u, ctx):
    return bs, weight * dr.select(bs.pdf > 0, bs.pdf / dr.detach(bs.pdf), 1)


def member(name, change):
    """A change of a member of samples."""

    def apply(bs, weight, u, ctx):
        setattr(bs, name, change(getattr(bs, name)))
        return bs, weight

    return apply


def turned(wo):
    return mi.Vector3f(0.8 * wo.x - 0.6 * wo.y, 0.6 * wo.x + 0.8 * wo.y, wo.z)


def following(component):
    return component + 1


OF_VALUES = {
    "cancelling half vector": Mistake("value", cancelling, {"roundoff.lost"}, GLOSS),
    "NaN at the least roughness": Mistake("value", no_number_in_sharp_lobes, {"finite.values"}, GLOSS),
    "index that is no number": Mistake("value", by_an_index_that_is_no_number, {"finite.reads"}),
    "derivatives that are NaN": Mistake("value", steep, {"gradients.values", "gradients.broken"}, GLOSS),
    # whatever types of lobes are asked for
    "light through the surface": Mistake(
        "eval", across, {"components.values", "components.masked", "sampling.dark"}
    ),
    "another value after each switch": Mistake("value", by_switches, {"switch.same"}),
}
OF_SAMPLES = {
    "mirror turned": Mistake("sample", member("wo", turned), {"reciprocity.returns"}, MIRROR),
    "next component": Mistake("sample", member("sampled_component", following), {"components.samples"}),
    # of directions that move with the roughness
    "derivative of the density in weights": Mistake(
        "sample", with_the_densitys_derivative, {"gradients.mean"}, GLOSS
    ),
}
OF_THE_REST = {
    "updates ignored": Mistake("stale", None, {"gradients.reached"}, GLOSS),
    "black back": Mistake("flags", +mi.BSDFFlags.BackSide, {"components.dark"}),
    "a flag of no component": Mistake("whole", +mi.BSDFFlags.Null, {"components.flags"}),
    "a component more with each update": Mistake("update", None, {"components.updated"}),
    "active ignored": Mistake("active", None, {"eval_pdf.inactive"}),
}
MISTAKES = OF_VALUES | OF_SAMPLES | OF_THE_REST
CHANGES = {name: (mistake.kind, mistake.change) for name, mistake in MISTAKES.items()}


def exceeded(check):
    """The figures of laws that are beyond their limits."""
    return {
        f"{law.name}.{part.criterion}" for law in check.laws.values() for part in law.parts if not part.holds
    }


def register() -> None:
    """Define the classes anew for the current variant."""
    changed = changed_bsdf(CHANGES)

    class Stale(changed):
        """Updates of its parameter are ignored."""

        def __init__(self, props):
            alpha = props.get("alpha", 0.2)
            props["nested"] = mi.load_dict({**GLOSS, "alpha": alpha})
            props["change"] = ""
            self.alpha = updatable(alpha)
            changed.__init__(self, props)

        def traverse(self, callback):
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)

    mi.register_bsdf("changed", changed)
    mi.register_bsdf("stale", Stale)
    if not SWITCHES[0]:
        mi.detail.add_variant_callback(_switched)
        _switched()
