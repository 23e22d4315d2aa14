"""``check_bsdf``: the laws that any BSDF must obey, stock or in Python, reflecting or transmitting."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.validation.checks import noise, snippets
from mrt_mitsuba.validation.checks.law import Check, Law, Skip, class_name, examine
from mrt_mitsuba.validation.checks.probe import (
    SCALAR_SHARE,
    Array,
    Probe,
    Samples,
    context,
    direction,
    interaction,
    is_scalar,
    unit,
)
from mrt_mitsuba.validation.checks.recipe import Recipe
from mrt_mitsuba.validation.checks.sphere import DEPTH, Cells, Integrals, encode, integrate

ANGLES = (0, 20, 45, 60, 75, 85, 89, 110, 150)  # of incidence, in degrees; beyond 90 from below
QUICK_ANGLES = (0, 50, 80, 140)
LEVEL = 1e-6  # chance of a false alarm in each statistical test, after Šidák's correction
SIGMAS = 6  # the same for a normal distribution: 2e-9
FIT = 5e-3  # the rational fits of Smith's G₁ in use are off by up to 0.35 %, and the densities with them
POINTWISE = 2e-3  # relative, beyond what rounding explains
GRADIENT = 2e-2
ROUNDED = 2.0**-23  # how far a direction is off that a computation returns in float32


def check_bsdf(bsdf: Any, *, quick: bool = False, seed: int = 0, only: Iterable[str] | None = None) -> Check:
    """Check the laws of a BSDF in the current variant: a dict for ``mi.load_dict``, or a loaded one.

    ``quick``: fewer angles and samples. ``only``: names of ``LAWS``. A loaded BSDF skips what has to load it
    again. Raises ``UsageError`` for what is no BSDF, and whatever Mitsuba raises for a dict it cannot load.
    """
    import mitsuba as mi

    runtime.use()
    recipe = Recipe.of(bsdf)
    loaded = bsdf if recipe.description is None else recipe.load()
    if not isinstance(loaded, mi.BSDF):
        raise UsageError(
            f"{type(loaded).__name__} is no BSDF of {mi.variant()}: give a dict or a loaded BSDF"
        )
    case = Case(loaded, recipe, quick, seed)
    name = recipe.description["type"] if recipe.description else class_name(loaded)
    with np.errstate(all="ignore"):  # what is not finite is the law ``finite``'s business
        return examine(name, case, LAWS, only=only, quick=quick)


@dataclass(frozen=True)
class View:
    """A direction of incidence at a texture coordinate, and samples drawn for it."""

    wi: Array  # float32 [3]
    uv: Array  # float32 [2]
    u: Array  # the random numbers of the samples [N, 3]
    samples: Samples
    density: Array  # pdf() at the samples of lobes with a width that are none refused, 0 elsewhere [N]

    def around(self, count: int) -> tuple[Array, Array]:
        """Return ``wi`` and ``uv`` for so many lanes."""
        return np.broadcast_to(self.wi, (count, 3)), np.broadcast_to(self.uv, (count, 2))


@dataclass
class Case:
    """A BSDF under examination, and what several laws need to know of it."""

    bsdf: Any
    recipe: Recipe
    quick: bool
    seed: int

    def __post_init__(self) -> None:
        self.probe = Probe(self.bsdf)
        self.rng = np.random.default_rng(self.seed)

    def count(self, quick: int, full: int) -> int:
        """Return how many lanes to use."""
        number = quick if self.quick else full
        return max(int(number * SCALAR_SHARE), 64) if is_scalar() else number

    def uniform(self, count: int) -> Array:
        return self.rng.random((count, 3), np.float32)

    @cached_property
    def views(self) -> list[View]:
        """Samples at every angle of incidence, at random azimuths and texture coordinates."""
        count = self.count(2**16, 2**18)
        found = []
        for angle in QUICK_ANGLES if self.quick else ANGLES:
            wi = direction(np.cos(np.radians(angle)), self.rng.uniform(0, 2 * np.pi))
            uv, u = self.rng.random(2, np.float32), self.uniform(count)
            wis, uvs = (np.broadcast_to(x, (count, len(x))) for x in (wi, uv))
            samples = self.probe.sample(wis, u, uvs)
            value, pdf = self.probe.both(wis, samples.wo, uvs)
            found.append(View(wi, uv, u, samples, np.where(_live(samples, value, pdf), pdf, 0)))
        return found

    def copy(self) -> Case:
        """Return a case whose parameters can be changed, with a BSDF of its own if it can be loaded."""
        loaded = self.bsdf if self.recipe.description is None else self.recipe.load()
        made = Case(loaded, self.recipe, self.quick, self.seed)
        made.pairs = self.pairs
        return made

    @cached_property
    def smooth(self) -> bool:
        """Whether there is a lobe with a width."""
        return any((view.density > 0).any() for view in self.views) or bool(self.pairs.value.any())

    def need_smooth(self) -> None:
        if not self.smooth:
            raise Skip("all lobes are single directions (delta): eval and pdf are 0")

    @cached_property
    def pairs(self) -> Pairs:
        """Directions of incidence over the sphere with one exitant each: some sampled, some at random."""
        count = self.count(2**13, 2**15)
        cos, phi = self.rng.uniform(-1, 1, count), self.rng.uniform(0, 2 * np.pi, count)
        wi, uv = direction(cos, phi), self.rng.random((count, 2), np.float32)
        samples = self.probe.sample(wi, self.uniform(count), uv)
        usable = np.isfinite(samples.wo).all(axis=1) & ~samples.delta & (samples.weight != 0).any(axis=1)
        usable &= self.rng.random(count) < 0.75
        other = direction(self.rng.uniform(-1, 1, count), self.rng.uniform(0, 2 * np.pi, count))
        wo = unit(np.where(usable[:, None], samples.wo, other))
        value, pdf = self.probe.both(wi, wo, uv)
        across = usable & (wi[:, 2] * wo[:, 2] < 0)
        eta = np.ones(count)
        for side in (wi[:, 2] > 0, wi[:, 2] < 0):
            known = across & side & np.isfinite(samples.eta)
            eta[side & (wi[:, 2] * wo[:, 2] < 0)] = np.median(samples.eta[known]) if known.any() else 1
        return Pairs(wi, wo, uv, value, pdf, np.where(across, samples.eta, eta))

    def spread(self, quantity: Any, wi: Array, wo: Array, uv: Array, *others: Array) -> Array:
        """Return the largest change of ``quantity(wi, wo, uv, …)`` as directions move by a rounding."""
        base = quantity(wi, wo, uv, *others)
        largest = np.zeros_like(base)
        for _ in range(6):
            i, o = (v + ROUNDED * self.rng.normal(size=v.shape).astype(np.float32) for v in (wi, wo))
            change = np.abs(quantity(i, o, uv, *others) - base)
            largest = np.maximum(largest, np.where(np.isnan(change), np.inf, change))
        return largest

    def snippet(self, body: str, **names: Any) -> str:
        return snippets.bsdf(self.bsdf, self.recipe.description, body, names)


@dataclass(frozen=True)
class Pairs:
    """N pairs of directions, and what ``eval`` and ``pdf`` give."""

    wi: Array
    wo: Array
    uv: Array
    value: Array  # [N, channels]
    pdf: Array
    eta: Array  # index of refraction at wo over that at wi

    def only(self, keep: Array | slice) -> Pairs:
        return Pairs(*(x[keep] for x in vars(self).values()))


def _live(s: Samples, value: Array, pdf: Array) -> Array:
    """Where samples of lobes with a width are ones that the density counts.

    Weight 0 is how ``sample`` refuses: its direction is then any. It may also be that the value there is 0,
    or that the weight is wrong; but then the stated density is that of the direction.
    """
    refused = (s.weight == 0).all(axis=1) & (value != 0).any(axis=1) & ~np.isclose(s.pdf, pdf, rtol=0.2)
    return ~s.delta & np.isfinite(pdf) & (pdf > 0) & ~refused


def excess(one: Array, other: Array, allowed: Array) -> Array:
    """Return [N]: how far two arrays [N, …] differ beyond ``8 * allowed``, relative to the larger one.

    Of several channels, the brightest counts as the size. What is not finite is left to the law ``finite``.
    """
    one, other, allowed = (np.reshape(x, (len(one), -1)).astype(np.float64) for x in (one, other, allowed))
    size = np.maximum(np.abs(one), np.abs(other)).max(axis=1, keepdims=True)
    beyond = np.maximum(np.abs(one - other) - 8 * allowed, 0) / np.where(size > 1e-30, size, np.inf)
    return np.where(np.isfinite(beyond), beyond, 0).max(axis=1)


# ----------------------------------------------- Sampling -------------------------------------------------


def sampling(law: Law, case: Case) -> None:
    """Samples against the density in whole cells of equal counts, over both hemispheres."""
    from scipy import stats

    from mrt_mitsuba.validation.tools.image_tests import sidak

    case.need_smooth()
    tests: list[tuple[float, tuple, View]] = []
    shares: list[tuple[float, View]] = []
    blurred = 0
    for view, cells in _cells(case):
        if cells is None:
            blurred += 1
            continue
        count = len(view.density) - len(view.density) // 4
        live = view.density[-count:] > 0

        def pdf(wo: Array, view: View = view) -> Array:
            wis, uvs = view.around(len(wo))
            return np.maximum(case.probe.pdf(wis, wo, uvs), 0)[:, None]

        codes = encode(view.samples.wo[-count:][live])
        hint = np.bincount(cells.find(codes), minlength=len(cells.start))
        found = integrate(pdf, cells, case.rng, counts=hint, samples=count)
        tests.append((*_chi_square(found, codes, count, stats), view))
        share, off = live.mean(), np.sqrt(live.var() / count + found.variance.sum())
        shares.append((max(abs(share - found.mean.sum()) - SIGMAS * off, 0), view))
    if not tests:
        raise Skip("the lobe is narrower than float32 directions can tell apart")
    p, cell, view = min(tests, key=lambda test: test[0])
    n = len(tests)
    law.at_least(
        f"chance of such counts if samples follow pdf(), the least of {n} angles, for their number",
        sidak(p, n),
        LEVEL,
        "a false alarm in a million checks",
        case.snippet(snippets.SAMPLING, wi=view.wi, uv=view.uv, cell=cell),
    )
    share, view = max(shares, key=lambda test: test[0])
    law.at_most(
        f"integral of pdf() less the share of samples it stands for, beyond {SIGMAS} standard errors",
        share,
        FIT,
        "rational fits of Smith's G1 in common use are off by 0.35 %",
        case.snippet(snippets.NORMALISED, wi=view.wi, uv=view.uv),
    )
    if blurred:
        law.notes.append(
            f"{blurred} angles left out: the lobe is narrower than float32 directions can tell apart"
        )


def _cells(case: Case) -> Iterator[tuple[View, Cells | None]]:
    """Yield cells for each view, made from a quarter of its samples; None where a lobe is too narrow."""
    for view in case.views:
        pilot = view.samples.wo[: len(view.density) // 4][view.density[: len(view.density) // 4] > 0]
        seeds = encode(np.concatenate([pilot, _mirrored(view.wi, case.rng)]))
        most = max(len(view.density) // 4 // 1000, 8)
        cells = Cells.around(seeds, most)
        held = (
            np.bincount(cells.find(encode(pilot)), minlength=len(cells.start)) if len(pilot) else np.zeros(1)
        )
        narrow = held[cells.level == DEPTH] if len(pilot) else held
        yield view, (None if narrow[narrow > 4 * most].sum() > 0.01 * len(pilot) else cells)


def _mirrored(wi: Array, rng: np.random.Generator, count: int = 600) -> Array:
    """Directions around the mirror direction at all scales, where lobes are that nothing may have sampled."""
    spread = 10 ** rng.uniform(-4, 0, (count, 1)) * rng.normal(size=(count, 3))
    return unit(wi * [-1, -1, 1] + spread)


def _chi_square(found: Integrals, codes: Array, count: int, stats: Any) -> tuple[float, tuple]:
    """Return p of the counts, in groups of cells that expect 25 or more, and the cell that is most off."""
    seen = np.bincount(found.cells.find(codes), minlength=len(found.cells.start))
    expected, variance = count * found.mean[:, 0], count**2 * found.variance[:, 0]
    group = np.floor(np.cumsum(expected) / 25).astype(int)
    group = np.minimum(group, max(group[-1] - 1, 0))
    seen_in, expected_in, variance_in = (np.bincount(group, x) for x in (seen, expected, variance))
    used = (seen_in > 0) | (expected_in > 1e-6)
    pull = (seen_in - expected_in)[used] ** 2 / np.maximum(expected_in + variance_in, 1e-6)[used]
    cell = int(np.argmax(np.abs(seen - expected) / np.sqrt(expected + variance + 1)))
    return float(stats.chi2.sf(pull.sum(), len(pull))), found.cells.bounds(cell)


# ----------------------------------------------- Weights --------------------------------------------------


def weights(law: Law, case: Case) -> None:
    """Density and weight of a sample against what ``pdf`` and ``eval`` say of its direction."""
    worst: dict[str, tuple[float, View, int]] = {}
    for view in case.views:
        few = view.samples.only(slice(0, case.count(2**12, 2**13)))
        wis, uvs = view.around(len(few.pdf))
        wo = np.where(np.isfinite(few.wo), few.wo, 1)

        def ratio(i: Array, o: Array, t: Array) -> Array:
            value, pdf = case.probe.both(i, o, t)
            return value / np.where(pdf > 0, pdf, np.inf)[:, None]

        counts = _live(few, *case.probe.both(wis, wo, uvs)) | (few.weight != 0).any(axis=1) & ~few.delta
        for what, stated, function in (
            ("density of a sample against pdf()", few.pdf, case.probe.pdf),
            ("weight of a sample against eval() / pdf()", few.weight, ratio),
        ):
            found = function(wis, wo, uvs)
            error = np.where(counts, excess(stated, found, case.spread(function, wis, wo, uvs)), 0)
            i = int(error.argmax())
            worst[what] = max(
                worst.get(what, (-1.0, view, 0)), (float(error[i]), view, i), key=lambda w: w[0]
            )
    if not case.smooth:
        worst.clear()
    for what, (most, view, i) in worst.items():
        law.at_most(
            f"{what}, relative, beyond 8 times what the rounding of directions explains",
            most,
            POINTWISE,
            "the same formula, evaluated once more at a rounded direction",
            case.snippet(snippets.WEIGHT, wi=view.wi, uv=view.uv, u=view.u[i]),
        )
    _discrete(law, case)
    if not law.parts:
        raise Skip("no direction of incidence has samples")


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
        law.at_most(
            f"probability of a single direction (delta) less its share, beyond {SIGMAS} standard errors",
            worst,
            POINTWISE,
            "a count",
            case.snippet(snippets.DISCRETE, wi=where.wi, uv=where.uv),
        )


def eval_pdf(law: Law, case: Case) -> None:
    """``eval_pdf`` against ``eval`` and ``pdf``."""
    case.need_smooth()
    p = case.pairs
    value, pdf = case.probe.pair(p.wi, p.wo, p.uv)
    for what, one, other, single in (
        ("value", value, p.value, case.probe.eval),
        ("density", pdf, p.pdf, case.probe.pdf),
    ):
        error = excess(one, other, case.spread(single, p.wi, p.wo, p.uv))
        i = int(error.argmax())
        law.at_most(
            f"{what} of eval_pdf() against that of the single function, relative, beyond rounding",
            error[i],
            1e-4,
            "two ways to the same number",
            case.snippet(snippets.PAIR, wi=p.wi[i], uv=p.uv[i], wo=p.wo[i]),
        )


# ------------------------------------------ Energy and reciprocity ----------------------------------------


def energy(law: Law, case: Case) -> None:
    """Albedo by sampling and by quadrature, in the mode in which transmitted energy is not rescaled."""
    importance = context(importance=True)
    brightest, apart = [], []
    for view, cells in _cells(case):
        count = len(view.density)
        wis, uvs = view.around(count)
        drawn = view.samples
        if (drawn.wo[:, 2] * view.wi[2] < 0).any():
            drawn = case.probe.sample(wis, case.uniform(count), uvs, importance)
        weight = np.nan_to_num(drawn.weight, posinf=0, neginf=0).astype(np.float64)
        mean, error = weight.mean(axis=0), weight.std(axis=0) / np.sqrt(count)
        brightest.append(((mean - SIGMAS * error).max(), view))
        if cells is None:
            continue

        holes: list[float] = []

        def value(wo: Array, view: View = view, holes: list[float] = holes) -> Array:
            i, t = view.around(len(wo))
            values = case.probe.eval(i, wo, t, importance)
            holes.append(float(np.mean(~np.isfinite(values))))
            return values

        hint = np.zeros(len(cells.start))
        found = integrate(value, cells, case.rng, counts=hint, samples=count)
        smooth = np.where(drawn.delta[:, None], 0, weight)
        by_samples, error = smooth.mean(axis=0), smooth.std(axis=0) / np.sqrt(count)
        by_cells, other = found.mean.sum(axis=0), np.sqrt(found.variance.sum(axis=0))
        brightest.append(((by_cells + mean - by_samples - SIGMAS * (error + other)).max(), view))
        both = np.maximum(np.maximum(by_samples, by_cells), 1e-3)
        off = np.maximum(np.abs(by_samples - by_cells) - SIGMAS * np.hypot(error, other), 0) / both
        if max(holes) < 0.01:  # else there is no integral: the law ``finite`` says so
            apart.append((off.max(), view))
    albedo, view = max(brightest, key=lambda found: found[0])
    law.at_most(
        f"largest albedo, less {SIGMAS} standard errors",
        albedo,
        1 + FIT,
        "no more light leaves than arrives; 0.5 % for fits of G1",
        case.snippet(snippets.ALBEDO, wi=view.wi, uv=view.uv),
    )
    if apart:
        error, view = max(apart, key=lambda found: found[0])
        law.at_most(
            f"albedo by quadrature of eval() against mean weight, relative, beyond {SIGMAS} standard errors",
            error,
            2 * FIT,
            "0.5 % for fits of G1 in the density",
            case.snippet(snippets.ALBEDO, wi=view.wi, uv=view.uv),
        )


def reciprocity(law: Law, case: Case) -> None:
    """f(ωi, ωo) η_o² = f(ωo, ωi) η_i², with the indices of the media that the directions are in."""
    case.need_smooth()
    pairs = case.pairs
    few = pairs.only(np.abs(pairs.wi[:, 2] * pairs.wo[:, 2]) > 1e-3)

    def forth(i: Array, o: Array, t: Array, eta: Array) -> Array:
        return case.probe.eval(i, o, t) / np.abs(o[:, 2:]) * eta[:, None] ** 2

    def back(i: Array, o: Array, t: Array, eta: Array) -> Array:
        return case.probe.eval(o, i, t) / np.abs(i[:, 2:])

    arguments = few.wi, few.wo, few.uv, few.eta
    allowed = case.spread(forth, *arguments) + case.spread(back, *arguments)
    error = excess(forth(*arguments), back(*arguments), allowed)
    i = int(error.argmax())
    snippet = case.snippet(snippets.RECIPROCITY, wi=few.wi[i], uv=few.uv[i], wo=few.wo[i], eta=few.eta[i])
    law.at_most(
        "f(wi, wo) against f(wo, wi), relative, beyond 8 times what the rounding of directions explains",
        error[i],
        POINTWISE,
        "light can be followed either way; transmitted radiance scales by the squared index",
        snippet,
    )


# ------------------------------------------------ Finite --------------------------------------------------

COSINES = (
    1,
    1 - 6e-8,
    0.5,
    1e-2,
    1e-4,
    1e-7,
    0,
)  # less than 1e-7, a dot product of float32 vectors rarely is
UNIFORM = (0, 2.0**-24, 0.5, 1 - 2.0**-24)


def finite(law: Law, case: Case) -> None:
    """No NaN, no infinity, nothing negative: extreme directions, random numbers and parameters."""
    extremes = _extremes(case)
    known = _finite(law, case, extremes, np.zeros((6, len(extremes[0])), bool))
    copy = case.copy()
    for key, value, setting in _ends(copy):
        with setting:
            _finite(law, copy, extremes, known, (key, value))
    law.parts = [part for part in law.parts if not part.holds] or law.parts[:1]


def _extremes(case: Case) -> tuple[Array, Array, Array, Array]:
    cosines = np.array([s * c for c in COSINES for s in (1, -1)])
    pool = direction(np.repeat(cosines, 6), np.tile([0, np.pi / 2, np.pi, -np.pi / 2, 0.7, 4], len(cosines)))
    count = case.count(2**14, 2**17)
    wi = pool[case.rng.integers(len(pool), size=count)]
    mirrored, kind = wi * np.array([-1, -1, 1], np.float32), case.rng.integers(4, size=count)[:, None]
    wo = np.where(kind == 0, pool[case.rng.integers(len(pool), size=count)], wi)
    wo = np.where(kind == 1, mirrored, np.where(kind == 2, -wi, wo))
    u = np.where(case.rng.random((count, 3)) < 0.6, case.rng.choice(UNIFORM, (count, 3)), case.uniform(count))
    uv = np.where(
        case.rng.random((count, 2)) < 0.3, case.rng.integers(0, 2, (count, 2)), case.rng.random((count, 2))
    )
    return wi, wo, u.astype(np.float32), uv.astype(np.float32)


def _finite(law: Law, case: Case, extremes: tuple, known: Array, setting: tuple | None = None) -> Array:
    """Count faults that are not known yet; return where they are, by kind. [6, N]"""
    wi, wo, u, uv = extremes
    value, pdf = case.probe.both(wi, wo, uv)
    together = case.probe.pair(wi, wo, uv)
    s = case.probe.sample(wi, u, uv)
    lit = (s.weight != 0).any(axis=1)  # of one without, nothing else is read
    length = np.linalg.norm(s.wo.astype(np.float64), axis=1)
    kinds = (
        "eval()",
        "pdf()",
        "eval_pdf()",
        "weights of samples",
        "densities of samples",
        "directions of samples",
    )
    faults = np.array([
        _bad(value),
        _bad(pdf),
        _bad(together[0]) | _bad(together[1]),
        _bad(s.weight),
        lit & _bad(s.pdf),
        lit & ~(np.abs(length - 1) < 1e-3),
    ])  # fmt: skip
    new = faults & ~known
    kind, i = np.unravel_index(int(new.argmax()), new.shape)
    where = f" with {setting[0]} = {setting[1]:g}" if setting else ""
    named = [f"{name} {count}" for name, count in zip(kinds, new.sum(axis=1), strict=True) if count]
    law.at_most(
        f"results not finite, or negative{where}: {', '.join(named) or 'none'}",
        new.sum(),
        0,
        "one such number spoils a picture",
        case.snippet(
            snippets.FINITE_SAMPLE if kind > 2 else snippets.FINITE,
            wi=wi[i], uv=uv[i], wo=wo[i], u=u[i], setting=setting,
        ),
    )  # fmt: skip
    return faults


def _bad(values: Array) -> Array:
    return ~(np.isfinite(values) & (values >= 0)).reshape(len(values), -1).all(axis=1)


def _ends(case: Case) -> Iterator[tuple[str, float, Any]]:
    """Every number, colour or bitmap of the BSDF at the ends of its likely range, one at a time."""
    for key, value in _parameters(case):
        number = float(np.mean(np.array(value)))
        least = 1e-3 if "alpha" in key or "rough" in key else 0.0  # no roughness is another kind of surface
        for end in (least, 1.0) if 0 <= number <= 1 else (1.001, 2 * number):
            yield key, end, _changed(case, key, lambda old, end=end: type(old)(old * 0 + end))


def _parameters(case: Case) -> list[tuple[str, Any]]:
    """Parameters that hold floating-point numbers which say how much of something there is."""
    import drjit as dr
    import mitsuba as mi

    params = mi.traverse(case.bsdf)
    found = []
    for key in params.keys():  # noqa: SIM118 - SceneParameters is no dict
        value = params[key]
        numeric = isinstance(value, float) or (
            value is not None and dr.is_array_v(value) and dr.is_float_v(value) and not dr.is_matrix_v(value)
        )
        if numeric and "to_uv" not in key and np.size(np.array(value)) > 0:
            found.append((key, value))
    return found


@contextmanager
def _changed(case: Case, key: str, change: Any) -> Iterator[Any]:
    """Change a parameter for a while."""
    import mitsuba as mi

    params = mi.traverse(case.bsdf)
    before = params[key] if isinstance(params[key], float) else type(params[key])(params[key])
    params[key] = change(before)
    params.update()
    try:
        yield params[key]
    finally:
        params[key] = before
        params.update()


# ----------------------------------------------- Roundoff -------------------------------------------------


def roundoff(law: Law, case: Case) -> None:
    """Noise of float32 evaluation beyond what the rounding of the directions explains."""
    case.need_smooth()
    lit = case.pairs.only((np.abs(case.pairs.wi[:, 2]) > 0.1) & (np.abs(case.pairs.wo[:, 2]) > 0.1))
    lit = lit.only((lit.pdf > 0) & (lit.value.max(axis=1) > 1e-20))
    few = lit.only(slice(0, case.count(500, 2000)))
    if len(few.pdf) < 20:
        raise Skip("too few pairs of directions with a value")
    inputs = np.concatenate([few.wi, few.wo], axis=1)
    for what, function in (("eval()", lambda *a: case.probe.eval(*a).max(axis=1)), ("pdf()", case.probe.pdf)):

        def at(x: Array, function: Any = function) -> Array:
            return function(x[:, :3], x[:, 3:], np.tile(few.uv, (len(x) // len(few.uv), 1)))

        found = noise.measure(at, inputs, seed=case.seed)
        lost = np.where(np.isfinite(found.lost(noise.ALLOWANCE)), found.lost(noise.ALLOWANCE), 0)
        measured = float(np.quantile(lost, 0.9))
        i = int(np.abs(lost - measured).argmin())
        law.at_most(
            f"noise of {what} over that of {noise.ALLOWANCE:g} roundings with rounded directions, 9 in 10",
            measured,
            noise.LOST,
            "sound formulas stay below 1.3; beyond, digits are lost inside that could be kept",
            case.snippet(snippets.NOISE, wi=few.wi[i], uv=few.uv[i], wo=few.wo[i], function=what[:-2]),
        )
        if measured > noise.LOST:
            law.notes.append(
                f"{what}: noise of {np.median(found.noise):.3g} roundings (2^-24), "
                f"of which directions explain {np.median(found.explained):.3g}"
            )


# ---------------------------------------------- Gradients -------------------------------------------------


def gradients(law: Law, case: Case) -> None:
    """Forward derivatives of the mean value by every differentiable parameter, against differences."""
    import mitsuba as mi

    if is_scalar() or "_ad_" not in mi.variant():
        raise Skip(f"{mi.variant()} has no derivatives")
    case.need_smooth()
    case = case.copy()
    params = mi.traverse(case.bsdf)
    keys = [k for k, _ in _parameters(case) if not params.flags(k) & int(mi.ParamFlags.NonDifferentiable)]
    if not keys:
        raise Skip("traverse() marks no parameter as differentiable")
    detached = []
    for key in keys:
        with _changed(case, key, _inside):
            found, attached = _derivatives(case, key)
            slope, error = _differences(case, key)
        off = np.abs(found - slope)
        usual = off <= np.quantile(
            off, 0.98
        )  # where a value has a kink, such as total reflection, no slope is
        beyond = np.maximum(off - error, 0)[usual].sum()
        measured = beyond / max(np.abs(slope)[usual].sum(), np.abs(found)[usual].sum(), 1e-30)
        if measured > GRADIENT and not attached:
            detached.append(key)
        i = int(np.where(usual, off, 0).argmax())
        few = _lit(case)
        law.at_most(
            f"derivative of values by {key}{'' if attached else ' (detached)'}, relative, beyond the error "
            "of differences",
            measured,
            GRADIENT,
            "differences of two widths agree better than that, or the difference is allowed for",
            case.snippet(snippets.GRADIENT, key=key, wi=few.wi[i], uv=few.uv[i], wo=few.wo[i]),
        )
    if detached:
        law.notes.append(f"detached: {', '.join(detached)}")


def _inside(value: Any) -> Any:
    """Return a parameter away from the ends of its range, so that it can be varied both ways."""
    number = float(np.mean(np.array(value)))
    return type(value)(value * 0.9) if number == 1 else type(value)(value + 0.1) if number == 0 else value


def _lit(case: Case) -> Pairs:
    """Return pairs away from the horizon, over which values jump."""
    p = case.pairs
    up = (np.abs(p.wo[:, 2]) > 0.05) & (np.abs(p.wi[:, 2]) > 0.05)
    return p.only(up & np.isfinite(p.value).all(axis=1) & (p.value > 0).any(axis=1))


def _values(case: Case) -> Any:
    """Return values at pairs as a Dr.Jit array with derivatives, each over what it is without a change."""
    import drjit as dr
    import mitsuba as mi

    few = _lit(case)
    wi, wo = (mi.Vector3f(np.ascontiguousarray(x.T)) for x in (few.wi, few.wo))
    si = interaction(wi, mi.Point2f(np.ascontiguousarray(few.uv.T)))
    scale = np.maximum(few.value.max(axis=1), 1e-3 * few.value.max())
    value = mi.unpolarized_spectrum(case.bsdf.eval(context(), si, wo))
    total = sum(value[i] for i in range(len(value))) / mi.Float(scale.astype(np.float32))
    return dr.select(dr.isfinite(total), total, 0)


def _derivatives(case: Case, key: str) -> tuple[Array, bool]:
    """Return the derivatives by a shift of the parameter, and whether there is a way to it at all."""
    import drjit as dr
    import mitsuba as mi

    shift = mi.Float(0)
    dr.enable_grad(shift)
    with _changed(case, key, lambda old: type(old)(old + shift)):
        values = _values(case)
        if not dr.grad_enabled(values):
            return np.zeros(dr.width(values)), False
        dr.forward(shift)
        return np.nan_to_num(np.array(dr.grad(values), np.float64), posinf=0, neginf=0), True


def _differences(case: Case, key: str) -> tuple[Array, Array]:
    """Return central differences, and their errors by others of twice the width."""
    import mitsuba as mi

    value = abs(float(np.mean(np.array(mi.traverse(case.bsdf)[key]))))

    def at(shift: float) -> Array:
        with _changed(case, key, lambda old: type(old)(old + shift)):
            return np.array(_values(case), np.float64)

    step = 0.01 * max(value, 0.05)
    wide, narrow = ((at(h) - at(-h)) / (2 * h) for h in (2 * step, step))
    return narrow, 2 * np.abs(wide - narrow) + 1e-6 * np.abs(at(0.0)) / step


# ------------------------------------- Components, variants, switches -------------------------------------


def components(law: Law, case: Case) -> None:
    """Flags of components against what they do; their sum against the whole; ``ctx.component``."""
    bsdf, pairs = case.bsdf, case.pairs
    count = bsdf.component_count()
    flags = [int(bsdf.flags(i)) for i in range(count)]
    whole = int(bsdf.flags())
    law.at_most(
        "flags of the whole that no component has, and the other way around",
        bin(np.bitwise_or.reduce(flags or [0]) ^ whole).count("1"),
        0,
        "flags() is the union of flags(i)",
        case.snippet(snippets.FLAGS),
    )
    _updated(law, case, count)
    parts = [case.probe.eval(pairs.wi, pairs.wo, pairs.uv, context(i)) for i in range(count)]
    allowed = case.spread(case.probe.eval, pairs.wi, pairs.wo, pairs.uv)
    error = excess(np.sum(parts, axis=0), pairs.value, allowed)
    i = int(error.argmax())
    names = {"wi": pairs.wi[i], "uv": pairs.uv[i], "wo": pairs.wo[i]}
    law.at_most(
        "sum of the components against the whole, relative",
        error[i],
        1e-4,
        "a sum",
        case.snippet(snippets.PARTS, **names),
    )
    for kind, wrong in (("eval()", _wrong_side), ("sample()", _wrong_samples)):
        faults = [wrong(case, i, flag, parts[i]) for i, flag in enumerate(flags)]
        total, where = sum(f[0] for f in faults), next((f[1] for f in faults if f[0]), {})
        body = snippets.SIDE if kind == "eval()" else snippets.COMPONENT_SAMPLE
        law.at_most(
            f"results of {kind} that contradict the component's flags",
            total,
            0,
            "reflection stays on its side, transmission crosses, lobes of one direction have no value",
            case.snippet(
                body,
                **(
                    {
                        "wi": pairs.wi[0],
                        "uv": pairs.uv[0],
                        "wo": pairs.wo[0],
                        "u": np.zeros(3),
                        "component": 0,
                    }
                    | where
                ),
            ),
        )


def _updated(law: Law, case: Case, count: int) -> None:
    import mitsuba as mi

    if case.recipe.description is not None:
        copy = case.recipe.load()
        params = mi.traverse(copy)
        for key, value in _parameters(case):
            params[key] = type(value)(value)
        params.update()
        law.at_most(
            "components more or fewer after params.update()",
            abs(copy.component_count() - count),
            0,
            "an update says nothing about lobes",
            case.snippet(snippets.UPDATED),
        )


def _wrong_side(case: Case, component: int, flags: int, value: Array) -> tuple[int, dict[str, Any]]:
    """Count values where the component's flags allow none."""
    p = case.pairs
    bad = (
        (value != 0).any(axis=1) & np.isfinite(value).all(axis=1) & ~_allowed(flags, p.wi, p.wo, smooth=True)
    )
    i = int(bad.argmax())
    return int(bad.sum()), {"component": component, "wi": p.wi[i], "uv": p.uv[i], "wo": p.wo[i]}


