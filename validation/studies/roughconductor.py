"""``mrt_bsdf`` against Mitsuba's ``roughconductor``: values, pictures, metals, noise and time."""

from __future__ import annotations

import os
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.output.files import write_exr
from mrt_mitsuba.validation.checks.probe import is_scalar
from mrt_mitsuba.validation.oracles import exact
from mrt_mitsuba.validation.tools import image_tests
from mrt_mitsuba.validation.tools.bsdf_probe import (
    Array,
    evaluate,
    interaction,
    largest,
    lobe_pairs,
    relative_error,
    rgb,
)
from mrt_mitsuba.validation.tools.image_tests import Comparison
from mrt_mitsuba.validation.tools.scenery import ball_scene
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.timing import in_turns, timed

TITLE = "The BSDF against Mitsuba's roughconductor"

ALPHAS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
POINTWISE = 2e-5  # exp of up to 16, of arguments that are right to a few roundings
SCALAR_PAIRS = 60  # scalar variants take milliseconds for each
SHORT = 0.02  # of |ωi + ωo|²: above, Mitsuba's density is right to 3e-6
JUDGED = 10  # densities for each variant and roughness
NAMES = ("value", "density of visible normals", "density of plain D sampling")
LEVEL = 1e-3  # probability with which a test of pictures rejects equal ones
POWER_ALPHA = 0.3  # of the pictures in which small errors must be seen; a highlight is then some pixels wide
MUTATIONS: Mapping[str, Mapping[str, Any]] = {
    "radiance x 1.02": {"specular_reflectance": 1.02},
    "alpha x 1.05": {"alpha": 1.05 * POWER_ALPHA},
}


def run(study: Study, *, quick: bool) -> None:
    """Run all parts; ``compare_roughconductor`` does the pictures of one roughness."""
    study.text(
        "With F = 1 and no diffuse part, mrt_bsdf and roughconductor are the same function: their values are "
        "compared point by point and in pictures, with equal random numbers and with independent ones. Real "
        "metals then show what Schlick's Fresnel term costs, and samples what either pays for the same noise."
    )
    pointwise(study, quick=quick)
    rendered(study, quick=quick)
    metals(study, quick=quick)
    efficiency(study, quick=quick)


# ------------------------------------------ Point by point ------------------------------------------


def ours(alpha: float, *, visible: bool = True, **more: Any) -> dict[str, Any]:
    """Return ``mrt_bsdf`` with F = 1 and no diffuse part."""
    form = {"type": "mrt_bsdf", "fresnel": "unity", "diffuse_reflectance": 0.0}
    return {**form, "alpha": alpha, "sample_visible": visible, **more}


def theirs(alpha: float, *, visible: bool = True) -> dict[str, Any]:
    """Return ``roughconductor`` with F = 1."""
    form = {"type": "roughconductor", "material": "none", "distribution": "beckmann"}
    return {**form, "alpha": alpha, "sample_visible": visible}


def compare_pointwise(alpha: float, *, count: int, seed: int = 1) -> tuple[dict[str, float], Array]:
    """Compare values and densities of ``count`` random pairs of directions, in the current variant.

    Return the largest relative differences by name; of plain D sampling's density where the half vector is
    well known. Mitsuba's divides by ωo·h and so feels the rounding of the length of ωo, by 6e-8 / |ωi + ωo|².
    Where |ωi + ωo|² < ``SHORT`` and the densities differ, 50 digits judge both: our error and theirs, [n, 2].
    """
    wi, wo = lobe_pairs(count, alpha, seed=seed)
    found = {}
    for visible in (True, False):
        pair = (mi.load_dict(bsdf(alpha, visible=visible)) for bsdf in (ours, theirs))
        found[visible] = [evaluate(bsdf, wi, wo) for bsdf in pair]
    value = largest(relative_error(one[0], other[0]).max() for one, other in found.values())
    visible_error = relative_error(found[True][0][1], renormalised(found[True][1][1], wi, alpha))
    plain = found[False][0][1], found[False][1][1]
    plain_error = relative_error(*plain)
    short = ((wi.astype(float) + wo) ** 2).sum(axis=-1) < SHORT
    apart = np.flatnonzero(short & (plain_error > POINTWISE))
    worst = apart[np.argsort(-plain_error[apart])[:JUDGED]]
    judged = []
    for i in worst:  # D cos θh / (4 ωo·h), h of the directions as they are given, ωo·h of those of length 1
        given = exact.unit([float(a) + float(b) for a, b in zip(wi[i], wo[i], strict=True)])
        pairs = zip(exact.unit(list(wo[i])), exact.half_vector(wi[i], wo[i]), strict=True)
        density = exact.beckmann_d(given[2], alpha if is_scalar() else np.float32(alpha))
        true = density * given[2] / (4 * sum(a * b for a, b in pairs))
        judged.append([abs(float(side[i] / true) - 1) for side in plain])
    figures = (value, float(visible_error.max()), float(plain_error[~short].max()))
    return dict(zip(NAMES, figures, strict=True)), np.array(judged).reshape(-1, 2)


