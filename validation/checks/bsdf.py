"""``check_bsdf``: the laws that any BSDF must obey, stock or in Python, reflecting or transmitting.

A new law is a function of ``Law`` and ``Case`` and a row of ``LAWS``. Its docstring states it; ``figures``
are what it measures, each with its statistic, limit, reason, and the snippet that shows the worst case.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import stats

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.checks import bsdf_case, noise, probe
from mrt_mitsuba.validation.checks.bsdf_case import FIT, POINTWISE, Case, live, narrow, parameters
from mrt_mitsuba.validation.checks.bsdf_gradients import gradients
from mrt_mitsuba.validation.checks.law import SIGMAS, TIMEOUT, Check, Law, Skip, examine, figures, rare
from mrt_mitsuba.validation.checks.probe import BEYOND, Array, Lanes, Probe, context, excess, is_scalar
from mrt_mitsuba.validation.checks.sphere import DEPTH, Cells, chi_square, encode, integrate
from mrt_mitsuba.validation.tools.compare import sidak


def check_bsdf(
    bsdf: Any,
    *,
    quick: bool = False,
    seed: int = 0,
    only: Iterable[str] | None = None,
    timeout: float = TIMEOUT,
) -> Check:
    """Check the laws of a BSDF in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``quick``: fewer angles and samples. ``only``: names of ``LAWS``. ``timeout``: seconds after which a law
    fails that is not done. A loaded BSDF skips what has to load it again. Raises ``UsageError`` for anything
    else, and ``SceneError`` for a dict that Mitsuba cannot load.
    """
    return examine(Case, bsdf, LAWS, quick=quick, seed=seed, only=only, timeout=timeout)


# ---------------------------------------------- Samples --------------------------------------------------

UNRESOLVED = "neither float32 directions nor the samples resolve the lobe"
SMALL, BROAD = 7, 20.0  # level of cells of a degree; a density per steradian: lobes are then wide against one
GRAZING = (83, 86, 88, 89.5, 94, 92, 90.5)  # degrees
AGAIN = "the same formula, evaluated once more at a rounded direction"
DRAW = """ctx.mode = mi.TransportMode.Importance
n = 1_000_000
rng = mi.PCG32(n)
bs, weight = bsdf.sample(ctx, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
smooth = ~delta & (bsdf.pdf(ctx, si, bs.wo) > 0)
"""
CELL = f"""{DRAW}r0, r1, phi0, phi1, side = {{cell}}  # sqrt(1 - |cos|), azimuth from ... to; which hemisphere
r, phi = dr.sqrt((bs.wo.x**2 + bs.wo.y**2) / (1 + dr.abs(bs.wo.z))), dr.atan2(bs.wo.y, bs.wo.x)
inside = smooth & (r >= r0) & (r < r1) & (phi >= phi0) & (phi < phi1) & (bs.wo.z * side > 0)
r, phi = r0 + (r1 - r0) * rng.next_float32(), phi0 + (phi1 - phi0) * rng.next_float32()
sin = r * dr.sqrt(2 - r * r)
wo = mi.Vector3f(sin * dr.cos(phi), sin * dr.sin(phi), side * (1 - r * r))
density = dr.mean(bsdf.pdf(ctx, si, wo) * 2 * r)[0] * (r1 - r0) * (phi1 - phi0)
print("share of samples in the cell:", dr.count(inside)[0] / n, "pdf() says:", density)
"""
WHOLE = f"""{DRAW}wo = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
print("share of samples that pdf() stands for:", dr.count(smooth)[0] / n)
print("integral of pdf() by uniform directions:", dr.mean(bsdf.pdf(ctx, si, wo))[0] * 4 * dr.pi)
print("albedo by samples:", dr.mean(weight, axis=1))
print("without lobes of one direction:", dr.mean(dr.select(delta, 0, weight), axis=1))
print("these by uniform directions:", dr.mean(bsdf.eval(ctx, si, wo), axis=1) * 4 * dr.pi)
for i in range(bsdf.component_count()):
    here = delta & (bs.sampled_component == i)
    stated = dr.sum(dr.select(here, bs.pdf, 0))[0] / max(dr.count(here)[0], 1)
    print("component", i, "states a probability of", stated, "and its share is", dr.count(here)[0] / n)
"""
SAMPLE = """pdf = bsdf.pdf(ctx, si, bs.wo)
print("a sample of", bs, "weight", weight)
print("there, pdf():", pdf, "eval() / pdf():", bsdf.eval(ctx, si, bs.wo) / pdf)
"""


@figures(
    cells=rare("least chance of counts at {angles} angles if samples follow pdf(), for their number", CELL),
    integral=("most", f"integral of pdf() less the share of samples it stands for, beyond {SIGMAS} "
              "standard errors", FIT, "rational fits of Smith's G1 in use are off by 0.35 %", WHOLE),
    small=rare("chance of such counts of all angles in cells of a degree, for their number", CELL),
)  # fmt: skip
def sampling(law: Law, case: Case) -> None:
    """Samples against the density: ∫ pdf dω over a cell is the share of samples in it (Pearson's χ²).

    In whole cells of equal counts over both hemispheres; in a full check also in small ones, for faults
    in one place at any incidence.
    """
    case.need_smooth()
    judged = [(view, cells) for view, cells in zip(case.views, case.densities, strict=True) if cells]
    if not judged:
        raise Skip(f"{UNRESOLVED} at every angle")
    tests, worst = zip(*(chi_square(c, v.codes, v.count, 0.5 * FIT) for v, c in judged), strict=True)
    by_angle = np.array([*tests, np.sum(tests, axis=0)])  # and of all angles together
    chances = stats.chi2.sf(by_angle[..., 0], by_angle[..., 1])
    i, chance = int(chances[:-1].min(axis=1).argmin()), sidak(float(chances.min()), chances.size)
    wi, uv = (np.array([vars(view)[name] for view, _ in judged]) for name in ("wi", "uv"))
    law.hold("cells", chance, wi=wi[i], uv=uv[i], cell=worst[i], angles=len(judged))
    off = [np.sqrt(v.share * (1 - v.share) / v.count + c.variance.sum()) for v, c in judged]
    beyond = np.abs([v.share - c.mean.sum() for v, c in judged]) - SIGMAS * np.array(off)
    law.hold("integral", np.maximum(beyond, 0), wi=wi, uv=uv)
    views = [view for view in case.views if 0 < view.density.max() < BROAD]
    if views and not case.quick and not is_scalar():
        _in_small_cells(law, case, views)
    if len(judged) < len(case.views):
        law.notes.append(f"{UNRESOLVED} at {len(case.views) - len(judged)} angles, which are left out")


def _in_small_cells(law: Law, case: Case, views: list[SimpleNamespace]) -> None:
    cells = Cells.around(np.zeros(0, np.int64), 0, SMALL)
    wo, omega = cells.points(case.rng)
    seen, expected, variance = np.zeros((3, len(omega)))
    for view in views:
        codes = encode(view.samples.wo[view.density > 0]) // 4 ** (DEPTH - SMALL)
        seen += np.bincount(codes, minlength=len(omega))
        pdf = case.pdf(view.wi, wo.reshape(-1, 3), view.uv).reshape(omega.shape) * omega
        count = len(view.density) * omega.shape[1]
        expected, variance = expected + count * pdf.mean(axis=1), variance + count**2 * pdf.var(axis=1)
    known = 3 * np.sqrt(variance / (omega.shape[1] - 1)) + FIT * expected  # is no Poisson's
    many, few = stats.poisson.sf(seen - 1, expected + known), stats.poisson.cdf(seen, expected - known)
    p = np.where(np.isfinite(expected), np.minimum(many, np.where(expected > known, few, 1)), 1)
    view, cell = max(views, key=lambda v: v.wi[2]), cells.bounds(int(p.argmin()))
    law.hold("small", sidak(float(p.min()), 2 * len(p)), wi=view.wi, uv=view.uv, cell=cell)


@figures(
    density=("most", f"density of a sample against pdf(), {BEYOND}", POINTWISE, AGAIN, SAMPLE),
    weight=("most", f"weight of a sample against eval() / pdf(), {BEYOND}", POINTWISE, AGAIN, SAMPLE),
    discrete=("most", f"probability of a single direction (delta) less its share, beyond {SIGMAS} "
              "standard errors", POINTWISE, "a count", WHOLE),
)  # fmt: skip
def weights(law: Law, case: Case) -> None:
    """Density and weight of a sample are ``pdf`` and ``eval`` / ``pdf`` of its direction.

    Of lobes of one direction, the density is the probability with which they are drawn.
    """
    drawn, names = case.drawn
    at = names["wi"], np.where(np.isfinite(drawn.wo), drawn.wo, 1), names["uv"]
    counts = live(names["wi"], drawn, *case.both(*at)) | drawn.lit & ~drawn.delta
    few = slice(0, len(drawn.pdf) // len(case.views))
    counts &= ~np.concatenate([narrow(v.wi, v.samples.only(few)) for v in case.views])

    def ratio(i: Array, o: Array, t: Array) -> Array:
        value, pdf = case.both(i, o, t)
        return value / np.where(pdf > 0, pdf, np.inf)[:, None]

    for name, given, function in (("density", drawn.pdf, case.pdf), ("weight", drawn.weight, ratio)):
        error = excess(given, function(*at), case.spread(function, *at))
        law.hold(name, np.where(counts, error, 0), **names)
    off = []
    for i, s in enumerate(view.samples for view in case.views):
        lobe = s.component * 4096 + s.type
        for here in (s.delta & (lobe == one) for one in np.unique(lobe[s.delta & s.lit])):
            stated = float(np.nan_to_num(s.pdf[here].mean()))
            sigma = np.sqrt(max(stated * (1 - stated), 0) / len(here))
            off.append((max(abs(here.mean() - stated) - SIGMAS * sigma, 0), i))
    if off:
        error, of = np.transpose(off)
        law.hold("discrete", error, **{name: rows[of.astype(int)] for name, rows in case.incidence.items()})


@figures(
    largest=("most", f"largest albedo, less {SIGMAS} standard errors", 1 + FIT,
             "no more light leaves than arrives; 0.5 % for fits of G1", WHOLE),
    apart=("most", "albedo by quadrature of eval() against mean weight, relative, beyond "
           f"{SIGMAS} standard errors", 2 * FIT, "0.5 % for fits of G1 in the density", WHOLE),
)  # fmt: skip
def energy(law: Law, case: Case) -> None:
    """The albedo ∫ f |cos θo| dωo is at most 1, and the same by samples and by quadrature.

    In the mode of importance, in which transmitted energy is not rescaled.
    """
    # that surely reached near the horizon, where lobes peak, by samples alone
    count, mode = case.count(2**12, 2**14), context(importance=True)
    wi = probe.direction(np.cos(np.radians(GRAZING)), case.rng.uniform(0, 2 * np.pi, len(GRAZING)))
    at = {"wi": wi, "uv": case.uniform(len(GRAZING), 2)}
    drawn = (case.sample(i, case.uniform(count, 3), t, mode) for i, t in zip(*at.values(), strict=True))
    means, apart = [_mean(s.weight) for s in drawn], []
    for view, cells in zip(case.views, case.densities, strict=True):
        s = case.sample(view.wi, view.u, view.uv, mode)
        means.append(_mean(s.weight))
        # where values are NaN, the law ``finite`` says so
        apart.append(_apart(case, view, cells, s) if cells and view.holes < 0.01 else 0)
    surely = [(mean - SIGMAS * error).max() for mean, error in means]
    law.hold("largest", surely, **{n: np.concatenate([at[n], x]) for n, x in case.incidence.items()})
    if any(case.densities):
        law.hold("apart", apart, **case.incidence)


def _mean(weight: Array) -> tuple[Array, Array]:
    """Return the mean of finite weights [N, channels], and its standard error."""
    weight = np.nan_to_num(weight, posinf=0, neginf=0).astype(np.float64)
    return weight.mean(axis=0), weight.std(axis=0) / np.sqrt(len(weight))


def _apart(case: Case, view: SimpleNamespace, cells: Cells, s: Lanes) -> float:
    """Return how far the albedo of samples and the integral of eval() differ, beyond chance, relative."""
    smooth = np.where(s.delta[:, None], 0, np.nan_to_num(s.weight, posinf=0, neginf=0))
    mode, known = context(importance=True), (encode(s.wo), smooth[:, 0], len(smooth))
    found = integrate(lambda wo: case.eval(view.wi, wo, view.uv, mode), cells, case.rng, *known)
    (one, error), other = _mean(smooth), found.mean.sum(axis=0)
    beyond = np.abs(one - other) - SIGMAS * np.sqrt(error**2 + found.variance.sum(axis=0))
    return float((np.maximum(beyond, 0) / np.maximum(np.maximum(one, other), 1e-3)).max())


# ----------------------------------------------- Values --------------------------------------------------

VALUE = """print("eval():", bsdf.eval(ctx, si, wo), "pdf():", bsdf.pdf(ctx, si, wo))
print("eval_pdf():", bsdf.eval_pdf(ctx, si, wo))
print("a lane switched off:", bsdf.eval(ctx, si, wo, False))
print("the whole:", bsdf.eval(mi.BSDFContext(), si, wo), "flags:", hex(int(bsdf.flags())))
for ctx.component in range(bsdf.component_count()):
    flags = hex(int(bsdf.flags(ctx.component)))
    print("component", ctx.component, bsdf.eval(ctx, si, wo), "flags:", flags)
"""
TWO_WAYS = "two ways to the same number"


@figures(
    value=("most", f"value of eval_pdf() against that of eval(), {BEYOND}", 1e-4, TWO_WAYS, VALUE),
    density=("most", f"density of eval_pdf() against that of pdf(), {BEYOND}", 1e-4, TWO_WAYS, VALUE),
    inactive=("none", "values that are not 0 where active is False", 0,
              "a sum over lanes must not hold those that are switched off", VALUE),
)  # fmt: skip
def eval_pdf(law: Law, case: Case) -> None:
    """``eval_pdf`` is ``eval`` and ``pdf``; both ways to a value are 0 where ``active`` is False.

    Densities need not be: half of Mitsuba's plugins state one in any lane.
    """
    case.need_smooth()
    p, bsdf = case.pairs, case.plugin
    value, pdf = case.pair(p.wi, p.wo, p.uv)
    law.hold("value", excess(value, p.value, p.value_off), **vars(p))
    law.hold("density", excess(pdf, p.pdf, p.pdf_off), **vars(p))
    if not is_scalar():  # where Mitsuba takes ``active`` out of its plugins
        values = case.ask(
            lambda c, si, o: [bsdf.eval(c, si, o, o.z > 2), bsdf.eval_pdf(c, si, o, o.z > 2)[0]],  # no lane
            *(p.wi, p.wo, p.uv),
        )
        law.hold("inactive", np.any(values, axis=(0, 2)), **vars(p))


RECIPROCITY = """eta = {eta}  # index of refraction at wo over that at wi
forth = bsdf.eval(ctx, si, wo) / dr.abs(wo.z) * eta**2
importance = bsdf.eval(mi.BSDFContext(mi.TransportMode.Importance), si, wo) / dr.abs(wo.z)
si.wi, wo = wo, si.wi
back = bsdf.eval(ctx, si, wo) / dr.abs(wo.z)
print(forth, "should be", back, "and in the mode of importance", importance)
"""
THERE_AND_BACK = """# the way back should lead to where it came from, with the same product
for u in (({u}), ({back})):
    bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    print(si.wi, "->", bs.wo, "probability x weight x eta^2:", bs.pdf * weight * bs.eta**2)
    si.wi = bs.wo
"""
EITHER_WAY = "light can be followed either way; transmitted radiance scales by the squared index"


@figures(
    swapped=("most", f"f(wi, wo) against f(wo, wi), {BEYOND}", POINTWISE, EITHER_WAY, RECIPROCITY),
    modes=("most", f"f in the mode of radiance against that of importance, {BEYOND}", POINTWISE, EITHER_WAY,
           RECIPROCITY),
    medium=("most", "index of refraction of reflected samples, less 1", probe.ROUNDED, "one medium", SAMPLE),
    returns=("at least", "share of single directions (delta) that the way back returns to", 0.05,
             "light can be followed either way; of several directions, the way back may draw another",
             THERE_AND_BACK),
    single=("most", f"probability x weight x eta^2 of a single direction (delta) against the way "
            f"back, {BEYOND}", POINTWISE, EITHER_WAY, THERE_AND_BACK),
    single_modes=("most", "weight of a single direction (delta) x eta^2 against the mode of "
                  "importance, relative", POINTWISE, EITHER_WAY, THERE_AND_BACK),
)  # fmt: skip
def reciprocity(law: Law, case: Case) -> None:
    """f(ωi, ωo) η_o² = f(ωo, ωi) η_i², with the indices of the media that the directions are in.

    E. Veach, Robust Monte Carlo Methods for Light Transport Simulation, 1997, § 5.2.
    """
    few = case.pairs.only(np.abs(case.pairs.wi[:, 2] * case.pairs.wo[:, 2]) > 1e-3)

    def forth(i: Array, o: Array, t: Array, eta: Array) -> Array:
        return case.eval(i, o, t) / np.abs(o[:, 2:]) * eta[:, None] ** 2

    others = {
        "swapped": lambda i, o, t, _: case.eval(o, i, t) / np.abs(i[:, 2:]),
        "modes": lambda i, o, t, _: case.eval(i, o, t, context(importance=True)) / np.abs(o[:, 2:]),
    }
    at = few.wi, few.wo, few.uv, few.eta
    one, allowed = forth(*at), case.spread(forth, *at)
    for name, other in others.items():
        law.hold(name, excess(one, other(*at), allowed + case.spread(other, *at)), **vars(few))
    _delta_either_way(law, case)
    # light that is reflected stays in its medium: integrators multiply by ``eta`` as they go
    s, names = case.drawn
    reflected = ((s.type & int(mi.BSDFFlags.Reflection)) != 0) & s.lit
    if reflected.any():
        law.hold("medium", np.where(reflected, np.nan_to_num(np.abs(s.eta - 1), nan=np.inf), 0), **names)


def _delta_either_way(law: Law, case: Case) -> None:
    """Lobes of one direction: probability × weight × η² of a sample, and of the one that goes back."""
    count = case.count(2**13, 2**15)
    wi, uv = case.units(count), case.uniform(count, 2)
    u, v = case.uniform(count, 3), case.uniform(count, 3)
    there = case.sample(wi, u, uv)
    wo = probe.unit(np.where(np.isfinite(there.wo), there.wo, 1))
    back = case.sample(wo, v, uv)
    same = there.delta & (there.type == back.type) & (there.component == back.component)
    same &= np.abs(wi[:, 2] * wo[:, 2]) > 1e-3
    returned = (np.abs(probe.unit(back.wo) - wi) < 1e-3).all(axis=1)
    if same.sum() < 20:
        return
    names, lost = {"wi": wi, "uv": uv, "u": u, "back": v}, int((same & ~returned).argmax())
    law.hold("returns", returned[same].mean(), **{name: row[lost] for name, row in names.items()})

    def followed(i: Array, _: Array, t: Array, u: Array) -> Array:
        s = case.sample(i, u, t)
        return s.weight * (s.pdf * s.eta.astype(np.float64) ** 2)[:, None]

    ways = (wi, wo, uv, u), (wo, wi, uv, v)
    # next to total reflection, a rounding of the direction is a percent of what is transmitted
    allowed = case.spread(followed, *ways[0]) + case.spread(followed, *ways[1])
    error = excess(followed(*ways[0]), followed(*ways[1]), allowed)
    law.hold("single", np.where(same & returned, error, 0), **names)
    other = case.sample(wi, u, uv, context(importance=True))  # by the same random numbers
    alike = there.delta & (np.abs(other.wo - there.wo) < 1e-3).all(axis=1)
    error = excess(there.weight * there.eta[:, None] ** 2, other.weight)
    law.hold("single_modes", np.where(alike, error, 0), **names)


# A dot product of float32 vectors is rarely less than 1e-7
COSINES = (1, 1 - 6e-8, 0.5, 1e-2, 1e-4, 1e-7, 0)
INDICES = ("eta", "k", "int_ior", "ext_ior")
UNIFORM = (0, 2.0**-24, 0.5, 1 - 2.0**-24)
WRONG, SPOILS = "results not finite, or negative{where}: {faults}", "one such number spoils a picture"


@figures(
    values=("none", WRONG, 0, SPOILS, VALUE),
    samples=("none", WRONG, 0, SPOILS, SAMPLE),
)  # fmt: skip
def finite(law: Law, case: Case) -> None:
    """No NaN, no infinity, nothing negative: extreme directions, random numbers and parameters."""
    cosines = np.array([s * c for c in COSINES for s in (1, -1)])
    pool = probe.direction(
        np.repeat(cosines, 6), np.tile([0, np.pi / 2, np.pi, -np.pi / 2, 0.7, 4], len(cosines))
    )
    rng, count = case.rng, case.count(2**14, 2**17)
    wi, any_ = pool[rng.integers(len(pool), size=(2, count))]
    wo = np.choose(
        rng.integers(4, size=count)[:, None], [any_, wi * np.array([-1, -1, 1], np.float32), -wi, wi]
    )
    u = np.where(rng.random((count, 3)) < 0.6, rng.choice(UNIFORM, (count, 3)), case.uniform(count, 3))
    uv = np.where(rng.random((count, 2)) < 0.3, rng.integers(0, 2, (count, 2)), rng.random((count, 2)))
    extremes = wi, wo, u.astype(np.float32), uv.astype(np.float32)
    sound = _finite(law, case, extremes)
    for key, value in parameters(case) if sound else ():  # the ends of its likely range, one at a time
        number, name = float(np.mean(np.array(value))), key.removesuffix(".value").removesuffix(".values")
        ends = (0.0, 1.0) if 0 <= number <= 1 else (1.001, 2 * number)
        if name.split(".")[-1] in INDICES and (number <= 1 or key.endswith(".values")):
            ends = 0.5 * number, 2.0 * number  # of metals: 0 makes no sense there
        for end in ends:
            copy = case.copy()
            with bsdf_case.changed(copy, key, lambda old, end=end: type(old)(old * 0 + end)):
                _finite(law, copy, extremes, (key, end))


def _finite(law: Law, case: Case, extremes: tuple, setting: tuple | None = None) -> bool:
    """Hold the faults of values, or those of samples where values have none; return whether all is sound."""
    wi, wo, u, uv = extremes
    (value, pdf), together, s = case.both(wi, wo, uv), case.pair(wi, wo, uv), case.sample(wi, u, uv)
    length = np.linalg.norm(s.wo.astype(np.float64), axis=1)

    def bad(values: Array) -> Array:
        return ~(np.isfinite(values) & (values >= 0)).reshape(len(values), -1).all(axis=1)

    values = {"eval()": bad(value), "pdf()": bad(pdf), "eval_pdf()": bad(together[0]) | bad(together[1])}
    samples = {
        "weights of samples": bad(s.weight),
        "densities of samples": s.lit & bad(s.pdf),  # where the weight is 0, nothing more is read
        "directions of samples": s.lit & ~(np.abs(length - 1) < 1e-3),
    }
    name, kinds = ("values", values) if np.any([*values.values()]) else ("samples", samples)
    words = ", ".join(f"{kind} {faults.sum()}" for kind, faults in kinds.items() if faults.any())
    if words or not setting:
        where = f" with {setting[0]} = {setting[1]:g}" if setting else ""
        at = {"wi": wi, "uv": uv, "wo": wo, "u": u, "setting": setting, "where": where}
        law.hold(name, np.any([*kinds.values()], axis=0), faults=words or "none", **at)
    return not words


NOISE = """for k in range(9):  # float32 steps in all components: a smooth function would change evenly
    x = (np.array([{wo}], np.float32).view(np.int32) + {stride} * k).view(np.float32)
    print(np.ravel(bsdf.{function}(ctx, si, mi.Vector3f(*map(float, x)))))
"""


@figures(lost=(0.9, "noise of {function}() over that of 8 roundings with rounded directions, 9 in 10",
               noise.LOST, "sound formulas stay below 1.6; beyond, digits are lost", NOISE))  # fmt: skip
def roundoff(law: Law, case: Case) -> None:
    """Noise of float32 evaluation beyond what the rounding of the directions explains (``noise``)."""
    case.need_smooth()
    p = case.pairs
    steep = (np.abs(p.wi[:, 2]) > 0.1) & (np.abs(p.wo[:, 2]) > 0.1)
    # far off a lobe, an exponent of 40 makes 40 roundings of one: of nothing
    lit = p.only(steep & (p.pdf > 1e-3) & (p.value.max(axis=1) > 1e-20))
    few = lit.only(slice(0, case.count(500, 2000)))
    if len(few.pdf) < 20:
        raise Skip("too few pairs of directions with a value")

    inputs = np.concatenate([few.wi, few.wo], axis=1)
    for name, function in (("eval", lambda *at: case.eval(*at).max(axis=1)), ("pdf", case.pdf)):

        def at(x: Array, function: Any = function) -> Array:
            return function(x[:, :3], x[:, 3:], np.tile(few.uv, (len(x) // len(few.uv), 1)))

        found = noise.measure(
            at,
            inputs,
            seed=case.seed,
            project=lambda x: probe.unit(x.reshape(-1, 2, 3).astype(np.float64)).reshape(-1, 6),
        )
        if np.isnan(found.noise).mean() > 0.25:
            raise Skip("values change too fast for float32 steps to tell noise")
        law.hold("lost", found.lost, function=name, stride=found.stride, **vars(few))


# --------------------------------------------- Components ------------------------------------------------

UPDATED = """params = mi.traverse(bsdf)
print("components before:", bsdf.component_count())
for key in {keys}:
    params[key] = 0.9 * params[key]
params.update()
print("and after params.update():", bsdf.component_count())
"""
FLAGS = "print([hex(int(bsdf.flags(i))) for i in range(bsdf.component_count())], hex(int(bsdf.flags())))\n"
SIDES = "reflection stays on its side, transmission crosses, lobes of one direction have no value"


@figures(
    flags=("at most", "flags of the whole that no component has, or the other way around", 0,
           "flags() is the union of flags(i)", FLAGS),
    updated=("at most", "components more or fewer after params.update()", 0,
             "an update says nothing about lobes", UPDATED),
    sum=("most", "sum of the components against the whole, relative", 1e-4, "a sum", VALUE),
    values=("none", "results of eval() that contradict the flags of component {component}", 0, SIDES, VALUE),
    samples=("none", "results of sample() that contradict the flags of component {component}", 0, SIDES,
             FLAGS + SAMPLE),
    dark=("at most", "sides that a component's flags name, and from which it is black", 0,
          "a flag without a lobe", FLAGS),
)  # fmt: skip
def components(law: Law, case: Case) -> None:
    """Flags of components say what they do; f = Σ fᵢ; ``ctx.component`` selects."""
    bsdf, p = case.plugin, case.pairs
    flags = [int(bsdf.flags(i)) for i in range(bsdf.component_count())]
    law.hold("flags", bin(np.bitwise_or.reduce(flags or [0]) ^ int(bsdf.flags())).count("1"))
    if case.description is not None:
        copy, old = case.load(), dict(parameters(case))
        mi.traverse(copy).update({key: type(value)(value) for key, value in old.items()})
        law.hold("updated", abs(copy.component_count() - len(flags)), keys=list(old))
    parts, dark = [case.eval(p.wi, p.wo, p.uv, context(i)) for i in range(len(flags))], 0
    law.hold("sum", excess(np.sum(parts, axis=0), p.value, p.value_off), **vars(p))
    for i, (flag, value) in enumerate(zip(flags, parts, strict=True)):
        lit = (value != 0).any(axis=1)
        bad = lit & np.isfinite(value).all(axis=1) & ~_allowed(flag & ~int(mi.BSDFFlags.Delta), p.wi, p.wo)
        law.hold("values", bad, component=i, **vars(p))
        # samples of one component that go by another name, kind or side
        count = case.count(2**12, 2**14)
        wi, u, uv = case.units(count), case.uniform(count, 3), case.uniform(count, 2)
        s = case.sample(wi, u, uv, context(i))
        drawn = s.lit & np.isfinite(s.weight).all(axis=1)
        bad = (s.component != i) | ((s.type & ~flag) != 0) | (s.type == 0)
        bad |= (np.abs(s.wo[:, 2]) > 1e-6) & ~_allowed(flag, wi, s.wo)
        law.hold("samples", drawn & bad, component=i, wi=wi, uv=uv, u=u)
        # sides that flags name and where there is no light, of a component that has some
        z = np.concatenate([p.wi[lit, 2], wi[drawn, 2]])
        sides = (mi.BSDFFlags.FrontSide, (z > 0).any()), (mi.BSDFFlags.BackSide, (z < 0).any())
        dark += sum(bool(flag & int(side)) and len(z) > 0 and not seen for side, seen in sides)
    law.hold("dark", dark)


def _allowed(flags: int, wi: Array, wo: Array) -> Array:
    """Return where flags allow light."""
    f = mi.BSDFFlags
    kinds = f.Reflection, f.Transmission, f.FrontSide, f.BackSide
    same, other, front, back = (bool(flags & int(kind)) for kind in kinds)
    return np.where(wi[:, 2] * wo[:, 2] > 0, same, other) & np.where(wi[:, 2] > 0, front, back)


# ---------------------------------------------- Variants -------------------------------------------------


@figures(same=("most", "value and density in {other} against {here}, relative, beyond rounding", POINTWISE,
               "the same formula", VALUE))  # fmt: skip
def variants(law: Law, case: Case) -> None:
    """Values in the scalar variant, and in the spectral one where colours are grey."""
    here = mi.variant()
    case.with_()
    few = case.pairs.only(np.isfinite(case.pairs.value).all(axis=1)).only(slice(0, case.count(200, 800)))
    grey = np.ptp(few.value, axis=1).max() <= 1e-5 * few.value.max()
    others = [case.other_kind]
    if here.endswith("_rgb") and grey:
        others.append(here.replace("_rgb", "_spectral"))
    for other in others:
        try:
            value, pdf = case.elsewhere(other, lambda: Probe(case.load()).both(few.wi, few.wo, few.uv))
        except Skip as reason:
            law.notes.append(str(reason))
            continue
        expected, allowed = few.value, few.value_off
        if not other.endswith("_rgb"):  # the mean of equal channels, however many there are
            value, expected, allowed = value.mean(axis=1), expected.mean(axis=1), allowed.max(axis=1)
        error = np.maximum(excess(value, expected, allowed), excess(pdf, few.pdf, few.pdf_off))
        law.hold("same", error, variants=(here, other), other=other, here=here, **vars(few))


@figures(same=("most", "values of the BSDF {which} after a switch to {other} and back, relative, beyond "
               "rounding", 1e-4, "the same formula with the same numbers", VALUE))  # fmt: skip
def switch(law: Law, case: Case) -> None:
    """Values after a switch to another variant and back, of the BSDF as it was and loaded anew."""
    here, few = mi.variant(), case.pairs.only(slice(0, case.count(1000, 1000)))
    other = next(v for v in ("scalar_rgb", *runtime.usable_variants()) if v != here)
    mi.set_variant(other)
    mi.set_variant(here)
    candidates = {"that was loaded before": case.plugin}
    if case.description is not None:
        candidates["loaded anew"] = case.load()
    for which, bsdf in candidates.items():
        value, pdf = Probe(bsdf).both(few.wi, few.wo, few.uv)
        error = np.maximum(excess(value, few.value, few.value_off), excess(pdf, few.pdf, few.pdf_off))
        law.hold("same", error, which=which, other=other, variants=(here, other, here), **vars(few))


LAWS = {law.__name__: law for law in (sampling, weights, eval_pdf, energy, reciprocity, finite, roundoff,
                                      gradients, components, variants, switch)}  # fmt: skip