def _allowed(flags: int, wi: Array, wo: Array, *, smooth: bool) -> Array:
    import mitsuba as mi

    f = mi.BSDFFlags
    reflects = f.DiffuseReflection, f.GlossyReflection, *(() if smooth else (f.DeltaReflection,))
    transmits = (
        f.DiffuseTransmission,
        f.GlossyTransmission,
        *(() if smooth else (f.DeltaTransmission, f.Null)),
    )
    same, other = (any(flags & int(kind) for kind in kinds) for kinds in (reflects, transmits))
    front, back = bool(flags & int(f.FrontSide)), bool(flags & int(f.BackSide))
    return np.where(wi[:, 2] * wo[:, 2] > 0, same, other) & np.where(wi[:, 2] > 0, front, back)


def _wrong_samples(case: Case, component: int, flags: int, _: Array) -> tuple[int, dict[str, Any]]:
    """Count samples of one component that go by another name, kind or side."""
    count = case.count(2**12, 2**14)
    wi = direction(case.rng.uniform(-1, 1, count), case.rng.uniform(0, 2 * np.pi, count))
    u, uv = case.uniform(count), case.rng.random((count, 2), np.float32)
    s = case.probe.sample(wi, u, uv, context(component))
    lit = (s.weight != 0).any(axis=1) & np.isfinite(s.weight).all(axis=1)
    bad = lit & ((s.component != component) | ((s.type & ~flags) != 0) | (s.type == 0))
    clear = np.abs(s.wo[:, 2]) > 1e-6
    bad |= lit & clear & ~_allowed(flags, wi, s.wo, smooth=False)
    i = int(bad.argmax())
    return int(bad.sum()), {"component": component, "wi": wi[i], "uv": uv[i], "u": u[i], "wo": s.wo[i]}


