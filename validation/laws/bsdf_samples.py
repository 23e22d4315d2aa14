"""Laws of the samples of a BSDF: their density, weights and energy."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from . import plots, probe
from .bsdf_case import G1_FIT_ERROR, POINTWISE_TOL, BsdfCase, View, live, narrow
from .bsdf_snippets import CELL, SAMPLE, VALUE, WHOLE
from .faults import (
    DEGREE,
    PLACE,
    larger,
    larger_by,
    member,
    of_sample,
    of_weight,
    put,
    smaller,
)
from .law import (
    MIN_QUANTILE_ERRORS,
    SIGMAS,
    Outcome,
    finds,
    measures,
    most,
    number_of,
    p_value,
    share_of,
    sidak,
)
from .probe import BEYOND, Array, Lanes, context, excess, is_scalar, joined
from .sphere import (
    SMALL_CELL_LEVEL,
    Cells,
    chi_square,
    encode,
    hold_small,
    integrate,
)

NUDGED = """for moved in np.eye(3) * 2.0**-18 * np.where(np.array(u) < 0.5, 1, -1):
    a, b, c = map(float, np.array(u) + moved)
    print("random numbers moved by", moved, "direction:", bsdf.sample(ctx, si, a, mi.Point2f(b, c))[0].wo)
