"""Laws of the samples of a BSDF: their density, weights and energy."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from . import plots, probe
from .bsdf_case import POINTWISE_TOL, BsdfCase, live, narrow
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
    SIGMAS,
    Outcome,
    difference,
    finds,
    measures,
    most,
    number_of,
    p_value,
    share_of,
    sidak,
)
from .probe import BEYOND, Array, Function, Lanes, context, excess, is_scalar, unit
from .sphere import (
    MAX_LEVEL,
    SMALL_CELL_LEVEL,
    Cells,
    chi_square,
    compared,
    encode,
    hold_small,
    integrate,
)

NUDGED = """for moved in np.eye(3) * 2.0**-18 * np.where(np.array(u) < 0.5, 1, -1):
    a, b, c = map(float, np.array(u) + moved)
    print("random numbers moved by", moved, "direction:", bsdf.sample(ctx, si, a, mi.Point2f(b, c))[0].wo)
"""
G1_FIT_ERROR = 5e-3  # rational fits of Smith's G₁ are off by up to 0.35 %, and densities with them
UNRESOLVED = "neither float32 directions nor the samples resolve the lobe"
MAX_BROAD_DENSITY = 20.0  # a density per steradian: lobes are then wide against a degree
NUDGE = 2.0**-18  # of a random number: a hundred roundings of the direction
GRAZING = (83, 86, 88, 89.5, 94, 92, 90.5)  # degrees: near the horizon, where lobes peak
AGAIN = "the same formula, evaluated once more at a rounded direction"


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
@finds("cells", "density too large everywhere", 0.01, pdf=larger)
@measures(
    cells=p_value(
        "smallest p-value of a chi-square test at {angles} angles, corrected for their number", CELL
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
    wi, wo = unit(rng.normal(size=(2, count, 3)))
    anywhere = Lanes(wi=wi, wo=wo, uv=rng.random((count, 2), np.float32))
    law.check("dark", probe.without_density(*case.both(anywhere)), anywhere)
    if is_scalar():
        law.notes.append("too few samples to compare with densities: check it in a vectorised variant")
        return
    judged = []  # indices of views
    tests = []  # [angles, 6, 2]
    worst = []
    shown = []
    for i, view in enumerate(case.views):
        first = len(view.wo) // 4  # are pilots, which make the cells
        count = len(view.wo) - first
        codes = encode(view.wo[first:][view.density[first:] > 0])
        cells = _cells(case, view, view.wo[:first][view.density[:first] > 0])
        if cells is None:
            continue
        cells = integrate(_density_at(case, view), cells, case.rng, codes, count)
        test, cell = chi_square(cells, codes, count, 0.5 * G1_FIT_ERROR)
        judged.append(i)
        tests.append(test)
        worst.append(cell)
        shown.append((cells, cells.counts(codes) / count))
    if not judged:
        law.notes.append(f"{UNRESOLVED} at every angle")
        return
    at = case.incidence[judged]
    by_angle = np.array([*tests, np.sum(tests, axis=0)])  # and of all angles together
    chances = stats.chi2.sf(by_angle[..., 0], by_angle[..., 1])
    chance = sidak(chances.min(), chances.size)
    i = chances[:-1].min(axis=1).argmin()
    law.check("cells", chance, at[i], cell=worst[i], angles=len(judged))
    broad = [view for view in case.views if 0 < view.density.max() < MAX_BROAD_DENSITY]
    if broad and not case.quick:
        _in_small_cells(law, case, broad)
    if not law.holds:
        angle = float(np.degrees(np.arccos(at.wi[i, 2])))
        cells, seen = shown[i]
        law.plot = partial(plots.density, cells, seen, angle)
    if len(judged) < len(case.views):
        law.notes.append(f"{UNRESOLVED} at {len(case.views) - len(judged)} angles, which are left out")


def _cells(case: BsdfCase, view: Lanes, pilot: Array) -> Cells | None:
    """Cells that hold few of the sampled directions ``pilot`` [P, 3] each; None where none are so small."""
    # around the mirror direction at all scales, where lobes may be that are not sampled
    scales = 10 ** case.rng.uniform(-4, 0, (600, 1))
    mirrored = view.wi[0] * [-1, -1, 1] + scales * case.rng.normal(size=(600, 3))
    seeds = encode(np.concatenate([pilot, unit(mirrored)]))
    most = max(len(view.wo) // 4000, 8)
    cells = Cells.around(seeds, most)
    crowd = cells.counts(encode(pilot))
    crowded = (crowd * ((cells.level == MAX_LEVEL) & (crowd > 4 * most))).sum()
    # at the normal, all azimuths of the finest cells are one place
    centre = (np.hypot(*pilot.T[:2]) < np.sqrt(2) * 0.5**MAX_LEVEL).sum()
    if max(crowded, centre) > 0.01 * len(pilot):  # samples are closer together than the finest cells
        return None
    return cells


def _density_at(case: BsdfCase, view: Lanes) -> Function:
    """The density of directions [M, 3] in a view, as a function; 0 where it is not finite."""

    def density(wo: Array) -> Array:
        pdf = case.pdf(Lanes(wi=view.wi[0], uv=view.uv[0], wo=wo))
        return np.maximum(probe.finite_or_0(pdf), 0)

    return density


def _nudged(law: Outcome, case: BsdfCase) -> None:
    """Of three random numbers, two at least lead to another direction when they move a little."""
    drawn = case.drawn
    changes = np.zeros(len(drawn.u), int)
    for number in np.eye(3, dtype=np.float32):
        moved = drawn.u + number * np.where(drawn.u < 0.5, NUDGE, -NUDGE)
        wo = case.sample(drawn.having(u=moved)).wo
        changes += (wo != drawn.wo).any(axis=1)
    smooth = drawn.lit & ~drawn.delta & (drawn.pdf < MAX_BROAD_DENSITY) & drawn.wo.any(axis=1)
    if smooth.mean() > 0.1:  # else few are broad enough, at the foot of a lobe
        law.check("still", (changes < 2)[smooth], drawn[smooth])


def _in_small_cells(law: Outcome, case: BsdfCase, views: list[Lanes]) -> None:
    cells = Cells.uniform(SMALL_CELL_LEVEL)
    counts = []
    for view in views:
        codes = encode(view.wo[view.density > 0])
        counts.append(compared(cells, _density_at(case, view), codes, len(view.density), case.rng))
    hold_small(law, cells, np.sum(counts, axis=0), G1_FIT_ERROR, views[0][0])


@finds("density", "density that a sample states too large", 3e-3, sample=of_sample(member("pdf", larger)))
@finds("weight", "weight of a sample too large", 3e-3, sample=of_weight(larger))
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
    counts &= ~np.concatenate([narrow(view[:few]) for view in case.views])

    def ratio(at: Lanes) -> Array:
        value, pdf = case.both(at)
        return value / np.where(pdf > 0, pdf, np.inf)[:, None]

    for name, stated, function in (("density", drawn.pdf, case.pdf), ("weight", drawn.weight, ratio)):
        error = excess(stated, function(drawn), case.spread(function, drawn))
        law.check(name, error, drawn, where=counts)
    errors = []
    angles = []
    for i, s in enumerate(case.views):
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
        f"albedo by eval() / pdf() of samples against mean weight, relative, beyond {SIGMAS} standard errors",
        2 * G1_FIT_ERROR,
        "0.5 % for fits of G1 in the density",
        WHOLE,
    ),
)
def energy(law: Outcome, case: BsdfCase) -> None:
    """The albedo ∫ f |cos θo| dωo is at most 1, and the same by weights and by values of samples.

    In the mode of importance, in which transmitted energy is not rescaled.
    """
    mode = context(importance=True)
    count = case.count(2**15, 2**18)
    angles = np.array([*GRAZING, *case.angles])
    wi = probe.direction(np.cos(np.radians(angles)), case.rng.uniform(0, 2 * np.pi, len(angles)))
    at = Lanes(wi=wi, uv=case.uniform(len(angles), 2))
    means = []
    apart = []
    for i in range(len(angles)):
        s = case.sample(at[i].having(u=case.uniform(count, 3)), mode)
        weight = probe.finite_or_0(s.weight).astype(np.float64)
        means.append([weight.mean(axis=0), weight.std(axis=0) / np.sqrt(count)])
        value, pdf = case.both(s, mode)
        known = s.lit & ~s.delta & (pdf > 0) & np.isfinite(value).all(axis=1)
        ratio = value.sum(axis=1) / np.where(known, pdf, 1)
        apart.append(difference(np.where(known, ratio, 0), np.where(known, weight.sum(axis=1), 0)))
    surely = [(mean - SIGMAS * error).max() for mean, error in means]
    law.check("largest", surely, at)
    law.check("apart", apart, at)
    if not law.holds:
        albedos, errors = np.max(means, axis=2).T
        law.plot = partial(plots.albedo, angles, albedos, errors)