def variants(law: Law, case: Case) -> None:
    """The same values in the scalar variant, and in the spectral one where colours are grey."""
    import mitsuba as mi

    here = mi.variant()
    case.recipe.load()
    few = case.pairs.only(slice(0, case.count(200, 800)))
    few = few.only(np.isfinite(few.value).all(axis=1))
    allowed = (
        case.spread(case.probe.eval, few.wi, few.wo, few.uv),
        case.spread(case.probe.pdf, few.wi, few.wo, few.uv),
    )
    grey = np.ptp(few.value, axis=1).max() <= 1e-5 * few.value.max()
    for other in _others(here, grey, law):
        if runtime.obstacle(other):
            law.notes.append(f"{other} cannot run here")
            continue
        try:
            mi.set_variant(other)
            runtime.use(other)
            try:
                bsdf = case.recipe.load()
            except RuntimeError as problem:
                if "not found" not in str(problem):
                    raise
                law.notes.append(
                    f"{other} does not know the plugin: register it there (mi.detail.add_variant_callback)"
                )
                continue
            value, pdf = Probe(bsdf).both(few.wi, few.wo, few.uv)
        finally:
            mi.set_variant(here)
        if "rgb" not in other:  # the mean of equal channels, however many there are
            value, expected = value.mean(axis=1), few.value.mean(axis=1)
        else:
            expected = few.value
        spread = allowed[0] if value.ndim > 1 else allowed[0].max(axis=1)
        error = np.maximum(excess(value, expected, spread), excess(pdf, few.pdf, allowed[1]))
        i = int(error.argmax())
        law.at_most(
            f"value and density in {other} against {here}, relative, beyond rounding",
            error[i],
            POINTWISE,
            "the same formula",
            case.snippet(snippets.VARIANT, wi=few.wi[i], uv=few.uv[i], wo=few.wo[i], other=other),
        )
    if not law.parts:
        raise Skip("; ".join(law.notes) or "no other variant to compare with")