"""
UNRESOLVED = "neither float32 directions nor the samples resolve the lobe"
MAX_BROAD_DENSITY = 20.0  # a density per steradian: lobes are then wide against a degree
NUDGE = 2.0**-18  # of a random number: a hundred roundings of the direction
GRAZING = (83, 86, 88, 89.5, 94, 92, 90.5)  # degrees
AGAIN = "the same formula, evaluated once more at a rounded direction"
FITS = "rational fits of Smith's G1 in use are off by 0.35 %"


@larger_by
def in_tenth(ctx, wi, wo):
    """Where a tenth of the samples of a diffuse BSDF go."""
    return wo.x > 0.687


def in_cone(size, pdf, ctx, wi, wo):
    inside = dr.norm(wo - mi.Vector3f(PLACE)) < DEGREE
    return pdf * dr.select(inside, 1 - min(size, 0.9), 1)


def no_density(size, pdf, ctx, wi, wo):
    """0 in a slice of azimuth, so many degrees wide."""
    azimuth = dr.atan2(wo.y, wo.x)
    return dr.select((azimuth > 1) & (azimuth < 1 + size * DEGREE), 0, pdf)


def around_slice(size, bs, weight, *_):
    """Samples of a diffuse BSDF that keep out of a slice of azimuth, so many degrees wide."""
    azimuth = dr.atan2(bs.wo.y, bs.wo.x)
    slice_ = size * DEGREE
    squeezed = 1 + slice_ + (azimuth + dr.pi) * (1 - slice_ / (2 * dr.pi))
    radius = dr.hypot(bs.wo.x, bs.wo.y)
    wo = mi.Vector3f(radius * dr.cos(squeezed), radius * dr.sin(squeezed), bs.wo.z)
    return put(bs, wo=wo), weight


def stairs_of(size, u):
    """Random numbers in steps."""
    return mi.Point2f(dr.floor(u.x / size) * size, u.y)


@finds("cells", "density too large where a tenth of the samples go", 0.03, quick=0.1, pdf=in_tenth)
@finds("small", "density too small in a cone of 1 degree", 0.5, quick=np.inf, pdf=in_cone)
@finds("slices", "no samples in a slice of azimuth, in degrees", 0.3, quick=np.inf, sample=around_slice)
@finds("dark", "no density in a slice of azimuth, in degrees", 0.3, pdf=no_density)
@finds("still", "directions in stairs, in random numbers", 1e-5, u=stairs_of)
@finds("integral", "density too large everywhere", 0.01, pdf=larger)
@measures(
    cells=p_value(
        "smallest p-value of a chi-square test at {angles} angles, corrected for their number", CELL
    ),
    integral=most(
        f"integral of pdf() minus the share of samples that it describes, beyond {SIGMAS} standard errors",
        G1_FIT_ERROR,
        FITS,
        WHOLE,
    ),
    small=p_value("smallest p-value of counts in cells of one degree, corrected for their number", CELL),
    slices=p_value(
        "smallest p-value of counts in slices of one or two degrees, corrected for their number", WHOLE
    ),
    still=share_of(
        "share of samples that stay where two of their random numbers move by 2^-18",
        0.05,
        "directions fill the sphere, in two dimensions; stairs in random numbers show as patterns",
        NUDGED,
    ),
    dark=number_of(
        "share of the light that comes from directions whose pdf() is 0",
        1e-4,
        "light that samples never find is missing from the picture",
        VALUE,
    ),
)
def sampling(law: Outcome, case: BsdfCase) -> None:
    """Samples follow the density: the share of samples in a cell is ∫ pdf dω over it (Pearson's χ²).

    In whole cells of equal counts over both hemispheres; in a full check also in small ones and in narrow
    slices, for faults in one place at any incidence.
    """
    case.need_smooth()
    _nudged(law, case)
    # light has a density, from random directions as well as from sampled ones
    count = case.count(2**14, 2**18)
    rng = np.random.default_rng((case.seed, count))
    wi, wo = probe.unit(rng.normal(size=(2, count, 3)))
    anywhere = Lanes(wi=wi, wo=wo, uv=rng.random((count, 2), np.float32))
    law.check("dark", probe.without_density(*case.both(anywhere)), anywhere)
    judged = [(view, cells) for view, cells in zip(case.views, case.cells, strict=True) if cells]
    if not judged:
        law.notes.append(f"{UNRESOLVED} at every angle")
        return
    at = case.incidence[[bool(cells) for cells in case.cells]]
    tests = []  # [angles, 6, 2]
    worst = []
    beyond = []
    for view, cells in judged:
        test, cell = chi_square(cells, view.codes, view.count, 0.5 * G1_FIT_ERROR)
        tests.append(test)
        worst.append(cell)
        variance = view.share * (1 - view.share) / view.count + cells.variance.sum()
        beyond.append(abs(view.share - cells.mean.sum()) - SIGMAS * np.sqrt(variance))
    by_angle = np.array([*tests, np.sum(tests, axis=0)])  # and of all angles together
    chances = stats.chi2.sf(by_angle[..., 0], by_angle[..., 1])
    chance = sidak(chances.min(), chances.size)
    i = chances[:-1].min(axis=1).argmin()
    law.check("cells", chance, at[i], cell=worst[i], angles=len(judged))
    law.check("integral", np.maximum(beyond, 0), at)
    broad = [view for view in case.views if 0 < view.density.max() < MAX_BROAD_DENSITY]
    if broad and not case.quick and not is_scalar():
        _in_small_cells(law, case, broad)
    if not law.holds:
        view, cells = judged[i]
        angle = float(np.degrees(np.arccos(view.at.wi[2])))
        law.plot = partial(plots.density, cells, cells.counts(view.codes) / view.count, angle)
    if len(judged) < len(case.views):
        law.notes.append(f"{UNRESOLVED} at {len(case.views) - len(judged)} angles, which are left out")


def _nudged(law: Outcome, case: BsdfCase) -> None:
    """Of three random numbers, two at least lead to another direction when they move a little."""
    drawn = case.drawn
    changes = np.zeros(len(drawn.u), int)
    for number in np.eye(3, dtype=np.float32):
        moved = drawn.u + number * np.where(drawn.u < 0.5, NUDGE, -NUDGE)
        wo = case.sample(drawn.having(u=moved)).wo
        changes += (wo != drawn.wo).any(axis=1)
    smooth = drawn.lit & ~drawn.delta & (drawn.pdf < MAX_BROAD_DENSITY) & drawn.wo.any(axis=1)
    if smooth.sum() >= MIN_QUANTILE_ERRORS:
        law.check("still", (changes < 2)[smooth], drawn[smooth])


def _in_small_cells(law: Outcome, case: BsdfCase, views: list[View]) -> None:
    cells = Cells.uniform(SMALL_CELL_LEVEL)
    counts = []
    for view in views:
        seen = cells.counts(encode(view.samples.wo[view.density > 0]))
        expected = cells.expected(case.density_at(view), len(view.density), case.rng)
        counts.append([seen, *expected])
    view = max(views, key=lambda v: v.at.wi[2])
    hold_small(law, cells, np.sum(counts, axis=0), G1_FIT_ERROR, view.at)


@larger_by
def in_stairs(u):
    """In every other step of the first random number."""
    return dr.floor(16 * u.x) - 2 * dr.floor(8 * u.x)


@finds("density", "density that a sample states too large", 3e-3, sample=of_sample(member("pdf", larger)))
@finds("weight", "weight of a sample too large", 3e-3, sample=of_weight(larger))
@finds("weight", "weight of a sample in stairs", 3e-3, sample=of_weight(in_stairs))
@finds(
    "discrete",
    "probability of a single direction too small",
    5e-3,
    nested={"type": "conductor"},
    sample=of_sample(member("pdf", smaller)),
)
@measures(
    density=most(f"density of a sample against pdf(), {BEYOND}", POINTWISE_TOL, AGAIN, SAMPLE),
    weight=most(f"weight of a sample against eval() / pdf(), {BEYOND}", POINTWISE_TOL, AGAIN, SAMPLE),
    discrete=most(
        f"probability of a single direction (delta) less its share, beyond {SIGMAS} standard errors",
        POINTWISE_TOL,
        "a count",
        WHOLE,
    ),
)
def weights(law: Outcome, case: BsdfCase) -> None:
    """The density and weight of a sample are ``pdf`` and ``eval`` / ``pdf`` of its direction.

    Of lobes of one direction, the density is the probability with which they are drawn.
    """
    drawn = case.drawn
    counts = live(drawn, *case.both(drawn)) | drawn.lit & ~drawn.delta
    few = len(drawn.pdf) // len(case.views)
    counts &= ~np.concatenate([narrow(view.samples[:few]) for view in case.views])

    def ratio(at: Lanes) -> Array:
        value, pdf = case.both(at)
        return value / np.where(pdf > 0, pdf, np.inf)[:, None]

    for name, stated, function in (("density", drawn.pdf, case.pdf), ("weight", drawn.weight, ratio)):
        error = excess(stated, function(drawn), case.spread(function, drawn))
        law.check(name, error, drawn, where=counts)
    errors = []
    angles = []
    for i, view in enumerate(case.views):
        s = view.samples
        kind = s.lobe * 4096 + s.flags
        for one in np.unique(kind[s.delta & s.lit]):  # of one direction
            here = s.delta & (kind == one)
            stated = float(np.nan_to_num(s.pdf[here].mean()))
            sigma = np.sqrt(max(stated * (1 - stated), 0) / len(here))
            errors.append(max(abs(here.mean() - stated) - SIGMAS * sigma, 0))
            angles.append(i)
    if errors:
        law.check("discrete", errors, case.incidence[angles])


def too_bright(size, value, *_):
    """A diffuse BSDF of albedo 0.5 that reflects more than arrives."""
    return 2 * (1 + size) * value


@finds("largest", "albedo above 1", 0.01, value=too_bright)
@finds("apart", "value of eval() too large", 0.02, eval=larger)
@measures(
    largest=most(
        f"largest albedo, less {SIGMAS} standard errors",
        1 + G1_FIT_ERROR,
        "no more light leaves than arrives; 0.5 % for fits of G1",
        WHOLE,
    ),
    apart=most(
        f"albedo by quadrature of eval() against mean weight, relative, beyond {SIGMAS} standard errors",
        2 * G1_FIT_ERROR,
        "0.5 % for fits of G1 in the density",
        WHOLE,
    ),
)
def energy(law: Outcome, case: BsdfCase) -> None:
    """The albedo ∫ f |cos θo| dωo is at most 1, and the same by samples and by quadrature.

    In the mode of importance, in which transmitted energy is not rescaled.
    """
    # that surely reached near the horizon, where lobes peak, by samples alone
    count = case.count(2**12, 2**14)
    mode = context(importance=True)
    phi = case.rng.uniform(0, 2 * np.pi, len(GRAZING))
    wi = probe.direction(np.cos(np.radians(GRAZING)), phi)
    uv = case.uniform(len(GRAZING), 2)
    grazing = Lanes(wi=wi, uv=uv)
    means = []
    for i in range(len(GRAZING)):
        s = case.sample(grazing[i].having(u=case.uniform(count, 3)), mode)
        means.append(_mean(s.weight))
    apart = []
    for view, cells in zip(case.views, case.cells, strict=True):
        s = case.sample(view.samples, mode)
        means.append(_mean(s.weight))
        # where values are NaN, the law ``finite`` says so
        apart.append(_apart(case, view, cells, s) if cells and view.holes < 0.01 else 0.0)
    surely = [(mean - SIGMAS * error).max() for mean, error in means]
    at = joined([grazing, case.incidence])
    law.check("largest", surely, at)
    if any(case.cells):
        law.check("apart", apart, case.incidence)
    if not law.holds:
        albedos, errors = np.max(means, axis=2).T
        law.plot = partial(plots.albedo, np.degrees(np.arccos(at.wi[:, 2])), albedos, errors)


def _mean(weight: Array) -> tuple[Array, Array]:
    """The mean of finite weights [N, channels], and its standard error."""
    weight = probe.finite_or_0(weight).astype(np.float64)
    return weight.mean(axis=0), weight.std(axis=0) / np.sqrt(len(weight))


def _apart(case: BsdfCase, view: View, cells: Cells, s: Lanes) -> float:
    """The relative difference, beyond chance, of albedos by samples and by quadrature."""
    smooth = np.where(s.delta[:, None], 0, probe.finite_or_0(s.weight))

    def value(wo: Array) -> Array:
        return case.eval(view.at.having(wo=wo), context(importance=True))

    integrals = integrate(value, cells, case.rng, encode(s.wo), len(smooth), smooth[:, 0])
    by_samples, error = _mean(smooth)
    by_quadrature = integrals.mean.sum(axis=0)
    sigma = np.sqrt(error**2 + integrals.variance.sum(axis=0))
    beyond = np.maximum(abs(by_samples - by_quadrature) - SIGMAS * sigma, 0)
    larger = np.maximum(by_samples, by_quadrature)
    return (beyond / np.maximum(larger, 1e-3)).max()
