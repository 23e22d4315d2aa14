"""The laws of an emitter as part of a loaded scene: densities, weights, finite numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mrt_mitsuba.validation.checks.law import Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, lanes

SAME = 1e-3  # relative: the same formula, evaluated once more


@dataclass(frozen=True)
class Case:
    """An emitter, and points from which it is looked at [N, 3]."""

    emitter: Any
    points: Array
    rng: np.random.Generator

    def sample(self) -> tuple[Array, ...]:
        """Return direction, distance, density, density again, whether delta, weight and value of samples."""

        def call(mi: Any, p: Any, u: Any) -> list[Any]:
            it = dr.zeros(mi.SurfaceInteraction3f)
            it.p = p
            if mi.is_spectral:
                it.wavelengths = type(it.wavelengths)(450, 500, 550, 600)
            ds, weight = self.emitter.sample_direction(it, u)
            value = self.emitter.eval_direction(it, ds)
            again = self.emitter.pdf_direction(it, ds)
            spectra = (mi.unpolarized_spectrum(x) for x in (weight, value))
            return [ds.d, ds.dist, ds.pdf, again, ds.delta, *spectra]

        u = self.rng.random((len(self.points), 2), np.float32)
        try:
            d, dist, pdf, again, delta, weight, value = lanes(call, ("Point3f", self.points), ("Point2f", u))
        except (NotImplementedError, RuntimeError) as error:
            raise Skip(
                f"directions cannot be sampled: {str(error).strip().splitlines()[-1][:120]}"
            ) from error
        return d, dist[:, 0], pdf[:, 0], again[:, 0], delta[:, 0].astype(bool), weight, value


def density(law: Law, case: Case) -> None:
    """The density that a sample states against ``pdf_direction``."""
    _, _, pdf, again, delta, weight, _ = case.sample()
    lit = (weight != 0).any(axis=1) & ~delta
    if not lit.any():
        raise Skip("light comes from single directions (delta), or none was sampled")
    error = np.abs(pdf[lit] / again[lit] - 1)
    law.at_most("density of a direction against pdf_direction(), relative", error.max(), SAME, "one number")


def weights(law: Law, case: Case) -> None:
    """The weight of a sample against ``eval_direction`` over its density."""
    _, _, pdf, _, _, weight, value = case.sample()
    lit = (weight != 0).any(axis=1) & (pdf > 0) & np.isfinite(weight).all(axis=1)
    if not lit.any():
        raise Skip("no sample carries light")
    expected = value[lit] / pdf[lit, None]
    error = np.abs(weight[lit] - expected).max(axis=1) / np.abs(weight[lit]).max(axis=1)
    law.at_most("weight against eval_direction() / density, relative", error.max(), SAME, "one number")


def finite(law: Law, case: Case) -> None:
    """All numbers of samples are finite, weights and densities not negative."""
    d, dist, pdf, _, _, weight, value = case.sample()
    lit = (weight != 0).any(axis=1)
    bad = ~(np.isfinite(weight) & (weight >= 0)).all(axis=1) | ~(np.isfinite(value) & (value >= 0)).all(
        axis=1
    )
    bad |= lit & ~(np.isfinite(d).all(axis=1) & np.isfinite(dist) & (pdf >= 0))
    law.at_most("samples that are not finite, or negative", bad.sum(), 0, "one NaN spoils a picture")


LAWS = {"density": density, "weights": weights, "finite": finite}
