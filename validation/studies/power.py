"""The power of the laws: plugins with the faults that stand with each law."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import mitsuba as mi

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.laws import bsdf, emitter, shape
from mrt_mitsuba.validation.laws.bsdf import check_bsdf
from mrt_mitsuba.validation.laws.case import Given
from mrt_mitsuba.validation.laws.emitter import check_emitter
from mrt_mitsuba.validation.laws.law import Fault, Law
from mrt_mitsuba.validation.laws.page import Check
from mrt_mitsuba.validation.laws.shape import check_shape

Change = tuple[str, Any]  # the kind of change, and the change


def unchanged(value, *_):
    return value


AS_IS: Change = ("", unchanged)


def changed_bsdf(changes):
    """A class of BSDFs whose answers are those of another, changed: for ``register_bsdf``.

    ``changes``: by name, what is changed, and a function: of (value, ctx, wi, wo) for
    "eval", "pdf", what eval_pdf() alone gives ("pair"), or values and weights ("value"); of (bs, weight, u,
    ctx) for "sample"; of what eval_null_transmission() gives for "null"; of the random numbers u for "u"; of
    ctx for "context". "flags" are added, to components
    as well or to the "whole" alone; "active" is overlooked; an "update" adds a component.
    """

    class Changed(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.nested = props["nested"]
            self.kind, self.change = changes.get(props["change"], AS_IS)
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

        def eval_null_transmission(self, si, active=True):
            return self.changed(("null",), self.nested.eval_null_transmission(si, active))

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
    weights, these and the samples ("weight"), of densities and the samples ("pdf"), of what eval_direction()
    ("value") and eval() ("seen") return.
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


def faulty_bsdf(nested, **changes):
    """The dict of a BSDF with a change, which the next one replaces; it loads in the scalar variant, too."""
    (change,) = changes.items()
    for variant in (runtime.SLOW, mi.variant()):
        runtime.use(variant)
        mi.register_bsdf("faulty", changed_bsdf({"": change}))
    return {"type": "faulty", "change": "", "nested": nested or {"type": "diffuse"}}


def faulty_sky(nested, **changes):
    """The dict of a constant sky with changes, which the next one replaces."""
    mi.register_emitter("faulty_sky", changed_sky(changes))
    return {"type": "faulty_sky"}


@dataclass(frozen=True)
class Kind:
    """A kind of plugins: how to check them, their laws by name, and a plugin with a fault."""

    check: Callable[..., Check]
    laws: Mapping[str, Law]
    faulty: Callable[..., Given]

    @property
    def faults(self) -> list[Fault]:
        return [fault for law in self.laws.values() for fault in law.faults]

    def check_fault(self, fault: Fault, size: float, *, quick: bool) -> Check:
        """Check a plugin with a fault of that size by the law that should find it."""
        changes = {name: partial(change, size) for name, change in fault.changes.items()}
        return self.check(self.faulty(fault.nested, **changes), only=[fault.law], quick=quick)


KINDS = {
    "BSDF": Kind(check_bsdf, bsdf.LAWS, faulty_bsdf),
    "shape": Kind(check_shape, shape.LAWS, ChangedShape),
    "emitter": Kind(check_emitter, emitter.LAWS, faulty_sky),
}


def statements() -> list[dict[str, str]]:
    """A row for each law, which states it by the first line of its docstring, in Markdown."""
    rows = []
    for name, kind in KINDS.items():
        for law in kind.laws.values():
            words = law.states.replace("``", "`").replace("|", "\\|")
            rows.append({"plugin": name, "law": f"`{law.name}`", "states": words})
    return rows


def stated() -> list[dict[str, str]]:
    """A row for each fault, with the least sizes that its law is said to find."""
    rows = []
    for name, kind in KINDS.items():
        for fault in kind.faults:
            quick, full = (f"{size:.1g}".replace("inf", "not found") for size in (fault.quick, fault.full))
            what = {"plugin": name, "law": f"`{fault.law}`", "fault": fault.what}
            rows.append({**what, "quick": quick, "full": full})
    return rows
