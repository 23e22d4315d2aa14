"""The reflectance in float32 against 50 digits, by three formulas, over a grid of stiff and extreme lobes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.validation.oracles import exact
from mrt_mitsuba.validation.studies.stability.cases import Cases, hexadecimal
from mrt_mitsuba.validation.studies.stability.formulas import Mitsuba, Ours, Report
from mrt_mitsuba.validation.studies.stability.lobes import (
    ALPHAS,
    COSINES,
    STEEPNESS,
    Lobes,
    Truth,
    lobes_with_truth,
)
from mrt_mitsuba.validation.tools.gallery import panels
from mrt_mitsuba.validation.tools.study import Study

QUANTITIES = {
    "d": "D",
    "g": "G",
    "f": "F",
    "value": "BSDF cos",
    "pdf": "pdf",
    "gradient": "gradient in alpha",
}
ROUNDING = 2.0**-24

# What the errors of alpha 1e-4 … 1 are held to where D is at least 1e-7 of its peak: 80 roundings. The
# argument of exp is up to 16 there, and its error is multiplied by as much
BOUND = 5e-6

# The same for the whole grid, where the argument of exp goes to 46: 46 times the 4 roundings of
# tan²/alpha², and those of the other factors
BOUND_EVERYWHERE = 2e-5

# G and F hold no exp: 16 and 24 roundings, three times what was measured
BOUND_OF = {"g": (1e-6, 1.2e-6), "f": (1.5e-6, 2e-6)}

FRESNEL_IORS = np.array(
    [
        *(1e-3, 1e-2, 0.1, 0.5, 0.9, 0.99, 1 - 1e-7, 1 + 1e-7, 1.0001),
        *(1.01, 1.33, 1.5, 3, 10, 1e2, 1e3, 1e4, 1e5, 1e6),
    ],
    np.float32,
)

DECADES = 7  # of the cosines of the Fresnel term


@dataclass(frozen=True)
class Errors:
    """Relative errors [N] of one formula, by quantity, at pairs of directions or at Fresnel's arguments."""

    formula: str
    of: dict[str, np.ndarray]


def run(study: Study, *, quick: bool) -> None:
    """Measure errors of D, G, F, the whole, its density and gradient; heat maps; worst cases."""
    cases = Cases(study, "bsdf", "Reflectance")
    lobes, truth = lobes_with_truth(2 if quick else 12)
    angles = FresnelGrid.make(60 if quick else 600)
    study.record("pairs of directions", len(lobes))
    found = [_errors(formula, lobes, truth, angles) for formula in (Report(), Mitsuba(), Ours())]
    _hold(cases, lobes, found, _errors(Ours(), *_wrong(lobes, truth, angles)))
    _conditioning(cases, lobes)
    _total_reflection(cases)
    cases.close(
        "Relative errors at the same float32 numbers against 50 digits. Directions are what their components "
        "say, and the half vector is their sum; the gradient's error is relative to the sum of the sizes of "
        "its terms, since their sum passes through zero."
    )
    _table_by_alpha(study, lobes, found)
    _worst_cases(study, lobes, angles, found[-1])
    _heat_maps(study, lobes, angles, found)


# --------------------------------------------- Measuring ---------------------------------------------------


@dataclass(frozen=True)
class FresnelGrid:
    """Arguments of the Fresnel term, and 50-digit values of it."""

    cosines: np.ndarray  # float32 [N]
    iors: np.ndarray  # float32 [N]
    truth: np.ndarray  # float64 [N]

    @staticmethod
    def make(per_ior: int) -> FresnelGrid:
        """Return cosines over all decades from 1e-7 to 1."""
        cosines = 10 ** np.random.default_rng(4).uniform(-7, 0, (len(FRESNEL_IORS), per_ior))
        cosines[:, 0] = 1
        iors = np.repeat(FRESNEL_IORS, per_ior)
        return FresnelGrid.at(cosines.ravel().astype(np.float32), iors)

    @staticmethod
    def at(cosines: np.ndarray, iors: np.ndarray) -> FresnelGrid:
        pairs = zip(cosines, iors, strict=True)
        return FresnelGrid(
            cosines, iors, np.array([float(exact.fresnel_dielectric(c, 1, n)) for c, n in pairs])
        )

    def errors(self, fresnel: Callable[[Any, Any], Any]) -> np.ndarray:
        return _relative(fresnel(mi.Float(self.cosines), mi.Float(self.iors)), self.truth)


