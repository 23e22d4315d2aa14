"""Derivatives of a BSDF's values by its parameters, against differences."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.checks import snippets
from mrt_mitsuba.validation.checks.bsdf_case import Case, Pairs, changed, copied, excess, parameters
from mrt_mitsuba.validation.checks.law import Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, Probe, as_mitsuba, context, interaction, is_scalar

GRADIENT = 2e-2  # relative; differences of two widths agree better


def gradients(law: Law, case: Case) -> None:
    """Forward derivatives of the mean value by every differentiable parameter, against differences."""
    if is_scalar() or "_ad_" not in mi.variant():
        raise Skip(f"{mi.variant()} has no derivatives")
    case.need_smooth()
    if not len(_lit(case).wi):
        raise Skip("values are 0")
    case = case.copy()
    params = mi.traverse(case.plugin)
    keys = [k for k, _ in parameters(case) if not params.flags(k) & int(mi.ParamFlags.NonDifferentiable)]
    if not keys:
        raise Skip("traverse() marks no parameter as differentiable")
    detached = [key for key in keys if not _holds(law, case, key)]
    if detached:
        law.notes.append(f"detached: {', '.join(detached)}")
    if not law.parts:
        raise Skip("; ".join(law.notes))


def _holds(law: Law, case: Case, key: str) -> bool:
    """Hold the derivative by one parameter to differences; return False where it is detached, and wrong."""
    with changed(case, key, _inside):
        found, attached, broken = _derivatives(case, key)
        slope, error = _differences(case, key)
    if not attached and not slope.any():
        law.notes.append(f"{key} changes no value")
        _reached(law, case, key)
    off, few = np.abs(found - slope), _lit(case)
    known = np.isfinite(error)
    if known.sum() < 20:
        law.notes.append(f"{key}: its least differences move lobes away, and cannot judge derivatives")
        return True
    usual = known & (off <= np.quantile(off[known], 0.98))  # where values have a kink, no slope is
    beyond = np.maximum(off - error, 0)[usual].sum()
    measured = beyond / max(np.abs(slope)[usual].sum(), np.abs(found)[usual].sum(), 1e-30)
    show = case.at(snippets.GRADIENT, few, key=key)
    what = (
        f"derivative of values by {key}{'' if attached else ' (detached)'}, relative, beyond the error of "
        "differences"
    )
    why = "differences of two widths agree better than that, or the difference is allowed for"
    law.at_most(what, measured, GRADIENT, why, show(int(np.where(usual, off, 0).argmax())))
    why = "one of them spoils a whole gradient"
    law.none(f"derivatives by {key} that are not finite, of finite values", broken, why, show)
    return attached or measured <= GRADIENT


def _reached(law: Law, case: Case, key: str) -> None:
    """A parameter whose updates change no value should change none where it is loaded, either."""
    name, few = key.removesuffix(".value"), _lit(case)
    if case.recipe.description is None or "." in name:
        return
    number = 0.8 * float(np.mean(np.array(mi.traverse(case.plugin)[key]))) or 0.5
    try:
        other = Probe(case.recipe.with_(**{name: number}).load())
    except RuntimeError:  # what is loaded goes by another name, or takes other numbers
        return
    allowed = case.spread(case.probe.eval, few.wi, few.wo, few.uv)
    value = other.eval(few.wi, few.wo, few.uv)
    error = excess(value, few.value, allowed)
    what = f"values that loading with another {key} changes, but params.update() does not, relative"
    why = "parameters_changed() has to compute anew what is made of parameters"
    law.most(what, error, GRADIENT, why, case.at(snippets.UPDATE, few, key=key, number=number, value=value))


def _inside(value: Any) -> Any:
    """Return a parameter away from the ends of its range, so that it can be varied both ways."""
    number = float(np.mean(np.array(value)))
    return type(value)(value * 0.9) if number == 1 else type(value)(value + 0.1) if number == 0 else value


def _lit(case: Case) -> Pairs:
    """Return pairs away from the horizon, over which values jump."""
    p = case.pairs
    up = (np.abs(p.wo[:, 2]) > 0.05) & (np.abs(p.wi[:, 2]) > 0.05)
    return p.only(up & np.isfinite(p.value).all(axis=1) & (p.value > 0).any(axis=1))


def _values(case: Case) -> Any:
    """Return values at pairs as a Dr.Jit array with derivatives, each over what it is without a change."""
    few = _lit(case)
    wi, wo = (as_mitsuba("Vector3f", x) for x in (few.wi, few.wo))
    si = interaction(wi, as_mitsuba("Point2f", few.uv))
    scale = np.maximum(few.value.max(axis=1), 1e-3 * few.value.max())
    value = mi.unpolarized_spectrum(case.plugin.eval(context(), si, wo))
    total = sum(value[i] for i in range(len(value))) / as_mitsuba("Float", scale)
    return dr.select(dr.isfinite(total), total, 0)


def _derivatives(case: Case, key: str) -> tuple[Array, bool, Array]:
    """Return derivatives by ``_moved``, if there is a way to the parameter at all, and which are none."""
    shift = mi.Float(0)
    dr.enable_grad(shift)
    with changed(case, key, lambda old: _moved(old, shift)):
        values = _values(case)
        if not dr.grad_enabled(values):
            none = np.zeros(dr.width(values))
            return none, False, none.astype(bool)
        dr.forward(shift)
        found = np.array(dr.grad(values), np.float64)
        return np.nan_to_num(found, posinf=0, neginf=0), True, ~np.isfinite(found)


def _moved(old: Any, shift: Any) -> Any:
    """Return a parameter with ``shift`` of each number added: a spectrum's may be of many sizes."""
    usual = float(np.mean(np.abs(np.array(old)))) or 0.05
    return type(old)(old + dr.select(old == 0, usual, dr.abs(dr.detach(old))) * shift)


WIDTHS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)  # of differences, over the parameter


def _differences(case: Case, key: str) -> tuple[Array, Array]:
    """Return central differences of the width that is off by least, and by how much they may be off.

    That is what the next larger width says otherwise, the rounding of values, and half of what the slopes to
    either side are apart: where a value has a kink, as at the end of a range, either one is a derivative.
    Where a lobe is so narrow that it moves away within every width, differences say nothing: infinity.
    The parameter is left changed.
    """
    params = mi.traverse(case.plugin)
    base = copied(params[key])

    def at(shift: float) -> Array:
        params[key] = _moved(base, dr.opaque(mi.Float, shift))
        params.update()
        return np.array(_values(case), np.float64)

    here = at(0.0)
    ends = np.array([(at(step), at(-step)) for step in WIDTHS])
    across = 2 * np.array(WIDTHS)[:, None]
    slopes = (ends[:, 0] - ends[:, 1]) / across
    bent = np.abs(ends[:, 0] - 2 * here + ends[:, 1])
    sides = np.where(bent <= 0.25 * np.abs(here), bent / across, np.inf)
    error = 2 * np.abs(np.diff(slopes, axis=0)) + sides[1:] + 2.0**-22 * np.abs(here) / across[1:]
    best = error.argmin(axis=0)[None]
    return tuple(np.take_along_axis(x, best, axis=0)[0] for x in (slopes[1:], error))
