"""A BSDF under test, and what several of its laws need to know."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from . import probe
from .case import Case, Given
from .law import Skip
from .probe import DIRECTION_EPS, Array, Lanes, Probe, excess, joined, unit

ANGLES = (0, 20, 45, 60, 75, 85, 89, 110, 150)  # of incidence, in degrees; beyond 90 from below
QUICK_ANGLES = (0, 50, 85, 140)
POINTWISE_TOL = 2e-3  # relative, beyond what rounding explains
MIN_LOBE_WIDTH = 16 * DIRECTION_EPS  # width of a lobe that rounded directions do not resolve


class BsdfCase(Case, Probe):
    """A BSDF under test, and what several laws need to know of it."""

    word = "bsdf"

    def __init__(self, given: Given, quick: bool, seed: int) -> None:
        Case.__init__(self, given, quick, seed)
        Probe.__init__(self, self.plugin)
        self.need("a BSDF", isinstance(self.plugin, mi.BSDF))

    @property
    def angles(self) -> tuple[int, ...]:
        """Angles of incidence in degrees."""
        return QUICK_ANGLES if self.quick else ANGLES

    @cached_property
    def views(self) -> list[Lanes]:
        """Samples for a direction of incidence at each angle.

        ``density`` is pdf() at the samples that count, of lobes with a width and not refused; 0 elsewhere.
        """
        views = []
        for angle in self.angles:
            wi = probe.direction(np.cos(np.radians(angle)), self.rng.uniform(0, 2 * np.pi))
            u = self.uniform(self.count(2**16, 2**19), 3)
            at = Lanes(wi=np.tile(wi, (len(u), 1)), uv=np.tile(self.uniform(2), (len(u), 1)), u=u)
            samples = self.sample(at)
            value, pdf = self.both(samples)
            views.append(samples.having(density=np.where(live(samples, value, pdf), pdf, 0)))
        return views

    @cached_property
    def drawn(self) -> Lanes:
        """The first samples of all views."""
        few = self.count(2**12, 2**13)
        return joined([view[:few] for view in self.views])

    @cached_property
    def incidence(self) -> Lanes:
        """The first sample of each view, with its ``wi`` and ``uv``."""
        return joined([view[:1] for view in self.views])

    def copy(self) -> BsdfCase:
        """A case whose parameters can be changed, with a BSDF of its own if it can be loaded."""
        made = BsdfCase(self.plugin if self.description is None else self.load(), self.quick, self.seed)
        made.description = self.description
        made.pairs = self.pairs
        return made

    def need_smooth(self) -> None:
        """Raise ``Skip`` where no lobe has a width."""
        if not (any(view.density.any() for view in self.views) or self.pairs.value.any()):
            raise Skip("all lobes are single directions (delta): eval and pdf are 0")

    def at_random(self, quick: int, full: int) -> Lanes:
        """Directions of incidence ``wi`` over the sphere, ``uv``, and random numbers ``u`` for samples."""
        count = self.count(quick, full)
        return Lanes(wi=self.units(count), uv=self.uniform(count, 2), u=self.uniform(count, 3))

    @cached_property
    def pairs(self) -> Lanes:
        """Directions over the sphere, ``wi`` and ``wo``, some sampled and some at random, at a ``uv`` each.

        With ``value`` and ``pdf`` there, how far these change as directions are rounded (``value_off``,
        ``pdf_off``), and ``eta``, the index of refraction at wo over that at wi.
        """
        s = self.sample(self.at_random(2**13, 2**15))
        count = len(s.pdf)
        usable = s.wo.any(axis=1) & ~s.delta & s.lit
        usable &= (self.rng.random(count) < 0.75) & ~narrow(s)
        wo = unit(np.where(usable[:, None], s.wo, self.units(count)))
        pairs = Lanes(wi=s.wi, wo=wo, uv=s.uv, eta=_indices(s, wo))
        pairs.value, pairs.pdf = self.both(pairs)
        off = self.spread(lambda moved: np.column_stack(self.both(moved)), pairs)
        return pairs.having(value_off=off[:, :-1], pdf_off=off[:, -1])

    @cached_property
    def lit(self) -> Lanes:
        """The pairs with a value, away from the horizon, over which values jump."""
        p = self.pairs
        up = (abs(p.wo[:, 2]) > 0.05) & (abs(p.wi[:, 2]) > 0.05)
        return p[up & np.isfinite(p.value).all(axis=1) & (p.value > 0).any(axis=1)]

    def spread(self, quantity: Callable[[Lanes], Array], at: Lanes) -> Array:
        """The largest change of a quantity as ``wi`` and ``wo`` move by a rounding."""
        return probe.spread(lambda wi, wo: quantity(at.having(wi=wi, wo=wo)), (at.wi, at.wo), self.rng)


def pair_errors(pairs: Lanes, value: Array, pdf: Array) -> Array:
    """Relative errors of values and densities against those of pairs, beyond rounding. [N]"""
    return np.maximum(excess(value, pairs.value, pairs.value_off), excess(pdf, pairs.pdf, pairs.pdf_off))


def _indices(s: Lanes, wo: Array) -> Array:
    """Indices of refraction [N] at directions ``wo`` over those at ``wi``, by what samples state."""
    passed = s.lit & ~s.delta & (s.wi[:, 2] * s.wo[:, 2] < 0) & np.isfinite(s.eta)
    eta = np.ones(len(wo))
    for side in (s.wi[:, 2] > 0, s.wi[:, 2] < 0):
        if (passed & side).any():
            eta[side & (s.wi[:, 2] * wo[:, 2] < 0)] = np.median(s.eta[passed & side])
    return eta


def live(s: Lanes, value: Array, pdf: Array) -> Array:
    """Where samples are to be counted against pdf(): not delta, of positive density, not refused. [N], bool

    Refused: the weight is 0 though the value is not, and the direction is on the wrong side or the stated
    density is not pdf(). With the right density and side, a weight of 0 is wrong, and the sample counts.
    """
    crosses = s.wi[:, 2] * s.wo[:, 2] < 0
    wrong = np.where(crosses, mi.BSDFFlags.Reflection, mi.BSDFFlags.Transmission)
    astray = (s.flags & wrong) != 0
    dark = ~s.lit & (value != 0).any(axis=1)
    refused = dark & (astray | ~np.isclose(s.pdf, pdf, rtol=1e-3))
    return ~s.delta & np.isfinite(pdf) & (pdf > 0) & ~refused


def narrow(s: Lanes) -> Array:
    """Where samples are of a component whose lobe is narrower than rounded directions resolve. [N], bool"""
    drawn = ~s.delta & (s.pdf > 0)
    too_narrow = np.zeros(len(s.pdf), bool)
    # a lobe of width w along the plane of incidence is w cos θ wide across: density 1 / (w² cos θ)
    sharpness = s.pdf / abs(s.wi[:, 2])
    for lobe in np.unique(s.lobe[drawn]):
        part = drawn & (s.lobe == lobe)
        too_narrow |= part & (np.median(sharpness[part]) > MIN_LOBE_WIDTH**-2)
    return too_narrow


def parameters(case: BsdfCase) -> Iterator[tuple[str, mi.Float]]:
    """Yield the parameters that hold floating-point numbers which are amounts."""
    params = mi.traverse(case.plugin)
    for key in list(params.keys()):
        with suppress(TypeError):  # one that was left out is None, which Dr.Jit cannot read
            value = params[key]
            array = dr.is_array_v(value) and dr.is_float_v(value) and not dr.is_matrix_v(value)
            if not array and not isinstance(value, float):
                continue
            if not key.endswith(("to_uv", ".wavelengths")) and np.size(np.array(value)) > 0:
                yield key, value


@contextmanager
def changed(case: BsdfCase, key: str, *, factor: float = 1, summand: mi.Float = 0) -> Iterator[None]:
    """Change a parameter for a while: multiply it by one number, and add another."""
    params = mi.traverse(case.plugin)
    before = type(params[key])(params[key])  # else it changes with the BSDF
    params.update({key: type(before)(before * factor + summand)})
    try:
        yield
    finally:
        params.update({key: before})
