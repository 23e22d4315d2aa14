"""``check_scene``: every BSDF, shape and emitter of a scene by its laws, and a hunt for NaN pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.validation.checks import emitter
from mrt_mitsuba.validation.checks.bsdf import check_bsdf
from mrt_mitsuba.validation.checks.law import TITLE, Check, Law, class_name, examine
from mrt_mitsuba.validation.checks.probe import not_finite
from mrt_mitsuba.validation.checks.shape import check_shape
from mrt_mitsuba.validation.tools import report

ALIKE = 6  # of one kind of plugin, so many are checked, spread over all
DEPTH = 12  # bounces that the hunt follows
MOST_SAMPLES = 2**14  # of one pixel, to see a fault again


@dataclass(frozen=True)
class Fault:
    """A pixel that is not finite: the smallest crop of the film that shows it, and what makes it."""

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
        law = Law("pixels", notes=[str(self.fault)] if self.fault else [])
        bad = self.fault.pixels if self.fault else 0
        law.at_most("pixels that are not finite", bad, 0, "a picture is of numbers")
        variant = next((check.variant for check in self.checks.values()), "")
        pixels = Check("picture", variant, {"pixels": law}, 0.0)
        studies = [check.study() for check in (*self.checks.values(), pixels)]
        report.save(folder, *studies, title=f"{TITLE}: {self.name}")

    def _repr_html_(self) -> str:
        from html import escape

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
    kinds: dict[str, list[Any]] = {}
    for kind, plugin in _all(source.scene):
        kinds.setdefault(kind, []).append(plugin)
    plugins: dict[str, tuple[str, Any]] = {}
    left_out: tuple[str, ...] = ()
    for kind, alike in kinds.items():
        step = max(len(alike) // ALIKE, 1)
        for number, plugin in enumerate(alike[::step]):
            name = f"{kind} {plugin.id() or number * step}"
            plugins[name if name not in plugins else f"{name} ({number * step})"] = (kind, plugin)
        more = len(alike) - len(alike[::step])
        left_out += (f"{more} more of {kind} are like those that were checked",) if more else ()
    checks: dict[str, Check] = {}
    with (progress or Progress()).stage("Laws", len(plugins)) as advance:
        for name, (kind, plugin) in plugins.items():
            if kind.startswith("BSDF"):
                found = check_bsdf(plugin, quick=quick, seed=seed)
            elif kind.startswith("shape"):
                found = check_shape(plugin, quick=quick, seed=seed)
            else:
                case = emitter.Case.within(source.scene, plugin, np.random.default_rng(seed))
                found = examine(name, case, emitter.LAWS, quick=quick)
            checks[name] = replace(found, subject=name)
            advance(1)
    instances = sum(shape.class_name() == "Instance" for shape in source.scene.shapes())
    if instances:
        left_out += (f"{instances} instances are not checked: give a dict of one with its group",)
    return SceneCheck(source.name, checks, _hunt(source, quick, seed), left_out)


def _all(scene: Any) -> Iterator[tuple[str, Any]]:
    """Yield each BSDF, shape and emitter once, after its kind."""
    shapes = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    bsdfs = {str(id(b)): b for b in (shape.bsdf() for shape in shapes) if b is not None}
    for word, plugins in (("BSDF", bsdfs.values()), ("shape", shapes), ("emitter", scene.emitters())):
        yield from ((f"{word} {class_name(plugin)}", plugin) for plugin in plugins)


# ------------------------------------------------- The hunt -----------------------------------------------


def _hunt(source: Any, quick: bool, seed: int) -> Fault | None:
    """Render, and narrow the film down to a crop that still shows a pixel that is not finite."""
    spp = 4 if quick else 32
    bad = _bad(source, spp, seed)
    if not bad.any():
        return None
    left, top = map(int, np.array(source.sensor.film().crop_offset()))
    y, x = (int(axis[0]) for axis in np.nonzero(bad))
    width, height = 1, 1
    while width < bad.shape[1] or height < bad.shape[0]:
        crop, count = (left + x // width * width, top + y // height * height, width, height), 16
        most = max(MOST_SAMPLES // (width * height), 16)
        with _cropped(source.sensor, crop):
            while count <= most and not _bad(source, count, seed).any():
                count *= 8
        if count <= most:
            break
        width, height = min(2 * width, bad.shape[1]), min(2 * height, bad.shape[0])
    else:
        crop, count = (left, top, bad.shape[1], bad.shape[0]), spp
    with _cropped(source.sensor, crop):
        culprit = _culprit(source, count, seed)
    return Fault(int(bad.sum()), crop, count, culprit)


def _bad(source: Any, spp: int, seed: int) -> np.ndarray:
    """Return which pixels are not finite. [H, W]"""
    picture = mi.render(source.scene, integrator=source.integrator, sensor=source.sensor, spp=spp, seed=seed)
    return ~np.isfinite(np.array(picture)).all(axis=-1)


@contextmanager
def _cropped(sensor: Any, crop: tuple[int, int, int, int]) -> Iterator[None]:
    """Crop the film for a while."""
    params = mi.traverse(sensor)
    before = {key: type(params[key])(params[key]) for key in ("film.crop_size", "film.crop_offset")}

    def change(size: Any, offset: Any) -> None:
        params["film.crop_size"], params["film.crop_offset"] = size, offset
        params.update()
        sensor.parameters_changed()

    change(list(crop[2:]), list(crop[:2]))
    try:
        yield
    finally:
        change(before["film.crop_size"], before["film.crop_offset"])


def _culprit(source: Any, spp: int, seed: int) -> str:
    """Follow paths through the crop, and name the object whose own numbers are first not finite."""
    if mi.variant().startswith("scalar"):
        return "something that scalar variants do not reveal: check it in a vectorised one"
    counts: Counter[str] = Counter()
    pixels = int(np.prod(np.array(source.sensor.film().crop_size())))
    for attempt in range(8):
        counts.update(_follow(source, min(max(spp, 2**12) * pixels, 2**20), seed + attempt))
        if counts:
            return counts.most_common(1)[0][0]
    return "no object's own numbers: by the integrator, or a sum that overflows"


def _follow(source: Any, count: int, seed: int) -> Counter[str]:
    """Trace one batch of paths; return how often each object was the first to give an infinity or NaN."""
    scene, ctx, rng = source.scene, mi.BSDFContext(), mi.PCG32(count, initstate=seed)
    active, draw = mi.Bool(True), rng.next_float32
    # the unit square covers the crop of a cropped film
    ray, _ = source.sensor.sample_ray(draw(), draw(), mi.Point2f(draw(), draw()), mi.Point2f(draw(), draw()))
    counts: Counter[str] = Counter()

    def note(bad: Any, name: Callable[[Any], str], pointers: Any, plugins: Iterable[Any]) -> Any:
        bad &= active
        if dr.any(bad):
            for plugin in plugins:
                counts[name(plugin)] += int(dr.count(bad & (pointers == type(pointers)(plugin)))[0])
        return ~bad

    shapes, emitters = scene.shapes(), scene.emitters()

    for _ in range(DEPTH):
        si = scene.ray_intersect(ray, active)
        met = si.emitter(scene, active)
        active &= note(not_finite(met.eval(si, active)), _emitter, met, emitters)
        active &= si.is_valid()
        bad = not_finite(si.p, si.n, si.sh_frame.n, si.uv)
        active &= note(bad, lambda shape: f"the shape {_name(shape)}", si.shape, shapes)
        ds, light = scene.sample_emitter_direction(si, mi.Point2f(draw(), draw()), True, active)
        active &= note(not_finite(light), _emitter, ds.emitter, emitters)
        bsdf = si.bsdf(ray)
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active & (ds.pdf > 0))
        bs, weight = bsdf.sample(ctx, si, draw(), mi.Point2f(draw(), draw()), active)
        lit = dr.any(mi.unpolarized_spectrum(weight) != 0)
        bad = not_finite(mi.unpolarized_spectrum(value), pdf, mi.unpolarized_spectrum(weight))
        bad |= lit & not_finite(bs.wo, bs.pdf)
        active &= lit & note(bad, lambda s: f"the BSDF {_name(s.bsdf())}, on {_name(s)}", si.shape, shapes)
        ray = si.spawn_ray(si.to_world(bs.wo))
        dr.eval(ray, active, rng)
        if not dr.any(active):
            break
    return +counts


def _emitter(emitter: Any) -> str:
    return f"the emitter {_name(emitter)}"


def _name(plugin: Any) -> str:
    return f"{class_name(plugin)} {plugin.id()!r}"