def _errors(formula: Any, lobes: Lobes, truth: Truth, angles: FresnelGrid) -> Errors:
    alpha = mi.Float(lobes.alpha)
    dr.enable_grad(alpha)
    terms = formula.terms(mi.Vector3f(lobes.wi.T), mi.Vector3f(lobes.wo.T), alpha, mi.Float(lobes.ior))
    of = {name: _relative(getattr(terms, name), getattr(truth, name)) for name in ("d", "g", "value", "pdf")}
    dr.forward(alpha)
    of["gradient"] = np.abs(_numbers(dr.grad(terms.value)) - truth.gradient) / truth.slope
    of["f"] = angles.errors(formula.fresnel)
    return Errors(formula.name, {name: np.where(np.isnan(e), np.inf, e) for name, e in of.items()})


def _numbers(x: Any) -> np.ndarray:
    return np.array(dr.detach(x), np.float64)


def _relative(found: Any, truth: np.ndarray) -> np.ndarray:
    return np.abs(_numbers(found) - truth) / truth


# ----------------------------------------------- Bounds ----------------------------------------------------


def _wrong(lobes: Lobes, truth: Truth, angles: FresnelGrid) -> tuple[Lobes, Truth, FresnelGrid]:
    """Return alpha and index of refraction 1 in 30,000 too large."""
    factor = np.float32(1 + 1 / 30_000)
    lobes = replace(lobes, alpha=lobes.alpha * factor, ior=lobes.ior * factor)
    return lobes, truth, replace(angles, iors=angles.iors * factor)


def _hold(cases: Cases, lobes: Lobes, found: Sequence[Errors], wrong: Errors) -> None:
    ours, report = found[-1], found[0]
    for name, title in QUANTITIES.items():
        error, fault = (e.of[name] if name == "f" else e.of[name][lobes.in_bound] for e in (ours, wrong))
        least = "alpha and index 1 in 30,000 too large"
        usual, everywhere = BOUND_OF.get(name, (BOUND, BOUND_EVERYWHERE))
        where = "cosines 1e-7 … 1, IOR 1e-3 … 1e6" if name == "f" else "alpha 1e-4 … 1, D ≥ 1e-7 of its peak"
        # the grid holds a thousand points and more, so that the 99.9th percentile is one of its last
        of_ours, of_fault = (np.quantile(x, 0.999) for x in (error, fault))
        cases.at_most(f"{title}, p99.9", where, "a few roundings", of_ours, usual, fault=(least, of_fault))
        where = "the whole grid: alpha 1e-8 … 100, D ≥ 1e-20 of its peak"
        expected = "a few roundings, which exp enlarges by up to 46"
        of_ours, of_fault = (e.of[name].max() for e in (ours, wrong))
        cases.at_most(f"{title}, largest", where, expected, of_ours, everywhere, fault=(least, of_fault))
    what = "relative error of D by cosines of normalised vectors"
    why = "lost to cancellation: a study that cannot see this would be blind"
    for alpha in (1e-4, 1e-3):
        median = np.median(report.of["d"][lobes.in_bound & np.isclose(ALPHAS[lobes.cell[:, 0]], alpha)])
        cases.at_least(f"the report's form, median at alpha {alpha:g}", what, why, median, 10 * BOUND)


def _decade(cosines: np.ndarray) -> np.ndarray:
    return np.clip(np.floor(-np.log10(np.float64(cosines))), 0, DECADES - 1).astype(int)


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
    grid = FresnelGrid.at(cosines, iors)
    found = _numbers(Ours().fresnel(mi.Float(grid.cosines), mi.Float(grid.iors)))
    name, what = "F at the critical angle", "the 40 float32 cosines on either side of it, IOR 0.5 … 0.9999"
    why = "√ of a rounding: 1 - F is 4 g / (η² cos θ) there, and g² is known to a rounding of cos²"
    cases.at_most(name, what, why, np.abs(found / grid.truth - 1).max(), 16 * np.sqrt(ROUNDING))
    cases.at_least(f"{name}, smallest", "the same", "reached from both sides", found.min(), 0.9)


# ------------------------------------------------ Tables ---------------------------------------------------


