"""The reflectance in float32 against 50 digits, by three formulas, over a grid of stiff and extreme lobes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.oracles import exact
from mrt_mitsuba.validation.studies.stability.cases import Cases
from mrt_mitsuba.validation.studies.stability.formulas import FORMULAS
from mrt_mitsuba.validation.studies.stability.lobes import ALPHAS, COSINES, STEEPNESS, Lobes, lobes_with_truth
from mrt_mitsuba.validation.tools.study import Study

ROUNDING = 2.0**-24

# What is measured, with its bounds. The first holds where D is at least 1e-7 of its peak, for alpha 1e-4 … 1:
# 80 roundings, for the argument of exp is up to 16 there, and its error is multiplied by as much. The second
# holds on the whole grid, where the argument of exp goes to 46: 46 times the 4 roundings of tan²/alpha², and
# those of the other factors. G and F hold no exp: 16 and 24 roundings, three times what was measured
BOUND, EVERYWHERE = 5e-6, 2e-5
QUANTITIES = {
    "d": ("D", BOUND, EVERYWHERE),
    "g": ("G", 1e-6, 1.2e-6),
    "f": ("F", 1.5e-6, 2e-6),
    "value": ("BSDF cos", BOUND, EVERYWHERE),
    "pdf": ("pdf", BOUND, EVERYWHERE),
    "gradient": ("gradient in alpha", BOUND, EVERYWHERE),
}
FRESNEL_IORS = np.array(
    [
        *(1e-3, 1e-2, 0.1, 0.5, 0.9, 0.99, 1 - 1e-7, 1 + 1e-7, 1.0001),
        *(1.01, 1.33, 1.5, 3, 10, 1e2, 1e3, 1e4, 1e5, 1e6),
    ],
    np.float32,
)
Angles = tuple[np.ndarray, np.ndarray, np.ndarray]  # cosines, indices, and the Fresnel term with 50 digits


def run(study: Study, *, quick: bool) -> None:
    """Measure errors of D, G, F, the whole, its density and gradient; worst cases."""
    cases = Cases(study, "bsdf", "Reflectance")
    lobes, truth = lobes_with_truth(2 if quick else 12)
    per_ior = 60 if quick else 600
    cosines = 10 ** np.random.default_rng(4).uniform(-7, 0, (len(FRESNEL_IORS), per_ior))
    cosines[:, 0] = 1
    angles = _angles(cosines.ravel().astype(np.float32), np.repeat(FRESNEL_IORS, per_ior))
    study.record("pairs of directions", len(lobes))
    found = {name: _errors(name, lobes, truth, angles) for name in FORMULAS}
    _hold(cases, lobes, found["mrt_bsdf"], _errors("mrt_bsdf", lobes, truth, angles, wrong=1 + 1 / 30_000))
    what = "relative error of D by cosines of normalised vectors"
    why = "lost to cancellation: a study that cannot see this would be blind"
    for alpha in (1e-4, 1e-3):
        here = lobes.in_bound & np.isclose(ALPHAS[lobes.cell[:, 0]], alpha)
        median = np.median(found["report"]["d"][here])
        cases.at_least(f"the report's form, median at alpha {alpha:g}", what, why, median, 10 * BOUND)
    _conditioning(cases, lobes)
    _total_reflection(cases)
    cases.close(
        "Relative errors at the same float32 numbers against 50 digits. Directions are what their components "
        "say, and the half vector is their sum; the gradient's error is relative to the sum of the sizes of "
        "its terms, since their sum passes through zero."
    )
    rows = []
    for a, alpha in enumerate(ALPHAS):
        here = (lobes.cell[:, 0] == a) & (lobes.steepness <= STEEPNESS[5])
        if here.any():
            figures = (f(e["value"][here]) for e in found.values() for f in (np.median, np.max))
            rows.append((f"{alpha:g}", int(here.sum()), *figures))
    columns = ("alpha", "pairs", *(f"{name}, {what}" for name in found for what in ("median", "largest")))
    title = "Relative error of BSDF cos where D is at least 1e-7 of its peak"
    note = "roughconductor raises alpha to 1e-4, and its Fresnel term cancels for an IOR near 1."
    study.table("bsdf-by-alpha", title, columns, rows, note)
    _worst_cases(study, lobes, angles, found["mrt_bsdf"])


# --------------------------------------------- Measuring ---------------------------------------------------


def _angles(cosines: np.ndarray, iors: np.ndarray) -> Angles:
    pairs = zip(cosines, iors, strict=True)
    return cosines, iors, np.array([float(exact.fresnel_dielectric(c, 1, n)) for c, n in pairs])


def _errors(
    formula: str, lobes: Lobes, truth: dict[str, np.ndarray], angles: Angles, wrong: float = 1.0
) -> dict[str, np.ndarray]:
    """Return the relative errors [N] by quantity; with alpha and indices ``wrong`` times what they are."""
    terms_of, fresnel = FORMULAS[formula]
    alpha, factor = mi.Float(lobes.alpha * np.float32(wrong)), np.float32(wrong)
    dr.enable_grad(alpha)
    terms = terms_of(mi.Vector3f(lobes.wi.T), mi.Vector3f(lobes.wo.T), alpha, mi.Float(lobes.ior * factor))
    of = {name: np.abs(_numbers(terms[name]) / truth[name] - 1) for name in ("d", "g", "value", "pdf")}
    dr.forward(alpha)
    of["gradient"] = np.abs(_numbers(dr.grad(terms["value"])) - truth["gradient"]) / truth["slope"]
    cosines, iors, expected = angles
    of["f"] = np.abs(_numbers(fresnel(mi.Float(cosines), mi.Float(iors * factor))) / expected - 1)
    return {name: np.where(np.isnan(error), np.inf, error) for name, error in of.items()}


def _numbers(x: Any) -> np.ndarray:
    return np.array(dr.detach(x), np.float64)


def _hold(cases: Cases, lobes: Lobes, ours: dict[str, np.ndarray], wrong: dict[str, np.ndarray]) -> None:
    least = "alpha and index 1 in 30,000 too large"
    for name, (title, usual, everywhere) in QUANTITIES.items():
        part = slice(None) if name == "f" else lobes.in_bound
        where = "cosines 1e-7 … 1, IOR 1e-3 … 1e6" if name == "f" else "alpha 1e-4 … 1, D ≥ 1e-7 of its peak"
        # the grid holds a thousand points and more, so that the 99.9th percentile is one of its last
        of_ours, of_fault = (np.quantile(e[name][part], 0.999) for e in (ours, wrong))
        cases.at_most(f"{title}, p99.9", where, "a few roundings", of_ours, usual, fault=(least, of_fault))
        where = "the whole grid: alpha 1e-8 … 100, D ≥ 1e-20 of its peak"
        expected = "a few roundings, which exp enlarges by up to 46"
        of_ours, of_fault = (e[name].max() for e in (ours, wrong))
        cases.at_most(f"{title}, largest", where, expected, of_ours, everywhere, fault=(least, of_fault))


def _conditioning(cases: Cases, lobes: Lobes) -> None:
    """Show what the rounding of the directions does to D: no formula can give it back."""
    nearby = np.nextafter(lobes.wo, np.float32(2))
    moved = lobes.wi[:, :2].astype(np.float64) + nearby[:, :2]
    tan2 = (moved**2).sum(axis=1) / (lobes.wi[:, 2].astype(np.float64) + lobes.wo[:, 2]) ** 2
    change = np.abs(np.expm1(lobes.steepness - tan2 / np.float64(lobes.alpha) ** 2))
    for alpha in (1e-3, 1e-4, 1e-6):
        here = np.isclose(ALPHAS[lobes.cell[:, 0]], alpha) & (lobes.steepness <= STEEPNESS[5])
        here &= COSINES[lobes.cell[:, 1]] == 0.5
        name = f"D of a neighbouring direction, alpha {alpha:g}"
        what = "largest relative change of D at 60° when x and y of one direction move by one float32 step"
        why = "directions are float32: neighbouring ones, equal to a renderer, have values this far apart"
        cases.beyond_float32(name, what, float(change[here].max()) if here.any() else np.inf, why)


def _total_reflection(cases: Cases) -> None:
    """Measure F around the critical angle, where it ends in a square root: errors are those of g = 0."""
    iors = np.repeat(np.array([0.5, 0.9, 0.99, 0.9999], np.float32), 81)
    critical = np.sqrt((1 - np.float64(iors)) * (1 + np.float64(iors)))
    steps = np.tile(np.arange(-40, 41), 4)
    cosines = (critical.astype(np.float32).view(np.int32) + steps.astype(np.int32)).view(np.float32)
    _, _, truth = _angles(cosines, iors)
    found = _numbers(FORMULAS["mrt_bsdf"][1](mi.Float(cosines), mi.Float(iors)))
    name, what = "F at the critical angle", "the 40 float32 cosines on either side of it, IOR 0.5 … 0.9999"
    why = "√ of a rounding: 1 - F is 4 g / (η² cos θ) there, and g² is known to a rounding of cos²"
    cases.at_most(name, what, why, np.abs(found / truth - 1).max(), 16 * np.sqrt(ROUNDING))
    cases.at_least(f"{name}, smallest", "the same", "reached from both sides", found.min(), 0.9)


def _worst_cases(study: Study, lobes: Lobes, angles: Angles, ours: dict[str, np.ndarray]) -> None:
    rows = []
    for name, (title, *_) in QUANTITIES.items():
        i = int(np.argmax(ours[name]))
        steepness: float | str = "" if name == "f" else float(lobes.steepness[i])
        if name == "f":
            inputs = {"cos": angles[0][i], "IOR": angles[1][i]}
        else:
            inputs = {"wi": lobes.wi[i], "wo": lobes.wo[i], "alpha": lobes.alpha[i], "IOR": lobes.ior[i]}
        # in Python's exact notation, which ``float.fromhex`` reads back
        exactly = ((word, (float(x).hex() for x in np.atleast_1d(v))) for word, v in inputs.items())
        text = ", ".join(f"{word} {' '.join(numbers)}" for word, numbers in exactly)
        rows.append((title, float(ours[name][i]), steepness, text))
    heading = "The worst of the whole grid, with their inputs"
    study.table("bsdf-worst", heading, ("quantity", "relative error", "tan²θh/alpha²", "inputs"), rows)
