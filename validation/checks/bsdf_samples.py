"""Laws of a BSDF's samples: their density, their weights, and the energy that they carry."""

from __future__ import annotations

import numpy as np

from mrt_mitsuba.validation.checks import snippets
from mrt_mitsuba.validation.checks.bsdf_case import BEYOND, FIT, POINTWISE, Case, View, excess, live, narrow
from mrt_mitsuba.validation.checks.law import LEVEL, SIGMAS, Law, Skip
from mrt_mitsuba.validation.checks.probe import Array, context, direction
from mrt_mitsuba.validation.checks.sphere import Cells, Integrals, chi_square, encode, integrate
from mrt_mitsuba.validation.tools.image_tests import sidak

UNRESOLVED = "neither float32 directions nor the samples resolve the lobe"
GRAZING = (83, 86, 88, 89.5, 94, 92, 90.5)  # degrees


def sampling(law: Law, case: Case) -> None:
    """Samples against the density in whole cells of equal counts, over both hemispheres."""
    case.need_smooth()
    tests = [(view, *_counted(view, found)) for view, found in case.densities if found]
    blurred = len(case.views) - len(tests)
    if not tests:
        raise Skip(f"{UNRESOLVED} at every angle")
    view, p, cell, _ = min(tests, key=lambda test: test[1])
    law.at_least(
        f"chance of such counts if samples follow pdf(), the least of {len(tests)} angles, for their number",
        sidak(p, len(tests)),
        LEVEL,
        "a false alarm in a million checks",
        case.snippet(snippets.SAMPLING, wi=view.wi, uv=view.uv, cell=cell),
    )
    view, _, _, share = max(tests, key=lambda test: test[3])
    what = f"integral of pdf() less the share of samples it stands for, beyond {SIGMAS} standard errors"
    why = "rational fits of Smith's G1 in common use are off by 0.35 %"
    law.at_most(what, share, FIT, why, case.snippet(snippets.NORMALISED, wi=view.wi, uv=view.uv))
    if blurred:
        law.notes.append(f"{UNRESOLVED} at {blurred} angles, which are left out")


def _counted(view: View, found: Integrals) -> tuple[float, tuple, float]:
    """Return p of the counts, the cell that is most off, and how far the integral is from the share."""
    codes, share = view.judged
    count = len(view.density) - view.pilot
    off = np.sqrt(share * (1 - share) / count + found.variance.sum())
    beyond = max(abs(share - found.mean.sum()) - SIGMAS * off, 0)
    return (*chi_square(found, codes, count), beyond)


def weights(law: Law, case: Case) -> None:
    """Density and weight of a sample against what ``pdf`` and ``eval`` say of its direction."""
    worst: dict[str, tuple[float, View, int]] = {}
    for view in case.views:
        for what, error in _mismatch(case, view).items():
            i = int(error.argmax())
            worst[what] = max(
                worst.get(what, (-1.0, view, 0)), (float(error[i]), view, i), key=lambda w: w[0]
            )
    for what, (most, view, i) in worst.items():
        title = f"{what}, {BEYOND}"
        why = "the same formula, evaluated once more at a rounded direction"
        law.at_most(
            title, most, POINTWISE, why, case.snippet(snippets.WEIGHT, wi=view.wi, uv=view.uv, u=view.u[i])
        )
    _discrete(law, case)
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


def _discrete(law: Law, case: Case) -> None:
    """Lobes that are one direction: the probability that a sample states against how often it is drawn."""
    worst, where = -1.0, None
    for view in case.views:
        s = view.samples
        for kind in np.unique(s.component[s.delta] * 4096 + s.type[s.delta]):
            here = s.delta & (s.component * 4096 + s.type == kind)
            stated = float(np.nan_to_num(s.pdf[here].mean()))
            if not (s.weight[here] != 0).any():
                continue
            error = np.sqrt(max(stated * (1 - stated), 0) / len(here))
            off = max(abs(here.mean() - stated) - SIGMAS * error, 0)
            worst, where = max((worst, where), (off, view), key=lambda pair: pair[0])
    if where is not None:
        what = f"probability of a single direction (delta) less its share, beyond {SIGMAS} standard errors"
        why = "a count"
        law.at_most(what, worst, POINTWISE, why, case.snippet(snippets.DISCRETE, wi=where.wi, uv=where.uv))


def energy(law: Law, case: Case) -> None:
    """Albedo by sampling and by quadrature, in the mode in which transmitted energy is not rescaled."""
    brightest, apart = _grazing(case), []
    for view, density in case.densities:
        albedo, off = _albedo(case, view, density.cells if density else None)
        brightest.append((albedo, view.wi, view.uv))
        if off is not None:
            apart.append((off, view))
    albedo, wi, uv = max(brightest, key=lambda found: found[0])
    show = case.snippet(snippets.ALBEDO, wi=wi, uv=uv)
    what = f"largest albedo, less {SIGMAS} standard errors"
    law.at_most(what, albedo, 1 + FIT, "no more light leaves than arrives; 0.5 % for fits of G1", show)
    if apart:
        error, view = max(apart, key=lambda found: found[0])
        what = (
            f"albedo by quadrature of eval() against mean weight, relative, beyond {SIGMAS} standard errors"
        )
        why = "0.5 % for fits of G1 in the density"
        law.at_most(what, error, 2 * FIT, why, case.snippet(snippets.ALBEDO, wi=view.wi, uv=view.uv))


def _grazing(case: Case) -> list[tuple[float, Array, Array]]:
    """Return albedos that are surely reached, by samples alone, near the horizon, where lobes peak."""
    count = case.count(2**12, 2**14)
    cos = np.cos(np.radians(GRAZING))
    wi = direction(cos, case.rng.uniform(0, 2 * np.pi, len(cos)))
    uv = case.rng.random((len(cos), 2), np.float32)
    wis, uvs = (np.repeat(x, count, axis=0) for x in (wi, uv))
    drawn = case.probe.sample(wis, case.uniform(len(wis)), uvs, context(importance=True)).weight
    weight = np.nan_to_num(drawn, posinf=0, neginf=0).astype(np.float64).reshape(len(cos), count, -1)
    least = (weight.mean(axis=1) - SIGMAS * weight.std(axis=1) / np.sqrt(count)).max(axis=1)
    return [(float(x), i, t) for x, i, t in zip(least, wi, uv, strict=True)]


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