def renormalised(density: Array, wi: Array, alpha: float) -> Array:
    """Return ``roughconductor``'s density of visible normals, brought to integrate to one.

    It takes the rational fit of G₁(ωi) for the normaliser 1 / (1 + Λ(ωi)), and is off by up to 0.4 %.
    """
    z, across = wi[:, 2].astype(float), np.hypot(wi[:, 0].astype(float), wi[:, 1])
    b = z / np.maximum(alpha * across, 1e-30)
    smith = (erf(b) - 1) / 2 + np.exp(-(np.minimum(b, 30) ** 2)) / (2 * np.sqrt(np.pi) * b)
    fit = np.where(b < 1.6, b * (3.535 + 2.181 * b) / (1 + b * (2.276 + 2.577 * b)), 1)
    return density / ((1 + smith) * fit)


def pointwise(study: Study, *, quick: bool) -> None:
    """Compare values and densities, over roughness and in every variant that can run here."""
    variants = runtime.usable_variants()
    if quick:  # every colour mode once, and one scalar variant
        variants = [name for name in variants if not name.startswith("scalar") or name == runtime.SLOW]
    count, before = 5_000 if quick else 200_000, runtime.use()
    rows: list[list[Any]] = []
    judged = []
    for variant in study.each("points", variants):
        runtime.use(variant)
        pairs = SCALAR_PAIRS if is_scalar() else count
        for alpha in ALPHAS:
            found, apart = compare_pointwise(alpha, count=pairs)
            rows.append([variant, alpha, pairs, *found.values(), len(apart)])
            judged.append(apart)
    runtime.use(before)
    columns = ["variant", "alpha", "pairs", *NAMES, "judged"]
    note = "Judged: pairs at grazing angles whose densities of plain D sampling differ by more, up to 10."
    study.table("pointwise", "Largest relative differences from roughconductor", columns, rows, note)
    for column, name in enumerate(NAMES, start=3):
        what = f"{name}, relative, {len(variants)} variants"
        why = "exp of up to 16, of arguments right to a few roundings"
        study.at_most(what, largest(row[column] for row in rows), POINTWISE, why)
    errors = np.concatenate(judged)
    study.record("densities of plain D sampling at grazing angles judged by 50 digits", len(errors))
    if len(errors):
        study.record("their largest error among these", errors[:, 1].max())
        what = "our largest error where the densities differ, against 50 digits"
        study.at_most(what, errors[:, 0].max(), POINTWISE, "the same, of D alone")


# --------------------------------------------- Pictures ---------------------------------------------


