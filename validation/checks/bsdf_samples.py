"""Laws of a BSDF's samples: their density, their weights, and the energy that they carry."""

from __future__ import annotations

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from mrt_mitsuba.validation.checks.bsdf_case import BEYOND, FIT, POINTWISE, Case, View, excess, live, narrow
from mrt_mitsuba.validation.checks.law import LEVEL, SIGMAS, Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, context, direction, is_scalar, unit
from mrt_mitsuba.validation.checks.sphere import POINTS, SIDE, Cells, chi_square, encode, integrate
from mrt_mitsuba.validation.tools.image_tests import sidak

UNRESOLVED = "neither float32 directions nor the samples resolve the lobe"
GRAZING = (83, 86, 88, 89.5, 94, 92, 90.5)  # degrees

SAMPLING = """point draw
r0, r1, phi0, phi1, side = {cell}  # a cell: sqrt(1 - |cos|) and azimuth from ... to, and which hemisphere
r, phi = dr.sqrt((bs.wo.x**2 + bs.wo.y**2) / (1 + dr.abs(bs.wo.z))), dr.atan2(bs.wo.y, bs.wo.x)
inside = (r >= r0) & (r < r1) & (phi >= phi0) & (phi < phi1) & (bs.wo.z * side > 0)
inside &= (bsdf.pdf(ctx, si, bs.wo) > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
r, phi = r0 + (r1 - r0) * rng.next_float32(), phi0 + (phi1 - phi0) * rng.next_float32()
sin = r * dr.sqrt(2 - r * r)
wo = mi.Vector3f(sin * dr.cos(phi), sin * dr.sin(phi), side * (1 - r * r))
density = dr.mean(bsdf.pdf(ctx, si, wo) * 2 * r)[0] * (r1 - r0) * (phi1 - phi0)
print("share of samples in the cell:", dr.count(inside)[0] / n, "pdf() says:", density)
"""
CAP = """point draw
centre = mi.Vector3f({centre})
inside = (dr.norm(bs.wo - centre) < {radius}) & (bsdf.pdf(ctx, si, bs.wo) > 0)
inside &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
cap = mi.warp.square_to_uniform_cone(mi.Point2f(rng.next_float32(), rng.next_float32()), 1 - {radius}**2 / 2)
density = dr.mean(bsdf.pdf(ctx, si, mi.Frame3f(centre).to_world(cap)))[0] * dr.pi * {radius}**2
print("share of samples in the cap:", dr.count(inside)[0] / n, "pdf() says:", density)
"""
NORMALISED = """point draw
smooth = (bsdf.pdf(ctx, si, bs.wo) > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
print("share of samples that pdf() stands for:", dr.count(smooth)[0] / n)
wo = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
print("integral of pdf() by uniform directions:", dr.mean(bsdf.pdf(ctx, si, wo))[0] * 4 * dr.pi)
"""


def sampling(law: Law, case: Case) -> None:
    """Samples against the density in whole cells of equal counts, over both hemispheres."""
    case.need_smooth()
    tests, sums, worst = [], np.zeros((6, 2)), (-1.0, case.views[0])
    for view, found in case.densities:
        if found is None:
            continue
        codes, share = view.judged
        count = len(view.density) - view.pilot
        by_width, cell = chi_square(found, codes, count, 0.5 * FIT)
        sums += by_width
        tests += [(float(stats.chi2.sf(*test)), view, cell) for test in by_width]
        off = np.sqrt(share * (1 - share) / count + found.variance.sum())
        beyond = max(abs(share - found.mean.sum()) - SIGMAS * off, 0)
        worst = max(worst, (beyond, view), key=lambda pair: pair[0])
    if not tests:
        raise Skip(f"{UNRESOLVED} at every angle")
    p, view, cell = min(tests, key=lambda test: test[0])
    p = min(p, *stats.chi2.sf(*sums.T))  # of all angles together
    judged = len(tests) // len(sums)
    what = f"chance of such counts if samples follow pdf(), the least of {judged} angles, for their number"
    show = case.snippet(SAMPLING, wi=view.wi, uv=view.uv, cell=cell)
    law.at_least(what, sidak(p, len(tests) + len(sums)), LEVEL, "a false alarm in a million checks", show)
    beyond, view = worst
    what = f"integral of pdf() less the share of samples it stands for, beyond {SIGMAS} standard errors"
    show = case.snippet(NORMALISED, wi=view.wi, uv=view.uv)
    law.at_most(what, beyond, FIT, "rational fits of Smith's G1 in common use are off by 0.35 %", show)
    if not case.quick and not is_scalar():
        _caps(law, case)
    if judged < len(case.views):
        law.notes.append(f"{UNRESOLVED} at {len(case.views) - judged} angles, which are left out")


CAPS, RADIUS = 2**15, 0.0175  # so many cover the sphere; a degree
BROAD = 20.0  # a density per steradian: lobes are then wide against a cap


