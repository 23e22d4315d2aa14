"""``check_scene``: every BSDF, shape and emitter of a scene by its laws, and a hunt for NaN pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from html import escape
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from mrt_mitsuba import runtime
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.validation.checks import probe
from mrt_mitsuba.validation.checks.bsdf import check_bsdf
from mrt_mitsuba.validation.checks.law import Check, Law, Skip, Subject, class_name, examine, figures, rare
from mrt_mitsuba.validation.checks.probe import BEYOND, Array, Lanes, excess, lanes, not_finite
from mrt_mitsuba.validation.checks.shape import check_shape
from mrt_mitsuba.validation.checks.sphere import Cells, chi_square, encode, integrate
from mrt_mitsuba.validation.tools.compare import sidak
from mrt_mitsuba.validation.tools.study import Study, save_report

ALIKE = 6  # of one kind of plugin, so many are checked, spread over all
DEPTH = 12  # bounces that the hunt follows
COUNTS = (16, 128, 1024, 8192)  # samples of one pixel, to see a fault again


@dataclass(frozen=True)
class Fault:
    """A pixel that is not finite: the smallest crop found that shows it, and what makes it."""

    pixels: int  # how many there are in the whole picture
    crop: tuple[int, int, int, int]  # x, y, width, height
    spp: int  # samples of a pixel at which the crop shows it
    culprit: str

    def __str__(self) -> str:
        x, y, width, height = self.crop
        return (
            f"{self.pixels} pixels are not finite; the smallest crop: {width}x{height} at ({x}, {y}), "
            f"with {self.spp} samples a pixel. Made by {self.culprit}"
        )


@dataclass(frozen=True)
class SceneCheck:
    """The findings of a check of a scene: for each plugin, by name, and for the picture."""

    name: str
    checks: Mapping[str, Check]
    fault: Fault | None
    left_out: tuple[str, ...] = ()

    @property
    def failed(self) -> list[str]:
        """Return what does not hold, as "name: law", and "pixels" where some are not finite."""
        laws = [f"{name}: {law}" for name, check in self.checks.items() for law in check.failed]
        return laws + (["pixels"] if self.fault else [])

    @property
    def passed(self) -> bool:
        return not self.failed

    def __str__(self) -> str:
        lines = [str(check) if check.failed else str(check).splitlines()[0] for check in self.checks.values()]
        lines += [*self.left_out, str(self.fault or "every pixel is finite")]
        return "\n".join([*lines, f"{self.name}: {'passed' if self.passed else 'FAILED'}"])

    def save(self, folder: str | Path) -> None:
        """Write the page (``index.html``), ``summary.json`` and CSV files. Raises ``OutputError``."""
        picture, bad = Study("picture", "picture"), self.fault.pixels if self.fault else 0
        picture.at_most("pixels that are not finite", bad, 0, str(self.fault or "a picture is of numbers"))
        studies = [*(check.study() for check in self.checks.values()), picture]
        save_report(folder, *studies, title=f"Laws of plugins: {self.name}")

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


def check_scene(
    scene: Any, *, quick: bool = False, seed: int = 0, progress: Progress | None = None, **options: Any
) -> SceneCheck:
    """Check every BSDF, shape and emitter of a scene, and hunt for pixels that are not finite.

    ``scene`` and ``options`` (such as ``integrator``) are those of ``render``. Only some
    of many plugins of one kind are checked. Raises ``SceneError`` or ``UsageError`` where the scene does not
    open.
    """
    runtime.use()
    source = open_scene(scene, **options)
    kinds = _plugins(source.scene)
    emitter = partial(examine, partial(EmitterCase, source.scene), laws=EMITTER_LAWS)
    laws: dict[str, Callable[..., Check]] = {"BSDF": check_bsdf, "shape": check_shape, "emitter": emitter}
    found: dict[str, Check] = {}
    chosen = [(k, i) for k, alike in kinds.items() for i in range(0, len(alike), max(len(alike) // ALIKE, 1))]
    with (progress or Progress()).stage("Laws", len(chosen)) as advance:
        for kind, number in chosen:
            name = f"{kind} {kinds[kind][number].id() or number}"
            name = name if name not in found else f"{name} ({number})"
            check = laws[kind.split()[0]](kinds[kind][number], quick=quick, seed=seed)
            found[name] = replace(check, subject=name)
            advance(1)
    more = Counter({kind: len(alike) for kind, alike in kinds.items()}) - Counter(kind for kind, _ in chosen)
    left_out = [f"{n} more of {kind} are like those that were checked" for kind, n in more.items()]
    if instances := sum(shape.class_name() == "Instance" for shape in source.scene.shapes()):
        left_out.append(f"{instances} instances are not checked: give a dict of one with its group")
    return SceneCheck(source.name, found, _hunt(source, quick, seed), tuple(left_out))


def _plugins(scene: Any) -> dict[str, list[Any]]:
    """Return the BSDFs, shapes and emitters of a scene, each once, by kind, but for instances."""
    shapes = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    bsdfs = {str(id(b)): b for b in (shape.bsdf() for shape in shapes) if b is not None}.values()
    kinds: dict[str, list[Any]] = {}
    for word, plugins in (("BSDF", bsdfs), ("shape", shapes), ("emitter", scene.emitters())):
        for plugin in plugins:
            kinds.setdefault(f"{word} {class_name(plugin)}", []).append(plugin)
    return kinds


# ------------------------------------------------ Emitters -----------------------------------------------

SAME = 1e-3  # relative: the same formula, evaluated once more
TURNED = 4 * probe.ROUNDED  # a direction passes through angles, a transform, and back
LENGTH = 1e-4  # relative: a square root, and the difference of two points


class EmitterCase(Subject):
    """An emitter of a scene, and points in and about its box from which it is looked at [N, 3]."""

    samples = cached_property(lambda self: self.sample(self.points))

    def __init__(self, scene: Any, emitter: Any, quick: bool, seed: int) -> None:
        super().__init__(emitter, quick, seed)
        box = scene.bbox()
        low, high = (np.nan_to_num(np.ravel(np.array(c)), posinf=1, neginf=-1) for c in (box.min, box.max))
        self.points = np.float32(self.rng.uniform(1.1 * low - 0.1 * high, 1.1 * high - 0.1 * low, (2**12, 3)))
        flags = int(emitter.flags())
        # whether light comes from all around, and not from single directions, a surface or a point
        self.around = bool(flags & int(mi.EmitterFlags.Infinite)) and not flags & int(mi.EmitterFlags.Delta)

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

    def seen(self, d: Array) -> list[Array]:
        """Return the density of directions [N] and the light that is seen there [N, channels]."""

        def call(d: Any) -> list[Any]:
            it = _seen_from(mi.Point3f(*map(float, self.points[0])))
            ds, _ = self.plugin.sample_direction(it, mi.Point2f(0.5))
            ds.d, it.wi = d, -d
            return [self.plugin.pdf_direction(it, ds), self.plugin.eval(it)]

        return lanes(call, ("Vector3f", d))

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
def density(law: Law, case: EmitterCase) -> None:
    """The density that a sample states is ``pdf_direction``."""
    s = case.samples
    if not (s.lit & ~s.delta).any():
        raise Skip("light comes from single directions (delta), or none was sampled")
    law.hold("same", excess(s.pdf, s.again, case.spread[0])[s.lit & ~s.delta])


@figures(
    place=("most", "sampled point off the stated direction and distance, relative", LENGTH,
           "one place, said in two ways"),
    counts=rare("chance of such counts if directions follow pdf_direction()"),
)  # fmt: skip
def sampling(law: Law, case: EmitterCase) -> None:
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
def weights(law: Law, case: EmitterCase) -> None:
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
def finite(law: Law, case: EmitterCase) -> None:
    """All numbers of samples are finite, directions one unit long, weights and densities not negative."""
    s = case.samples
    bad = ~np.all([np.isfinite(x) & (x >= 0) for x in (s.weight, s.value)], axis=(0, 2))
    length = np.abs(np.linalg.norm(s.d.astype(np.float64), axis=1) - 1)
    law.hold("bad", bad | s.lit & ~((length <= LENGTH) & np.isfinite(s.dist) & (s.pdf >= 0)))


EMITTER_LAWS = {law.__name__: law for law in (density, sampling, weights, finite)}


# ------------------------------------------------- The hunt -----------------------------------------------


def _hunt(source: Any, quick: bool, seed: int) -> Fault | None:
    """Render, and look for a pixel that is not finite: alone if it then still is, else in the whole film."""
    spp, film = 4 if quick else 32, source.sensor.film()
    bad = _bad(source, spp, seed)
    if not bad.any():
        return None
    (left, top), (y, x) = film.crop_offset(), np.argwhere(bad)[0]
    alone = int(left + x), int(top + y), 1, 1
    with _cropped(source.sensor, alone):
        for count in COUNTS:
            if _bad(source, count, seed).any():
                return Fault(int(bad.sum()), alone, count, _culprit(source, count, seed))
    whole = int(left), int(top), *bad.shape[::-1]
    return Fault(int(bad.sum()), whole, spp, _culprit(source, spp, seed))


def _bad(source: Any, spp: int, seed: int) -> np.ndarray:
    """Return which pixels are not finite. [H, W]"""
    picture = mi.render(source.scene, integrator=source.integrator, sensor=source.sensor, spp=spp, seed=seed)
    return ~np.isfinite(np.array(picture)).all(axis=-1)


@contextmanager
def _cropped(sensor: Any, crop: tuple[int, int, int, int]) -> Iterator[None]:
    """Crop the film for a while."""
    params, keys = mi.traverse(sensor), ("film.crop_size", "film.crop_offset")
    before = {key: type(params[key])(params[key]) for key in keys}
    params.update(dict(zip(keys, (crop[2:], crop[:2]), strict=True)))
    try:
        yield
    finally:
        params.update(before)


def _culprit(source: Any, spp: int, seed: int) -> str:
    """Follow paths through the crop, and name the object whose own numbers are first not finite."""
    if mi.variant().startswith("scalar"):
        return "something that scalar variants do not reveal: check it in a vectorised one"
    pixels = int(np.prod(np.array(source.sensor.film().crop_size())))
    for attempt in range(8):
        if counts := _follow(source, min(max(spp, 2**12) * pixels, 2**20), seed + attempt):
            return counts.most_common(1)[0][0]
    return "no object's own numbers: by the integrator, or a sum that overflows"


def _follow(source: Any, count: int, seed: int) -> Counter[str]:
    """Trace one batch of paths; return how often each object was the first to give an infinity or NaN."""
    scene, ctx, rng = source.scene, mi.BSDFContext(), mi.PCG32(count, initstate=seed)
    counts: Counter[str] = Counter()
    active, draw = mi.Bool(True), rng.next_float32
    # the unit square covers the crop of a cropped film
    ray, _ = source.sensor.sample_ray(draw(), draw(), mi.Point2f(draw(), draw()), mi.Point2f(draw(), draw()))

    def sound(what: str, pointers: Any, *values: Any) -> Any:
        """Return where values are finite, and count those that are not for the objects of ``pointers``."""
        bad, plugins = active & not_finite(*values), scene.emitters() if what == "emitter" else scene.shapes()
        for one in plugins if dr.any(bad) else ():
            name = f"{_name(one.bsdf())}, on {_name(one)}" if what == "BSDF" else _name(one)
            counts[f"the {what} {name}"] += int(dr.count(bad & (pointers == type(pointers)(one)))[0])
        return ~bad

    for _ in range(DEPTH):
        si = scene.ray_intersect(ray, active)
        met = si.emitter(scene, active)
        active &= sound("emitter", met, met.eval(si, active))
        active &= si.is_valid()
        active &= sound("shape", si.shape, si.p, si.n, si.sh_frame.n, si.uv)
        ds, light = scene.sample_emitter_direction(si, mi.Point2f(draw(), draw()), True, active)
        active &= sound("emitter", ds.emitter, light)
        bsdf = si.bsdf(ray)
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active & (ds.pdf > 0))
        bs, weight = bsdf.sample(ctx, si, draw(), mi.Point2f(draw(), draw()), active)
        value, weight = mi.unpolarized_spectrum(value), mi.unpolarized_spectrum(weight)
        lit = dr.any(weight != 0)
        drawn = dr.select(lit, bs.wo, 0), dr.select(lit, bs.pdf, 0)
        active &= lit & sound("BSDF", si.shape, value, pdf, weight, *drawn)
        ray = si.spawn_ray(si.to_world(bs.wo))
        dr.eval(ray, active, rng)
        if not dr.any(active):
            break
    return +counts


def _name(plugin: Any) -> str:
    return f"{class_name(plugin)} {plugin.id()!r}"
