"""A BSDF under examination, and what several of its laws need to know."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.checks import probe
from mrt_mitsuba.validation.checks.law import Skip, Subject
from mrt_mitsuba.validation.checks.probe import ROUNDED, Array, Lanes, Probe, is_scalar, joined, unit
from mrt_mitsuba.validation.checks.sphere import DEPTH, POINTS, Cells, encode, integrate

ANGLES = (0, 20, 45, 60, 75, 85, 89, 110, 150)  # of incidence, in degrees; beyond 90 from below
QUICK_ANGLES = (0, 50, 85, 140)
FIT = 5e-3  # the rational fits of Smith's G₁ in use are off by up to 0.35 %, and the densities with them
POINTWISE = 2e-3  # relative, beyond what rounding explains
OVERLOOKED = 0.02  # share of samples about which quadrature may know nothing; of lobes it resolves, 0.001
NARROW = 16 * ROUNDED  # width of a lobe that rounded directions do not resolve


class Case(Subject, Probe):
    """A BSDF under examination, and what several laws need to know of it."""

    word = "bsdf"

    def __init__(self, given: Any, quick: bool, seed: int) -> None:
        super().__init__(given, quick, seed)
        if not isinstance(self.plugin, mi.BSDF):
            kind = type(self.plugin).__name__
            raise UsageError(f"{kind} is not a BSDF of {mi.variant()}: give a dict or a loaded BSDF")

    @cached_property
    def views(self) -> list[SimpleNamespace]:
        """Directions of incidence ``wi`` at all angles, each at a ``uv``, and ``samples`` drawn with ``u``.

        ``density``: pdf() at the samples that count, of lobes with a width and not refused; 0 elsewhere. The
        first quarter (``pilot``, directions) makes the cells in which the other ``count`` are judged, by the
        ``codes`` of those that count and their ``share``. ``holes``: the share at which eval() is not finite.
        """
        found = []
        for angle in QUICK_ANGLES if self.quick else ANGLES:
            wi = probe.direction(np.cos(np.radians(angle)), self.rng.uniform(0, 2 * np.pi))
            uv, u = self.uniform(2), self.uniform(self.count(2**16, 2**19), 3)
            samples = self.sample(wi, u, uv)
            value, pdf = self.both(wi, samples.wo, uv)
            density, first = np.where(live(wi, samples, value, pdf), pdf, 0), len(u) // 4
            pilot, rest = (samples.wo[part][density[part] > 0] for part in np.s_[:first, first:])
            known = {"wi": wi, "uv": uv, "u": u, "samples": samples, "density": density, "pilot": pilot}
            holes, count = ((density > 0) & ~np.isfinite(value).all(axis=1)).mean(), len(u) - first
            judged = {"codes": encode(rest), "count": count, "share": len(rest) / count, "holes": holes}
            found.append(SimpleNamespace(**known, **judged))
        return found

    @cached_property
    def drawn(self) -> tuple[Lanes, dict[str, Array]]:
        """The first samples of all views, and what they were drawn with."""
        few = slice(0, self.count(2**12, 2**13))
        at = {name: np.repeat(rows, few.stop, axis=0) for name, rows in self.incidence.items()}
        u = np.concatenate([view.u[few] for view in self.views])
        return joined([view.samples.only(few) for view in self.views]), {**at, "u": u}

    @cached_property
    def incidence(self) -> dict[str, Array]:
        """The directions of incidence and texture coordinates of all views."""
        return {name: np.array([getattr(view, name) for view in self.views]) for name in ("wi", "uv")}

    @cached_property
    def densities(self) -> list[Cells | None]:
        """The integrals of the density for each view, in cells that resolve it; None where none do."""
        return [self._integrals(view) for view in self.views]

    def _integrals(self, view: SimpleNamespace) -> Cells | None:
        # around the mirror direction at all scales, where lobes may be that are not sampled
        around = 10 ** self.rng.uniform(-4, 0, (600, 1)) * self.rng.normal(size=(600, 3))
        seeds = encode(np.concatenate([view.pilot, unit(view.wi * [-1, -1, 1] + around)]))
        most = max(len(view.u) // 4000, 8)
        cells = Cells.around(seeds, most, coarsest=3 if is_scalar() else 4)
        held = np.bincount(cells.find(encode(view.pilot)), minlength=len(cells.start))[cells.level == DEPTH]
        # at the normal, all azimuths of the finest cells are one place
        centre = (np.hypot(*view.pilot.T[:2]) < np.sqrt(2) * 0.5**DEPTH).sum()
        if max(held[held > 4 * most].sum(), centre) > 0.01 * len(view.pilot):
            return None
        known = view.codes, np.ones(len(view.codes)), view.count
        found = integrate(lambda wo: np.maximum(self.pdf(view.wi, wo, view.uv), 0), cells, self.rng, *known)
        # samples in cells of whose points less than two are expected where the lobe is
        cell, density = found.find(view.codes), view.density[-view.count :]
        covered = np.bincount(cell, 1 / (view.count * density[density > 0]), minlength=len(found.start))
        overlooked = (covered * POINTS < 2 * found.solid_angle)[cell].sum() / view.count
        return found if found.mean.sum() > view.share or overlooked < OVERLOOKED else None

    def copy(self) -> Case:
        """Return a case whose parameters can be changed, with a BSDF of its own if it can be loaded."""
        made = Case(self.plugin if self.description is None else self.load(), self.quick, self.seed)
        made.description, made.pairs = self.description, self.pairs
        return made

    def need_smooth(self) -> None:
        """Raise ``Skip`` where no lobe has a width."""
        if not (any(view.density.any() for view in self.views) or self.pairs.value.any()):
            raise Skip("all lobes are single directions (delta): eval and pdf are 0")

    @cached_property
    def pairs(self) -> Lanes:
        """Directions over the sphere, ``wi`` and ``wo``, some sampled and some at random, at a ``uv`` each.

        With ``value`` and ``pdf`` there, how far these change as directions are rounded (``value_off``,
        ``pdf_off``), and ``eta``, the index of refraction at wo over that at wi.
        """
        count = self.count(2**13, 2**15)
        wi, uv = self.units(count), self.uniform(count, 2)
        s = self.sample(wi, self.uniform(count, 3), uv)
        usable = np.isfinite(s.wo).all(axis=1) & ~s.delta & s.lit
        usable &= (self.rng.random(count) < 0.75) & ~narrow(wi, s)
        wo = unit(np.where(usable[:, None], s.wo, self.units(count)))
        crosses, eta = wi[:, 2] * wo[:, 2] < 0, np.where(usable, s.eta, np.nan)
        for side in (wi[:, 2] > 0, wi[:, 2] < 0):
            there = eta[side & crosses & np.isfinite(eta)]
            eta[side & crosses & ~usable] = np.median(there) if len(there) else 1
        value, pdf = self.both(wi, wo, uv)
        off = self.spread(lambda *at: np.column_stack(self.both(*at)), wi, wo, uv)
        eta = np.where(crosses, eta, 1)
        return Lanes(
            wi=wi, wo=wo, uv=uv, eta=eta, value=value, pdf=pdf, value_off=off[:, :-1], pdf_off=off[:, -1]
        )

    @cached_property
    def lit(self) -> Lanes:
        """The pairs with a value, away from the horizon, over which values jump."""
        p = self.pairs
        up = (np.abs(p.wo[:, 2]) > 0.05) & (np.abs(p.wi[:, 2]) > 0.05)
        return p.only(up & np.isfinite(p.value).all(axis=1) & (p.value > 0).any(axis=1))

    def spread(self, quantity: Any, wi: Array, wo: Array, uv: Array, *others: Array) -> Array:
        """Return the largest change of ``quantity(wi, wo, uv, …)`` as directions move by a rounding."""
        return probe.spread(lambda i, o: quantity(i, o, uv, *others), (wi, wo), self.rng)


def live(wi: Array, s: Lanes, value: Array, pdf: Array) -> Array:
    """Return where samples come from lobes with a width and count for the density.

    Weight 0 is how ``sample`` refuses: its direction is then any, or on the wrong side. It may also be that
    the value is 0 there, or that the weight is wrong; but then the stated density is that of the direction.
    """
    f, crosses = mi.BSDFFlags, wi[..., 2] * s.wo[:, 2] < 0
    astray = (s.type & np.where(crosses, int(f.Reflection), int(f.Transmission))) != 0
    dark = ~s.lit & (value != 0).any(axis=1)
    refused = dark & (astray | ~np.isclose(s.pdf, pdf, rtol=1e-3))
    return ~s.delta & np.isfinite(pdf) & (pdf > 0) & ~refused


def narrow(wi: Array, s: Lanes) -> Array:
    """Return where samples are of a component whose lobe is narrower than rounded directions resolve."""
    drawn, found = ~s.delta & (s.pdf > 0), np.zeros(len(s.pdf), bool)
    # a lobe of width w along the plane of incidence is w cos θ wide across: density 1 / (w² cos θ)
    sharpness = s.pdf / np.abs(wi[..., 2])
    for part in (drawn & (s.component == component) for component in np.unique(s.component[drawn])):
        found |= part & (np.median(sharpness[part]) > NARROW**-2)
    return found


def parameters(case: Case) -> Iterator[tuple[str, Any]]:
    """Yield the parameters that hold floating-point numbers which are amounts."""
    params = mi.traverse(case.plugin)
    for key in params.keys():  # noqa: SIM118 - SceneParameters is not a dict
        with suppress(TypeError):  # one that was left out is None, which Dr.Jit cannot read
            value = params[key]
            array = dr.is_array_v(value) and dr.is_float_v(value) and not dr.is_matrix_v(value)
            amount = (array or isinstance(value, float)) and not key.endswith(("to_uv", ".wavelengths"))
            if amount and np.size(np.array(value)) > 0:
                yield key, value


@contextmanager
def changed(case: Case, key: str, change: Any) -> Iterator[None]:
    """Change a parameter for a while."""
    params = mi.traverse(case.plugin)
    before = type(params[key])(params[key])  # else it changes with the BSDF
    params.update({key: change(before)})
    try:
        yield
    finally:
        params.update({key: before})
