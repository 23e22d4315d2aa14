"""``check_bsdf``: the laws that any BSDF must obey, stock or in Python, reflecting or transmitting.

A new law is a function of ``Law`` and ``Case``, here or in the module of its kind, and a row of ``LAWS``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.checks.bsdf_case import POINTWISE, Case, excess
from mrt_mitsuba.validation.checks.bsdf_gradients import gradients
from mrt_mitsuba.validation.checks.bsdf_lobes import components
from mrt_mitsuba.validation.checks.bsdf_samples import energy, sampling, weights
from mrt_mitsuba.validation.checks.bsdf_values import eval_pdf, finite, reciprocity, roundoff
from mrt_mitsuba.validation.checks.law import TIMEOUT, Check, Law, Skip, examine, settings_restored
from mrt_mitsuba.validation.checks.probe import Probe
from mrt_mitsuba.validation.checks.recipe import elsewhere, other_kind


def check_bsdf(
    bsdf: Any,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check the laws of a BSDF in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``quick``: fewer angles and samples. ``only``: names of ``LAWS``. ``timeout``: seconds after which a law
    fails that is not done. A loaded BSDF skips what has to load it again. Raises ``UsageError`` for anything
    else, and ``SceneError`` for a dict that Mitsuba cannot load.
    """
    runtime.use()
    with settings_restored():
        case = Case(bsdf, quick, seed)
        if not isinstance(case.plugin, mi.BSDF):
            kind = type(case.plugin).__name__
            raise UsageError(f"{kind} is not a BSDF of {mi.variant()}: give a dict or a loaded BSDF")
        return examine(case.name, case, LAWS, only=only, quick=quick, timeout=timeout)


VALUES = "each"  # the snippet: value and density in several variants


def variants(law: Law, case: Case) -> None:
    """Values in the scalar variant, and in the spectral one where colours are grey."""
    here = mi.variant()
    case.load()
    few = case.pairs.only(slice(0, case.count(200, 800)))
    few = few.only(np.isfinite(few.value).all(axis=1))
    of_value, of_pdf = (case.spread(f, few.wi, few.wo, few.uv) for f in (case.probe.eval, case.probe.pdf))
    others = [other_kind()] if other_kind() in mi.variants() else []
    if here.endswith("_rgb"):
        if np.ptp(few.value, axis=1).max() <= 1e-5 * few.value.max():
            others.append(here.replace("_rgb", "_spectral"))
        else:
            law.notes.append("coloured: a spectral variant need not agree")
    for other in others:
        try:
            value, pdf = elsewhere(other, lambda: Probe(case.load()).both(few.wi, few.wo, few.uv))
        except Skip as reason:
            law.notes.append(str(reason))
            continue
        expected, spread = few.value, of_value
        if not other.endswith("_rgb"):  # the mean of equal channels, however many there are
            value, expected, spread = value.mean(axis=1), expected.mean(axis=1), spread.max(axis=1)
        what = f"value and density in {other} against {here}, relative, beyond rounding"
        error = np.maximum(excess(value, expected, spread), excess(pdf, few.pdf, of_pdf))
        law.most(what, error, POINTWISE, "the same formula", case.at(VALUES, few, variants=(here, other)))
    if not law.parts:
        raise Skip("; ".join(law.notes) or "no other variant to compare with")


def switch(law: Law, case: Case) -> None:
    """Values after a switch to another variant and back, of the BSDF as it was and loaded anew."""
    here = mi.variant()
    others = [v for v in ("scalar_rgb", *runtime.usable_variants()) if v != here]
    few = case.pairs.only(slice(0, case.count(1000, 1000)))
    before = case.probe.both(few.wi, few.wo, few.uv)
    allowed = [case.spread(f, few.wi, few.wo, few.uv) for f in (case.probe.eval, case.probe.pdf)]
    if not others:
        raise Skip("there is no other variant to switch to")
    other = others[0]
    mi.set_variant(other)
    mi.set_variant(here)
    candidates = {"that was loaded before": case.plugin}
    if case.description is not None:
        candidates["loaded anew"] = case.load()
    else:
        law.notes.append("a loaded BSDF was given: it was not loaded anew")
    for which, bsdf in candidates.items():
        after = Probe(bsdf).both(few.wi, few.wo, few.uv)
        what = f"values of the BSDF {which} after a switch to {other} and back, relative, beyond rounding"
        error = np.maximum(*(excess(*three) for three in zip(before, after, allowed, strict=True)))
        show = case.at(VALUES, few, variants=(here, other, here))
        law.most(what, error, 1e-4, "the same formula with the same numbers", show)


LAWS = {
    "sampling": sampling,
    "weights": weights,
    "eval_pdf": eval_pdf,
    "energy": energy,
    "reciprocity": reciprocity,
    "finite": finite,
    "roundoff": roundoff,
    "gradients": gradients,
    "components": components,
    "variants": variants,
    "switch": switch,
}