def _caps(law: Law, case: Case) -> None:
    """Samples of all angles with broad lobes in small caps, for faults in one place at any incidence."""
    views = [view for view in case.views if 0 < view.density.max() < BROAD]
    if not views:
        return
    z = 1 - (2 * np.arange(CAPS) + 1) / CAPS  # Fibonacci's lattice
    centre = direction(z, np.pi * (3 - np.sqrt(5)) * np.arange(CAPS))
    clear = np.abs(z) > RADIUS  # of the horizon, over which values jump
    i, j = np.divmod(np.arange(POINTS), SIDE)
    radius = RADIUS * np.sqrt((i + case.rng.random((CAPS, POINTS))) / SIDE)
    turn = 2 * np.pi * (j + case.rng.random((CAPS, POINTS))) / SIDE
    sin, cos = (f(turn)[..., None] for f in (np.sin, np.cos))
    across = unit(np.cross(centre, case.units(CAPS)))[:, None]
    wo = centre[:, None] + radius[..., None] * (cos * across + sin * np.cross(centre[:, None], across))
    wo = unit(wo).reshape(-1, 3)
    seen, expected, variance = np.zeros(CAPS), np.zeros(CAPS), np.zeros(CAPS)
    for view in views:
        drawn = view.samples.wo[view.density > 0]
        seen += cKDTree(drawn).query_ball_point(centre, RADIUS, return_length=True)
        wis, uvs = view.around(len(wo))
        pdf = case.probe.pdf(wis, wo, uvs).reshape(CAPS, POINTS) * np.pi * RADIUS**2 * len(view.density)
        expected, variance = expected + pdf.mean(axis=1), variance + pdf.var(axis=1) / (POINTS - 1)
    known = 3 * np.sqrt(variance) + FIT * expected  # errors of integrals are no Poisson's
    many, few = stats.poisson.sf(seen - 1, expected + known), stats.poisson.cdf(seen, expected - known)
    p = np.where(clear & np.isfinite(expected), np.minimum(many, np.where(expected > known, few, 1)), 1)
    k = int(p.argmin())
    view = max(views, key=lambda v: v.wi[2])
    show = case.snippet(CAP, wi=view.wi, uv=view.uv, centre=centre[k], radius=RADIUS)
    what = f"chance of such counts in caps of {np.degrees(RADIUS):.1f} degrees, the least, for their number"
    law.at_least(what, sidak(float(p[k]), 2 * CAPS), LEVEL, "a false alarm in a million checks", show)


WEIGHT = """point sample
pdf = bsdf.pdf(ctx, si, bs.wo)
print("a sample of density", bs.pdf, "weight", weight, "and index of refraction", bs.eta)
print("there, pdf():", pdf, "eval() / pdf():", bsdf.eval(ctx, si, bs.wo) / pdf)
"""
DISCRETE = """point draw
component, stated = np.array(bs.sampled_component), np.array(bs.pdf)
delta = np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
for i in np.unique(component[delta]):
    here = delta & (component == i)
    print("component", i, "states a probability of", stated[here].mean(), "and its share is", here.mean())
"""


def weights(law: Law, case: Case) -> None:
    """Density and weight of a sample against what ``pdf`` and ``eval`` say of its direction."""
    worst: dict[str, tuple[float, View, int]] = {}
    for view in case.views:
        for what, error in _mismatch(case, view).items():
            i = int(error.argmax())
            new = (float(error[i]), view, i)
            worst[what] = max(worst.get(what, (-1.0, view, 0)), new, key=lambda w: w[0])
    for what, (most, view, i) in worst.items():
        show = case.snippet(WEIGHT, wi=view.wi, uv=view.uv, u=view.u[i])
        why = "the same formula, evaluated once more at a rounded direction"
        law.at_most(f"{what}, {BEYOND}", most, POINTWISE, why, show)
    # lobes that are one direction: the probability that a sample states against how often it is drawn
    off = []
    for view in case.views:
        s = view.samples
        for kind in np.unique(s.component[s.delta] * 4096 + s.type[s.delta]):
            here = s.delta & (s.component * 4096 + s.type == kind)
            stated = float(np.nan_to_num(s.pdf[here].mean()))
            if (s.weight[here] != 0).any():
                error = np.sqrt(max(stated * (1 - stated), 0) / len(here))
                off.append((max(abs(here.mean() - stated) - SIGMAS * error, 0), view))
    if off:
        most, view = max(off, key=lambda pair: pair[0])
        what = f"probability of a single direction (delta) less its share, beyond {SIGMAS} standard errors"
        law.at_most(what, most, POINTWISE, "a count", case.snippet(DISCRETE, wi=view.wi, uv=view.uv))
    if not law.parts:
        raise Skip("no direction of incidence has samples")