def _others(here: str, grey: bool, law: Law) -> list[str]:
    import mitsuba as mi

    known = set(mi.variants())
    pairs = (("llvm_ad_", "scalar_"), ("cuda_ad_", "scalar_"), ("scalar_", "llvm_ad_"))
    found = [here.replace(a, b) for a, b in pairs if here.startswith(a) and here.replace(a, b) in known]
    if here.endswith("_rgb"):
        if grey:
            found.append(here.replace("_rgb", "_spectral"))
        else:
            law.notes.append("coloured: a spectral variant need not agree")
    return found


def switch(law: Law, case: Case) -> None:
    """The same values after the variant was switched to another one and back, loaded anew and as it was."""
    import mitsuba as mi

    here = mi.variant()
    other = (
        "scalar_rgb"
        if here != "scalar_rgb"
        else next((v for v in runtime.usable_variants() if v != here), None)
    )
    few = case.pairs.only(slice(0, case.count(1000, 1000)))
    before = case.probe.both(few.wi, few.wo, few.uv)
    allowed = [case.spread(f, few.wi, few.wo, few.uv) for f in (case.probe.eval, case.probe.pdf)]
    if other is None:
        raise Skip("there is no other variant to switch to")
    mi.set_variant(other)
    mi.set_variant(here)
    candidates = {"that was loaded before": case.bsdf}
    if case.recipe.description is not None:
        candidates["loaded anew"] = case.recipe.load()
    else:
        law.notes.append("a loaded BSDF was given: it was not loaded anew")
    for which, bsdf in candidates.items():
        after = Probe(bsdf).both(few.wi, few.wo, few.uv)
        error = np.maximum(*(excess(*pair) for pair in zip(before, after, allowed, strict=True)))
        i = int(error.argmax())
        law.at_most(
            f"values of the BSDF {which} after a switch to {other} and back, relative, beyond rounding",
            error[i],
            1e-4,
            "the same formula with the same numbers",
            case.snippet(snippets.SWITCH, wi=few.wi[i], uv=few.uv[i], wo=few.wo[i], other=other),
        )


LAWS = {
    "sampling": sampling,
    "weights": weights,
    "eval_pdf": eval_pdf,
    "energy": energy,
    "reciprocity": reciprocity,
    "finite": finite,
    "roundoff": roundoff,
    "gradients": gradients,
    "components": components,
    "variants": variants,
    "switch": switch,
}
