"""The laws of an emitter as part of a loaded scene: densities, directions, weights, finite numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from mrt_mitsuba.validation.checks.bsdf_case import BEYOND, ROUNDED, excess, spread
from mrt_mitsuba.validation.checks.law import LEVEL, Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, Lanes, at_wavelengths, is_scalar, lanes
from mrt_mitsuba.validation.checks.sphere import Cells, chi_square, encode, integrate
from mrt_mitsuba.validation.tools.image_tests import sidak

SAME = 1e-3  # relative: the same formula, evaluated once more
TURNED = 4 * ROUNDED  # a direction passes through angles, a transform, and back
WHY = "one number"
LENGTH = 1e-4  # relative: a square root, and the difference of two points


@dataclass(frozen=True)
class Samples(Lanes):
    """What ``sample_direction`` gives for N points, and what other functions say of it."""

    p: Array  # [N, 3], the sampled point
    d: Array  # [N, 3]
    dist: Array
    pdf: Array
    again: Array  # pdf_direction()
    delta: Array  # bool [N]
    weight: Array  # [N, channels]
    value: Array  # eval_direction() [N, channels]

    @property
    def lit(self) -> Array:
        return (self.weight != 0).any(axis=1)


@dataclass
class Case:
    """An emitter, and points from which it is looked at [N, 3]."""

    emitter: Any
    points: Array
    rng: np.random.Generator

    @staticmethod
    def within(scene: Any, emitter: Any, rng: np.random.Generator) -> Case:
        """Return a case with points in and about the box of a scene."""
        box = scene.bbox()
        low, high = (np.nan_to_num(np.ravel(np.array(c)), posinf=1, neginf=-1) for c in (box.min, box.max))
        points = rng.uniform(1.1 * low - 0.1 * high, 1.1 * high - 0.1 * low, (2**12, 3))
        return Case(emitter, points.astype(np.float32), rng)

    @property
    def around(self) -> bool:
        """Whether light comes from all around, and not from single directions, a surface or a point."""
        flags = int(self.emitter.flags())
        return bool(flags & int(mi.EmitterFlags.Infinite)) and not flags & int(mi.EmitterFlags.Delta)

    @cached_property
    def samples(self) -> Samples:
        return self.sample(self.points)

    def sample(self, points: Array) -> Samples:
        """Return a sample for each point."""

        def call(mi: Any, p: Any, u: Any) -> list[Any]:
            it = _seen_from(p)
            ds, weight = self.emitter.sample_direction(it, u)
            value = self.emitter.eval_direction(it, ds)
            again = self.emitter.pdf_direction(it, ds)
            spectra = (mi.unpolarized_spectrum(x) for x in (weight, value))
            return [ds.p, ds.d, ds.dist, ds.pdf, again, ds.delta, *spectra]

        u = self.rng.random((len(points), 2), np.float32)
        try:
            p, d, dist, pdf, again, delta, *spectra = lanes(call, ("Point3f", points), ("Point2f", u))
        except (NotImplementedError, RuntimeError) as error:
            raise Skip(
                f"directions cannot be sampled: {str(error).strip().splitlines()[-1][:120]}"
            ) from error
        return Samples(p, d, dist[:, 0], pdf[:, 0], again[:, 0], delta[:, 0].astype(bool), *spectra)

    def seen(self, d: Array) -> tuple[Array, Array]:
        """Return the density of directions [N] and the light that is seen there [N, channels]."""

        def call(mi: Any, d: Any) -> list[Any]:
            it = _seen_from(mi.Point3f(*map(float, self.points[0])))
            ds, _ = self.emitter.sample_direction(it, mi.Point2f(0.5))
            ds.d, it.wi = d, -d
            return [self.emitter.pdf_direction(it, ds), mi.unpolarized_spectrum(self.emitter.eval(it))]

        pdf, light = lanes(call, ("Vector3f", d))
        return pdf[:, 0], light

    @cached_property
    def spread(self) -> tuple[Array, Array]:
        """Return how far ``seen`` changes as directions move by what rounding does; 0 for other lights."""
        s = self.samples
        if not self.around:
            return np.zeros_like(s.pdf), np.zeros_like(s.value)
        pdf, *light = spread(lambda d: np.column_stack(self.seen(d)), [s.d], self.rng, TURNED).T
        return pdf, np.stack(light, axis=-1)


def _seen_from(p: Any) -> Any:
    it = dr.zeros(mi.SurfaceInteraction3f)
    it.p = p
    return at_wavelengths(it)


def density(law: Law, case: Case) -> None:
    """The density that a sample states against ``pdf_direction``."""
    s = case.samples
    counts = s.lit & ~s.delta
    if not counts.any():
        raise Skip("light comes from single directions (delta), or none was sampled")
    error = excess(s.pdf, s.again, case.spread[0])[counts]
    law.at_most(f"density of a direction against pdf_direction(), {BEYOND}", error.max(), SAME, WHY)


def sampling(law: Law, case: Case) -> None:
    """Direction and distance lead to the sampled point; light from all around follows its density."""
    found = case.samples.only(case.samples.lit)
    if not len(found.pdf):
        raise Skip("no sample carries light")
    points = case.points[case.samples.lit]
    away = found.p - points.astype(np.float64)
    scale = np.abs(found.dist) + np.abs(points).max(axis=1)
    off = np.linalg.norm(away - found.dist[:, None] * found.d, axis=1) / scale
    what = "sampled point off the stated direction and distance, relative"
    law.at_most(what, np.nan_to_num(off).max(), LENGTH, "one place, said in two ways")
    if not case.around:
        law.notes.append("directions to surfaces are judged with their shapes")
        return
    count = 2**12 if is_scalar() else 2**18
    drawn = case.sample(np.broadcast_to(case.points[:1], (count, 3)))
    codes, pilot = encode(drawn.d[count // 4 :]), encode(drawn.d[: count // 4])
    cells = Cells.around(pilot, max(len(pilot) // 1000, 8))
    integrals = integrate(
        lambda d: case.seen(d)[0][:, None], cells, case.rng, codes, np.ones(len(codes)), len(codes)
    )
    tests, _ = chi_square(integrals, codes, len(codes))
    p = sidak(min(float(stats.chi2.sf(*test)) for test in tests), len(tests))
    law.at_least("chance of such counts if directions follow pdf_direction()", p, LEVEL, "one in a million")


def weights(law: Law, case: Case) -> None:
    """The weight of a sample against ``eval_direction`` over its density, and against what is seen there."""
    s, allowed = case.samples, case.spread[1]
    counts = s.lit & (s.pdf > 0) & np.isfinite(s.weight).all(axis=1)
    if not counts.any():
        raise Skip("no sample carries light")
    error = excess(s.weight * s.pdf[:, None], s.value, allowed)[counts]
    law.at_most(f"weight against eval_direction() / density, {BEYOND}", error.max(), SAME, WHY)
    if case.around:
        error = excess(case.seen(s.d)[1], s.value, allowed)[counts]
        law.at_most(f"eval() where it is seen against eval_direction(), {BEYOND}", error.max(), SAME, WHY)


def finite(law: Law, case: Case) -> None:
    """All numbers of samples are finite, directions one unit long, weights and densities not negative."""
    s = case.samples
    bad = ~np.all([np.isfinite(x) & (x >= 0) for x in (s.weight, s.value)], axis=(0, 2))
    length = np.abs(np.linalg.norm(s.d.astype(np.float64), axis=1) - 1)
    bad |= s.lit & ~((length <= LENGTH) & np.isfinite(s.dist) & (s.pdf >= 0))
    what = "samples that are not finite, or negative, or not of unit length"
    law.at_most(what, bad.sum(), 0, "one NaN spoils a picture")


LAWS = {"density": density, "sampling": sampling, "weights": weights, "finite": finite}