def _mismatch(case: Case, view: View) -> dict[str, Array]:
    """Return the errors of the first samples of a view, by what was compared."""
    few = view.samples.only(slice(0, case.count(2**12, 2**13)))
    if few.delta.all():
        return {}
    wis, uvs = view.around(len(few.pdf))
    wo = np.where(np.isfinite(few.wo), few.wo, 1)

    def ratio(i: Array, o: Array, t: Array) -> Array:
        value, pdf = case.probe.both(i, o, t)
        return value / np.where(pdf > 0, pdf, np.inf)[:, None]

    counts = live(view.wi, few, *case.probe.both(wis, wo, uvs)) | (few.weight != 0).any(axis=1) & ~few.delta
    counts &= ~narrow(view.wi, few)
    return {
        what: np.where(counts, excess(stated, function(wis, wo, uvs), case.spread(function, wis, wo, uvs)), 0)
        for what, stated, function in (
            ("density of a sample against pdf()", few.pdf, case.probe.pdf),
            ("weight of a sample against eval() / pdf()", few.weight, ratio),
        )
    }


ALBEDO = """point importance draw
print("albedo by samples:", dr.mean(weight, axis=1))
smooth = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), 0, weight)
print("without lobes of one direction:", dr.mean(smooth, axis=1))
wo = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
print("these by uniform directions:", dr.mean(bsdf.eval(ctx, si, wo), axis=1) * 4 * dr.pi)
"""


def energy(law: Law, case: Case) -> None:
    """Albedo by sampling and by quadrature, in the mode in which transmitted energy is not rescaled."""
    # that surely reached near the horizon, where lobes peak, by samples alone
    count, cos = case.count(2**12, 2**14), np.cos(np.radians(GRAZING))
    wi = direction(cos, case.rng.uniform(0, 2 * np.pi, len(cos)))
    uv = case.rng.random((len(cos), 2), np.float32)
    wis, uvs = (np.repeat(x, count, axis=0) for x in (wi, uv))
    drawn = case.probe.sample(wis, case.uniform(len(wis)), uvs, context(importance=True)).weight
    weight = np.nan_to_num(drawn, posinf=0, neginf=0).astype(np.float64).reshape(len(cos), count, -1)
    least = (weight.mean(axis=1) - SIGMAS * weight.std(axis=1) / np.sqrt(count)).max(axis=1)
    brightest, apart = list(zip(least, wi, uv, strict=True)), []
    for view, density in case.densities:
        albedo, off = _albedo(case, view, density.cells if density else None)
        brightest.append((albedo, view.wi, view.uv))
        if off is not None:
            apart.append((off, view))
    albedo, at_wi, at_uv = max(brightest, key=lambda found: found[0])
    show = case.snippet(ALBEDO, wi=at_wi, uv=at_uv)
    what = f"largest albedo, less {SIGMAS} standard errors"
    law.at_most(what, albedo, 1 + FIT, "no more light leaves than arrives; 0.5 % for fits of G1", show)
    if apart:
        error, view = max(apart, key=lambda found: found[0])
        what = (
            f"albedo by quadrature of eval() against mean weight, relative, beyond {SIGMAS} standard errors"
        )
        show = case.snippet(ALBEDO, wi=view.wi, uv=view.uv)
        law.at_most(what, error, 2 * FIT, "0.5 % for fits of G1 in the density", show)


def _albedo(case: Case, view: View, cells: Cells | None) -> tuple[float, float | None]:
    """Return an albedo that is surely reached, and by how much sampling and quadrature differ, if known."""
    importance = context(importance=True)
    count = len(view.density)
    wis, uvs = view.around(count)
    drawn = view.samples
    if (drawn.wo[:, 2] * view.wi[2] < 0).any():
        drawn = case.probe.sample(wis, case.uniform(count), uvs, importance)
    weight = np.nan_to_num(drawn.weight, posinf=0, neginf=0).astype(np.float64)
    mean, error = weight.mean(axis=0), weight.std(axis=0) / np.sqrt(count)
    least = float((mean - SIGMAS * error).max())
    if cells is None:
        return least, None
    holes: list[float] = []

    def value(wo: Array) -> Array:
        i, t = view.around(len(wo))
        values = case.probe.eval(i, wo, t, importance)
        holes.append(float(np.mean(~np.isfinite(values))))
        return values

    smooth = np.where(drawn.delta[:, None], 0, weight)
    found = integrate(value, cells, case.rng, encode(drawn.wo), smooth[:, 0], count)
    by_samples, error = smooth.mean(axis=0), smooth.std(axis=0) / np.sqrt(count)
    by_cells, other = found.mean.sum(axis=0), np.sqrt(found.variance.sum(axis=0))
    least = max(least, float((by_cells + mean - by_samples - SIGMAS * (error + other)).max()))
    both = np.maximum(np.maximum(by_samples, by_cells), 1e-3)
    off = np.maximum(np.abs(by_samples - by_cells) - SIGMAS * np.hypot(error, other), 0) / both
    return least, float(off.max()) if max(holes) < 0.01 else None  # else the law ``finite`` says why