def _table_by_alpha(study: Study, lobes: Lobes, found: Sequence[Errors]) -> None:
    rows = []
    for a, alpha in enumerate(ALPHAS):
        here = (lobes.cell[:, 0] == a) & (lobes.steepness <= STEEPNESS[5])
        if here.any():
            errors = [e.of["value"][here] for e in found]
            rows.append((f"{alpha:g}", int(here.sum()), *(f(e) for e in errors for f in (np.median, np.max))))
    columns = ("alpha", "pairs", *(f"{e.formula}, {what}" for e in found for what in ("median", "largest")))
    title = "Relative error of BSDF cos where D is at least 1e-7 of its peak"
    note = "roughconductor raises alpha to 1e-4, and its Fresnel term cancels for an IOR near 1."
    study.table("bsdf-by-alpha", title, columns, rows, note)


def _worst_cases(study: Study, lobes: Lobes, angles: FresnelGrid, ours: Errors) -> None:
    rows = []
    for name, title in QUANTITIES.items():
        i = int(np.argmax(ours.of[name]))
        if name == "f":
            inputs = f"cos {hexadecimal([angles.cosines[i]])}, IOR {hexadecimal([angles.iors[i]])}"
        else:
            inputs = f"wi {hexadecimal(lobes.wi[i])}, wo {hexadecimal(lobes.wo[i])}, "
            inputs += f"alpha {hexadecimal([lobes.alpha[i]])}, IOR {hexadecimal([lobes.ior[i]])}"
        steepness = "" if name == "f" else float(lobes.steepness[i])
        rows.append((title, float(ours.of[name][i]), steepness, inputs))
    heading = "The worst of the whole grid, with their inputs"
    study.table("bsdf-worst", heading, ("quantity", "relative error", "tan²θh/alpha²", "inputs"), rows)


# ----------------------------------------------- Heat maps -------------------------------------------------


def _heat_maps(study: Study, lobes: Lobes, angles: FresnelGrid, found: Sequence[Errors]) -> None:
    alphas = ("alpha", [f"{a:g}" for a in ALPHAS])
    cosines = ("cos θi", [f"{c:g}" for c in COSINES])
    steep = ("tan²θh/alpha² below", [f"{t:.3g}" for t in STEEPNESS[1:]])
    values, index = np.unique(angles.iors, return_inverse=True)
    iors = ("IOR", [f"1{n - 1:+.0e}" if 0 < abs(n - 1) < 1e-3 else f"{n:g}" for n in np.float64(values)])
    decades = ("cos θ down to", [f"1e-{k + 1}" for k in range(DECADES)])
    lobe = "Largest relative error of the lobe without its Fresnel term, D G₁ / (4 cos θi)"
    a, c, s = lobes.cell.T
    for name, title, quantity, (column, x), (row, y), caption in (
        ("bsdf-cosine", lobe, "pdf", (a, alphas), (c, cosines), "By roughness and angle, over all angles off "
         "the mirror direction down to D at 1e-20 of its peak."),
        ("bsdf-steepness", lobe, "pdf", (a, alphas), (s, steep), "By roughness and angle off the mirror "
         "direction. Blank: no pair of float32 directions lies there."),
        ("fresnel", "Largest relative error of F", "f", (index, iors), (_decade(angles.cosines), decades),
         "By index of refraction and angle."),
    ):  # fmt: skip
        maps = [_grid(row, column, e.of[quantity], (len(y[1]), len(x[1]))) for e in found]
        study.plot(name, title, _figure(maps, [e.formula for e in found], x, y), caption)


def _grid(row: np.ndarray, column: np.ndarray, error: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the largest errors by cell; NaN in empty ones."""
    largest = np.full(shape, np.nan)
    np.fmax.at(largest, (row, column), error)
    return largest


def _figure(maps: Sequence[np.ndarray], titles: Sequence[str], x: tuple, y: tuple) -> Any:
    """Return heat maps side by side on one logarithmic scale from a rounding to 1."""
    from matplotlib.colors import LogNorm

    figure, axes = panels(13, 4.2, 1, len(maps), sharey=True)
    for panel, values, title in zip(axes, maps, titles, strict=True):
        shown = panel.imshow(np.clip(values, ROUNDING, 1), norm=LogNorm(ROUNDING, 1), aspect="auto")
        panel.set_title(title)
        panel.set_xlabel(x[0])
        panel.set_xticks(range(len(x[1])), x[1], rotation=90)
    axes[0].set_ylabel(y[0])
    axes[0].set_yticks(range(len(y[1])), y[1])
    figure.colorbar(shown, ax=axes, label="relative error (1 and more in one colour)")
    return figure