@dataclass(frozen=True)
class RoughconductorComparison:
    """Ours against Mitsuba's, of one roughness. ``images``: "ours", "theirs", "difference" [H, W, 3]."""

    alpha: float
    errors: Mapping[str, float]  # by name, unitless
    timings: Mapping[str, float]  # seconds: the median of renders, kernels compiled before; and their ratio
    images: Mapping[str, NDArray[np.float32]]
    test: Comparison  # of renders with independent random numbers
    samples: int  # per pixel, in each of the two averages

    @property
    def equal(self) -> bool:
        """Return whether neither single points nor the pictures distinguish them."""
        return not self.test.rejects and all(self.errors[name] <= POINTWISE for name in NAMES)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an EXR: ours as R, G, B, and the layers "theirs" and "difference". Raises ``OutputError``."""
        layers = {name: self.images[name] for name in ("theirs", "difference")}
        header = {"mrt:alpha": self.alpha, "mrt:errors": dict(self.errors), "mrt:timings": dict(self.timings)}
        write_exr(path, self.images["ours"], layers, header)

    def __str__(self) -> str:
        seconds = {f"{name} [s]": self.timings[name] for name in ("ours", "theirs")}
        rows = {**self.errors, **seconds, "time, ours / theirs": self.timings["ratio"]}
        verdict = "equal" if self.equal else "different"
        lines = [f"  {name:<44} {value:.4g}" for name, value in rows.items()]
        return "\n".join([f"mrt_bsdf and roughconductor, alpha = {self.alpha:g}: {verdict}", *lines])

    def _repr_html_(self) -> str:
        from html import escape

        return f"<pre>{escape(str(self))}</pre>"


def compare_roughconductor(
    alpha: float = 0.1,
    *,
    size: int = 96,
    spp: int = 8,
    renders: int = 32,
    sample_visible: bool = True,
    pairs: int = 20_000,
    seed: int = 0,
) -> RoughconductorComparison:
    """Compare ``mrt_bsdf`` (F = 1, no diffuse part) with Mitsuba's ``roughconductor``.

    ``size``: width of the pictures in pixels; ``spp``: samples per pixel of each of the ``renders``, whose
    mean and variance are compared; ``pairs``: of directions for the comparison point by point.

    Needs ``pip install 'mrt-mitsuba[validation]'``. Works in a vectorised variant, which becomes current.
    Raises ``UsageError`` for a roughness that ``roughconductor`` does not take.
    """
    if not 0 < alpha <= 1:
        raise UsageError(f"alpha={alpha!r}: roughconductor is compared for a roughness in (0, 1]")
    runtime.use(runtime.FAST)
    points, _ = compare_pointwise(alpha, count=pairs)
    pair = [bsdf(alpha, visible=sample_visible) for bsdf in (ours, theirs)]
    stacks, seconds = _render_both(pair, size=size, spp=spp, renders=renders, seed=seed)
    first, second = (stack.mean(axis=0) for stack in stacks)
    test = image_tests.compare(*stacks, level=LEVEL)
    errors = {
        **points,
        "relRMSE of the pictures": test.rel_rmse,
        "probability of so much between equal pictures": test.p,
        "pixels that differ, with the same random numbers": same_numbers(alpha, size=size),
    }
    timings = {"ours": seconds[0], "theirs": seconds[1], "ratio": seconds[0] / seconds[1]}
    images = {"ours": first, "theirs": second, "difference": first - second}
    return RoughconductorComparison(
        alpha, errors, timings, {n: i.astype(np.float32) for n, i in images.items()}, test, spp * renders
    )


def _render_both(
    bsdfs: Sequence[Mapping[str, Any]], *, size: int, spp: int, renders: int, seed: int, studio: bool = False
) -> tuple[list[Array], list[float]]:
    """Return renders [N, H, W, 3] of each material, with other seeds, in turn, and their median seconds."""
    scenes = [ball_scene(bsdf, size=size, studio=studio) for bsdf in bsdfs]
    for scene in scenes:
        np.array(mi.render(scene, spp=spp))  # compiles

    def side(index: int) -> Callable[[int], tuple[Array, float]]:
        seeds = range(seed + 1 + index, seed + 1 + index + renders * len(scenes), len(scenes))
        return lambda turn: timed(lambda: np.array(mi.render(scenes[index], spp=spp, seed=seeds[turn])))

    found = [zip(*runs, strict=True) for runs in in_turns([*map(side, range(len(scenes)))], renders)]
    pictures, seconds = zip(*found, strict=True)
    return [np.stack(stack) for stack in pictures], [statistics.median(times) for times in seconds]


def same_numbers(alpha: float, *, size: int = 96, spp: int = 16) -> float:
    """Return the share of pixels that differ by more than 1e-4 when both draw the same random numbers.

    Drawn from D, whose density is the same in both; that of visible normals is not (``renormalised``). A path
    that rounding sends past the other side of an edge goes on differently; anything else would show in most
    pixels of the ball.
    """
    scenes = (ball_scene(bsdf(alpha, visible=False), size=size) for bsdf in (ours, theirs))
    one, other = (np.array(mi.render(scene, spp=spp, seed=1)) for scene in scenes)
    return float((np.abs(one - other) > 1e-4 * np.maximum(other, other.mean())).any(axis=-1).mean())


def rendered(study: Study, *, quick: bool) -> None:
    """Compare pictures: equal with equal random numbers, alike with others, while small errors show."""
    settings: dict[str, Any] = (
        {"size": 64, "spp": 8, "renders": 64} if quick else {"size": 128, "spp": 8, "renders": 96}
    )
    alphas = (POWER_ALPHA,) if quick else (0.03, 0.1, POWER_ALPHA)
    for alpha in study.each("pictures", alphas):
        found, at = compare_roughconductor(alpha, **settings), f"alpha {alpha:g}"
        what = f"share of pixels that differ with the same random numbers, {at}"
        why = "paths that rounding sends past an edge; the ball covers a third of the picture"
        study.at_most(what, found.errors["pixels that differ, with the same random numbers"], 5e-3, why)
        what, why = f"p of the difference with independent numbers, {at}", "pixels, tiles and the picture"
        study.at_least(what, found.test.p, LEVEL, why)
        study.record(f"relRMSE of the averages, {at}", found.test.rel_rmse)
        study.record(f"time, ours over theirs, {at}", found.timings["ratio"])
        one, other, difference = found.images.values()
        sheet = np.concatenate([one, other, 20 * np.abs(difference)], axis=1)
        caption = f"{found.samples} samples per pixel each, independent: the difference is noise."
        title = f"Ours, Mitsuba's, |difference| × 20; {at}"
        study.picture(f"pictures-{alpha:g}", title, sheet, caption)
    for name, change in study.each("mistakes", MUTATIONS.items()):
        broken = {**ours(POWER_ALPHA), **change}
        stacks, _ = _render_both([broken, theirs(POWER_ALPHA)], seed=100, **settings)
        test = image_tests.compare(*stacks, level=LEVEL)
        why = "the test of pictures must see this error"
        study.at_most(f"p of the difference with {name}", test.p, LEVEL, why)


# ------------------------------------------ Noise and time ------------------------------------------


def efficiency(study: Study, *, quick: bool) -> None:
    """Compare noise at equal sample counts, which is held, and at equal time, which is recorded."""
    settings = {"size": 64, "spp": 16, "renders": 12} if quick else {"size": 96, "spp": 16, "renders": 32}
    rows: list[dict[str, Any]] = []
    for alpha in study.each("noise", (0.1, 0.5) if quick else (0.02, 0.1, 0.3, 0.6)):
        kinds = [(bsdf, visible) for visible in (True, False) for bsdf in (ours, theirs)]
        bsdfs = [bsdf(alpha, visible=visible) for bsdf, visible in kinds]
        stacks, seconds = _render_both(bsdfs, **settings, seed=500, studio=True)
        spreads = [stack.var(axis=0, ddof=1) for stack in stacks]
        noisy = np.min(spreads, axis=0) > 0  # the ball, not the sky around it
        # the geometric mean: a few bright pixels would turn the mean into chance
        variances = [float(np.exp(np.log(spread[noisy]).mean())) for spread in spreads]
        for sampling, first in (("visible", 0), ("D", 2)):
            variance = variances[first] / variances[first + 1]
            time = seconds[first] / seconds[first + 1]
            ratios = {"variance": variance, "time": time, "equal-time error": (variance * time) ** 0.5}
            rows.append({"alpha": alpha, "sampling": sampling, **ratios})
    study.records("efficiency", "Ours over Mitsuba's", rows, "Times: medians of renders taken in turn.")
    why = "the same sampling; the variances of a thousand pixels are known to a few percent"
    most = largest(row["variance"] for row in rows)
    study.at_most("variance at equal sample count, ours over theirs", most, 1.1, why)
    median = statistics.median(row["equal-time error"] for row in rows)
    study.record("equal-time error, ours over theirs, median", median)


# ---------------------------------------------- Metals ----------------------------------------------


def metals(study: Study, *, quick: bool) -> None:
    """Hold Schlick's term with the F₀ of every metal that Mitsuba brings to the exact Fresnel term."""
    theta = np.radians(np.arange(0.0, 90.0))
    wi = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)
    weight = np.sin(2 * theta)[:, None] / np.sin(2 * theta).sum()  # cos θ dω / π: even light
    rows = []
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # of spectra without a colour in RGB Mitsuba takes the nearest
    for path in sorted((Path(mi.__file__).parent / "data" / "ior").glob("*.eta.spd")):
        name = path.name.removesuffix(".eta.spd")
        parameters = mi.traverse(mi.load_dict({"type": "roughconductor", "material": name}))
        eta, k = (np.ravel(parameters[f"{key}.value"]).astype(float) for key in ("eta", "k"))
        f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)  # from air
        bsdf = mi.load_dict({"type": "mrt_bsdf", "f0": rgb(f0.tolist())})
        schlick = np.array(bsdf.eval_attribute("mirror_reflectance", interaction(wi))).T
        indices = [mi.Complex2f(float(n), float(x)) for n, x in zip(eta, k, strict=True)]
        exact = np.stack([mi.fresnel_conductor(mi.Float(wi[:, 2]), index) for index in indices], axis=-1)
        # Some channels of two compounds have neither index nor extinction: 0/0 along the normal
        exact = np.where(((eta == 0) & (k == 0))[None] & (wi[:, 2:] == 1), 1, exact)
        error = np.abs(schlick - exact)
        even = np.abs(((schlick - exact) * weight).sum(axis=0)).max()
        rows.append([name, error.max(), int(error.max(axis=1).argmax()), even, (error[0] / exact[0]).max()])
    mi.set_log_level(level)
    what = f"F₀ of {len(rows)} metals against the exact value, relative"
    study.at_most(what, largest(row[-1] for row in rows), 1e-5, "the same number by two formulas")
    why = "what its missing dip towards grazing angles costs, there where least light comes from"
    most = largest(row[-2] for row in rows)
    study.at_most("Schlick against exact under even light, worst metal", most, 0.05, why)
    title, note = "Schlick against exact, by material", "Differences of reflectance, of the worst channel."
    columns = ["material", "largest error", "at °", "under even light", "at 0°"]
    study.table("metals", title, columns, sorted(rows, key=lambda row: -row[1]), note)
