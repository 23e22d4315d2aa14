"""``check_bsdf``: the laws that any BSDF must obey, stock or in Python, reflecting or transmitting."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.checks import snippets
from mrt_mitsuba.validation.checks.bsdf_case import POINTWISE, Case, excess
from mrt_mitsuba.validation.checks.bsdf_gradients import gradients
from mrt_mitsuba.validation.checks.bsdf_lobes import components
from mrt_mitsuba.validation.checks.bsdf_samples import energy, sampling, weights
from mrt_mitsuba.validation.checks.bsdf_values import eval_pdf, finite, reciprocity, roundoff
from mrt_mitsuba.validation.checks.law import Check, Law, Skip, class_name, examine
from mrt_mitsuba.validation.checks.probe import Array, Probe
from mrt_mitsuba.validation.checks.recipe import Recipe


def check_bsdf(bsdf: Any, *, quick: bool = False, seed: int = 0, only: Iterable[str] | None = None) -> Check:
    """Check the laws of a BSDF in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``quick``: fewer angles and samples. ``only``: names of ``LAWS``. A loaded BSDF skips what has to load it
    again. Raises ``UsageError`` for anything else, and ``SceneError`` for a dict that Mitsuba cannot load.
    """
    runtime.use()
    recipe = Recipe.of(bsdf)
    loaded = bsdf if recipe.description is None else recipe.open()
    if not isinstance(loaded, mi.BSDF):
        raise UsageError(
            f"{type(loaded).__name__} is not a BSDF of {mi.variant()}: give a dict or a loaded BSDF"
        )
    case = Case(loaded, recipe, quick, seed)
    name = recipe.description["type"] if recipe.description else class_name(loaded)
    with np.errstate(all="ignore"):  # the law ``finite`` deals with what is not finite
        return examine(name, case, LAWS, only=only, quick=quick)


def variants(law: Law, case: Case) -> None:
    """Values in the scalar variant, and in the spectral one where colours are grey."""
    here = mi.variant()
    case.recipe.load()
    few = case.pairs.only(slice(0, case.count(200, 800)))
    few = few.only(np.isfinite(few.value).all(axis=1))
    of_value, of_pdf = (case.spread(f, few.wi, few.wo, few.uv) for f in (case.probe.eval, case.probe.pdf))
    for other in _others(here, np.ptp(few.value, axis=1).max() <= 1e-5 * few.value.max(), law):
        found = _there(law, case, other, few)
        if found is None:
            continue
        (value, pdf), expected, spread = found, few.value, of_value
        if not other.endswith("_rgb"):  # the mean of equal channels, however many there are
            value, expected, spread = value.mean(axis=1), expected.mean(axis=1), spread.max(axis=1)
        law.most(
            f"value and density in {other} against {here}, relative, beyond rounding",
            np.maximum(excess(value, expected, spread), excess(pdf, few.pdf, of_pdf)),
            POINTWISE,
            "the same formula",
            case.at(snippets.VARIANT, few, other=other),
        )
    if not law.parts:
        raise Skip("; ".join(law.notes) or "no other variant to compare with")


def _there(law: Law, case: Case, other: str, few: Any) -> tuple[Array, Array] | None:
    """Return value and density in another variant; None where it or the plugin is not available."""
    if runtime.obstacle(other):
        law.notes.append(f"{other} cannot run here")
        return None
    here = mi.variant()
    try:
        runtime.use(other)
        return Probe(case.recipe.load()).both(few.wi, few.wo, few.uv)
    except RuntimeError as problem:
        if "not found" not in str(problem):
            raise
        law.notes.append(
            f"{other} does not know the plugin: register it there (mi.detail.add_variant_callback)"
        )
        return None
    finally:
        mi.set_variant(here)


def _others(here: str, grey: bool, law: Law) -> list[str]:
    known = set(mi.variants())
    pairs = (("llvm_ad_", "scalar_"), ("cuda_ad_", "scalar_"), ("scalar_", "llvm_ad_"))
    found = [here.replace(a, b) for a, b in pairs if here.startswith(a) and here.replace(a, b) in known]
    if here.endswith("_rgb"):
        if grey:
            found.append(here.replace("_rgb", "_spectral"))
        else:
            law.notes.append("coloured: a spectral variant need not agree")
    return found


def switch(law: Law, case: Case) -> None:
    """Values after a switch to another variant and back, of the BSDF as it was and loaded anew."""
    here = mi.variant()
    other = (
        "scalar_rgb"
        if here != "scalar_rgb"
        else next((v for v in runtime.usable_variants() if v != here), None)
    )
    few = case.pairs.only(slice(0, case.count(1000, 1000)))
    before = case.probe.both(few.wi, few.wo, few.uv)
    allowed = [case.spread(f, few.wi, few.wo, few.uv) for f in (case.probe.eval, case.probe.pdf)]
    if other is None:
        raise Skip("there is no other variant to switch to")
    mi.set_variant(other)
    mi.set_variant(here)
    candidates = {"that was loaded before": case.bsdf}
    if case.recipe.description is not None:
        candidates["loaded anew"] = case.recipe.load()
    else:
        law.notes.append("a loaded BSDF was given: it was not loaded anew")
    for which, bsdf in candidates.items():
        after = Probe(bsdf).both(few.wi, few.wo, few.uv)
        law.most(
            f"values of the BSDF {which} after a switch to {other} and back, relative, beyond rounding",
            np.maximum(*(excess(*three) for three in zip(before, after, allowed, strict=True))),
            1e-4,
            "the same formula with the same numbers",
            case.at(snippets.SWITCH, few, other=other),
        )


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
