"""``check_scene``: every BSDF, shape and emitter of a scene by its laws, and a hunt for NaN pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from html import escape
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
from mrt_mitsuba.validation.checks.law import TITLE, Check, class_name, examine
from mrt_mitsuba.validation.checks.probe import not_finite
from mrt_mitsuba.validation.checks.shape import check_shape
from mrt_mitsuba.validation.tools import report
from mrt_mitsuba.validation.tools.study import Study

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
        report.save(folder, *studies, title=f"{TITLE}: {self.name}")

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
    kinds, instances = _plugins(source.scene)
    laws: dict[str, Callable[..., Check]]
    laws = {"BSDF": check_bsdf, "shape": check_shape, "emitter": partial(_check_emitter, source.scene)}
    found: dict[str, Check] = {}
    chosen = {kind: range(0, len(alike), max(len(alike) // ALIKE, 1)) for kind, alike in kinds.items()}
    with (progress or Progress()).stage("Laws", sum(map(len, chosen.values()))) as advance:
        for kind, number in ((kind, number) for kind, numbers in chosen.items() for number in numbers):
            name = f"{kind} {kinds[kind][number].id() or number}"
            name = name if name not in found else f"{name} ({number})"
            check = laws[kind.split()[0]](kinds[kind][number], quick=quick, seed=seed)
            found[name] = replace(check, subject=name)
            advance(1)
    more = {kind: len(alike) - len(chosen[kind]) for kind, alike in kinds.items()}
    left_out = [f"{n} more of {kind} are like those that were checked" for kind, n in more.items() if n]
    if instances:
        left_out.append(f"{instances} instances are not checked: give a dict of one with its group")
    return SceneCheck(source.name, found, _hunt(source, quick, seed), tuple(left_out))


def _plugins(scene: Any) -> tuple[dict[str, list[Any]], int]:
    """Return the BSDFs, shapes and emitters of a scene, each once, by kind, and how many instances it has."""
    shapes = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    bsdfs = {str(id(b)): b for b in (shape.bsdf() for shape in shapes) if b is not None}.values()
    kinds: dict[str, list[Any]] = {}
    for word, plugins in (("BSDF", bsdfs), ("shape", shapes), ("emitter", scene.emitters())):
        for plugin in plugins:
            kinds.setdefault(f"{word} {class_name(plugin)}", []).append(plugin)
    return kinds, len(scene.shapes()) - len(shapes)


def _check_emitter(scene: Any, plugin: Any, *, quick: bool, seed: int) -> Check:
    return examine(partial(emitter.Case, scene), plugin, emitter.LAWS, quick=quick, seed=seed)


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

    def sound(name: Callable[[Any], str], pointers: Any, *values: Any) -> Any:
        """Return where values are finite, and count those that are not for the objects of ``pointers``."""
        bad, plugins = active & not_finite(*values), scene.emitters() if name is _emitter else scene.shapes()
        for plugin in plugins if dr.any(bad) else ():
            counts[name(plugin)] += int(dr.count(bad & (pointers == type(pointers)(plugin)))[0])
        return ~bad

    for _ in range(DEPTH):
        si = scene.ray_intersect(ray, active)
        met = si.emitter(scene, active)
        active &= sound(_emitter, met, met.eval(si, active))
        active &= si.is_valid()
        active &= sound(lambda shape: f"the shape {_name(shape)}", si.shape, si.p, si.n, si.sh_frame.n, si.uv)
        ds, light = scene.sample_emitter_direction(si, mi.Point2f(draw(), draw()), True, active)
        active &= sound(_emitter, ds.emitter, light)
        bsdf = si.bsdf(ray)
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active & (ds.pdf > 0))
        bs, weight = bsdf.sample(ctx, si, draw(), mi.Point2f(draw(), draw()), active)
        value, weight = mi.unpolarized_spectrum(value), mi.unpolarized_spectrum(weight)
        lit = dr.any(weight != 0)
        drawn = dr.select(lit, bs.wo, 0), dr.select(lit, bs.pdf, 0)
        active &= lit & sound(
            lambda s: f"the BSDF {_name(s.bsdf())}, on {_name(s)}", si.shape, value, pdf, weight, *drawn
        )
        ray = si.spawn_ray(si.to_world(bs.wo))
        dr.eval(ray, active, rng)
        if not dr.any(active):
            break
    return +counts


def _emitter(emitter: Any) -> str:
    return f"the emitter {_name(emitter)}"


def _name(plugin: Any) -> str:
    return f"{class_name(plugin)} {plugin.id()!r}"
