"""The laws of an emitter as part of a loaded scene: densities, directions, weights, finite numbers."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from mrt_mitsuba.validation.checks import probe
from mrt_mitsuba.validation.checks.law import LEVEL, RARE, Law, Skip, Subject, figures
from mrt_mitsuba.validation.checks.probe import BEYOND, Array, Lanes, excess, lanes
from mrt_mitsuba.validation.checks.sphere import Cells, chi_square, encode, integrate
from mrt_mitsuba.validation.tools.compare import sidak

SAME = 1e-3  # relative: the same formula, evaluated once more
TURNED = 4 * probe.ROUNDED  # a direction passes through angles, a transform, and back
LENGTH = 1e-4  # relative: a square root, and the difference of two points


class Case(Subject):
    """An emitter of a scene, and points in and about its box from which it is looked at [N, 3]."""

    def __init__(self, scene: Any, emitter: Any, quick: bool, seed: int) -> None:
        super().__init__(emitter, quick, seed)
        box = scene.bbox()
        low, high = (np.nan_to_num(np.ravel(np.array(c)), posinf=1, neginf=-1) for c in (box.min, box.max))
        points = self.rng.uniform(1.1 * low - 0.1 * high, 1.1 * high - 0.1 * low, (2**12, 3))
        self.points = points.astype(np.float32)
        flags = int(emitter.flags())
        # whether light comes from all around, and not from single directions, a surface or a point
        self.around = bool(flags & int(mi.EmitterFlags.Infinite)) and not flags & int(mi.EmitterFlags.Delta)

    @cached_property
    def samples(self) -> Lanes:
        return self.sample(self.points)

    def sample(self, points: Array) -> Lanes:
        """Return a sample for each point; ``again``: pdf_direction(), ``value``: eval_direction()."""

        def call(p: Any, u: Any) -> list[Any]:
            it = _seen_from(p)
            ds, weight = self.plugin.sample_direction(it, u)
            value, again = self.plugin.eval_direction(it, ds), self.plugin.pdf_direction(it, ds)
            return [ds.p, ds.d, ds.dist, ds.pdf, again, ds.delta, weight, value]

        try:
            found = lanes(call, ("Point3f", points), ("Point2f", self.uniform(len(points), 2)))
        except (NotImplementedError, RuntimeError) as error:
            raise Skip("directions cannot be sampled") from error
        names = ("p", "d", "dist", "pdf", "again", "delta", "weight", "value")
        return Lanes(**dict(zip(names, found, strict=True)), lit=(found[6] != 0).any(axis=1))

    def seen(self, d: Array) -> tuple[Array, Array]:
        """Return the density of directions [N] and the light that is seen there [N, channels]."""

        def call(d: Any) -> list[Any]:
            it = _seen_from(mi.Point3f(*map(float, self.points[0])))
            ds, _ = self.plugin.sample_direction(it, mi.Point2f(0.5))
            ds.d, it.wi = d, -d
            return [self.plugin.pdf_direction(it, ds), self.plugin.eval(it)]

        pdf, light = lanes(call, ("Vector3f", d))
        return pdf, light

    @cached_property
    def spread(self) -> tuple[Array, Array]:
        """Return how far ``seen`` changes as directions move by what rounding does; 0 for other lights."""
        s = self.samples
        if not self.around:
            return np.zeros_like(s.pdf), np.zeros_like(s.value)
        found = probe.spread(lambda d: np.column_stack(self.seen(d)), [s.d], self.rng, TURNED)
        return found[:, 0], found[:, 1:]


def _seen_from(p: Any) -> Any:
    it = dr.zeros(mi.SurfaceInteraction3f)
    it.p = p
    return probe.at_wavelengths(it)


@figures(same=("most", f"density of a direction against pdf_direction(), {BEYOND}", SAME, "one number"))
def density(law: Law, case: Case) -> None:
    """The density that a sample states is ``pdf_direction``."""
    s = case.samples
    if not (s.lit & ~s.delta).any():
        raise Skip("light comes from single directions (delta), or none was sampled")
    law.hold("same", excess(s.pdf, s.again, case.spread[0])[s.lit & ~s.delta])


@figures(
    place=("most", "sampled point off the stated direction and distance, relative", LENGTH,
           "one place, said in two ways"),
    counts=("at least", "chance of such counts if directions follow pdf_direction()", LEVEL, RARE),
)  # fmt: skip
def sampling(law: Law, case: Case) -> None:
    """p = o + dist · d; light from all around follows its density (Pearson's χ²)."""
    s, points = case.samples, case.points.astype(np.float64)
    if not s.lit.any():
        raise Skip("no sample carries light")
    scale = np.abs(s.dist) + np.abs(points).max(axis=1)
    off = np.linalg.norm(s.p - points - s.dist[:, None] * s.d, axis=1) / scale
    law.hold("place", np.nan_to_num(off[s.lit]))
    if not case.around:
        law.notes.append("directions to surfaces are judged with their shapes")
        return
    count = 2**12 if probe.is_scalar() else 2**18
    pilot, codes = np.split(encode(case.sample(np.repeat(case.points[:1], count, axis=0)).d), [count // 4])
    cells, ones = Cells.around(pilot, max(len(pilot) // 1000, 8)), np.ones(len(codes))
    integrals = integrate(lambda d: case.seen(d)[0], cells, case.rng, codes, ones, len(codes))
    chances = stats.chi2.sf(*chi_square(integrals, codes, len(codes))[0].T)
    law.hold("counts", sidak(float(chances.min()), len(chances)))


@figures(
    weight=("most", f"weight against eval_direction() / density, {BEYOND}", SAME, "one number"),
    seen=("most", f"eval() where it is seen against eval_direction(), {BEYOND}", SAME, "one number"),
)  # fmt: skip
def weights(law: Law, case: Case) -> None:
    """weight · pdf = ``eval_direction`` = what is seen there."""
    s, allowed = case.samples, case.spread[1]
    counts = s.lit & (s.pdf > 0) & np.isfinite(s.weight).all(axis=1)
    if not counts.any():
        raise Skip("no sample carries light")
    law.hold("weight", excess(s.weight * s.pdf[:, None], s.value, allowed)[counts])
    if case.around:
        law.hold("seen", excess(case.seen(s.d)[1], s.value, allowed)[counts])


@figures(bad=("none", "samples that are not finite, or negative, or not of unit length", 0,
              "one NaN spoils a picture"))  # fmt: skip
def finite(law: Law, case: Case) -> None:
    """All numbers of samples are finite, directions one unit long, weights and densities not negative."""
    s = case.samples
    bad = ~np.all([np.isfinite(x) & (x >= 0) for x in (s.weight, s.value)], axis=(0, 2))
    length = np.abs(np.linalg.norm(s.d.astype(np.float64), axis=1) - 1)
    law.hold("bad", bad | s.lit & ~((length <= LENGTH) & np.isfinite(s.dist) & (s.pdf >= 0)))


LAWS = {law.__name__: law for law in (density, sampling, weights, finite)}
