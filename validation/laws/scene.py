"""``check_scene``: every BSDF, shape and emitter of a scene by its laws, and a search for bad pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from . import page
from .bsdf import check_bsdf
from .case import class_name
from .emitter import check_emitter
from .page import Check
from .probe import not_finite
from .shape import check_shape

Plugin = tuple[str, int, mi.Object]  # its kind, and its number among those of the kind
MAX_PER_KIND = 6  # plugins of one kind that are checked, spread over all
MAX_BOUNCES = 12  # bounces that the search follows
COUNTS = (16, 128, 1024, 8192)  # samples of one pixel, to see a fault again


@dataclass(frozen=True)
class Shot:
    """What is rendered to look for pixels that are not finite."""

    scene: mi.Scene
    integrator: mi.Integrator
    sensor: mi.Sensor


@dataclass(frozen=True)
class PixelFault:
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
    fault: PixelFault | None
    left_out: tuple[str, ...] = ()

    @property
    def failed(self) -> list[str]:
        """What does not hold, as "name: law", and "pixels" where some are not finite."""
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
        """Write a page (``index.html``), ``summary.json`` and ``laws.csv``. Raises ``OSError``."""
        page.write(folder, page.files(self.checks, f"Laws of plugins: {self.name}", self._remarks()))

    def _repr_html_(self) -> str:
        return page.frame(self.checks, f"Laws of plugins: {self.name}", self._remarks())

    def _remarks(self) -> list[str]:
        return [str(self.fault or "every pixel is finite"), *self.left_out]


def check_scene(
    scene: mi.Scene,
    *,
    integrator: mi.Integrator | None = None,
    sensor: mi.Sensor | None = None,
    name: str = "scene",
    quick: bool = False,
    seed: int = 0,
    progress: Callable[[Sequence[Plugin]], Iterable[Plugin]] = iter,
) -> SceneCheck:
    """Check every BSDF, shape and emitter of a loaded scene, and look for pixels that are not finite.

    ``integrator`` and ``sensor`` default to the scene's own. Only some of many plugins of one kind are
    checked. ``progress`` iterates over them, as ``tqdm.tqdm`` does.
    """
    kinds = _plugins(scene)
    lights = partial(check_emitter, scene=scene)
    check_of: dict[str, Callable[..., Check]]
    check_of = {"BSDF": check_bsdf, "shape": check_shape, "emitter": lights}
    chosen = []
    left_out = []
    for kind, alike in kinds.items():
        some = range(0, len(alike), max(len(alike) // MAX_PER_KIND, 1))
        chosen += [(kind, number, alike[number]) for number in some]
        if len(alike) > len(some):
            left_out.append(f"{len(alike) - len(some)} more of {kind} are like those that were checked")
    checks: dict[str, Check] = {}
    for kind, number, plugin in progress(chosen):
        title = f"{kind} {plugin.id() or number}"
        if title in checks:
            title = f"{title} ({number})"
        check = check_of[kind.split()[0]](plugin, quick=quick, seed=seed)
        checks[title] = replace(check, subject=title)
    instances = sum(shape.class_name() == "Instance" for shape in scene.shapes())
    if instances:
        left_out.append(f"{instances} instances are not checked: give a dict of one with its group")
    shot = Shot(scene, integrator or scene.integrator(), sensor or scene.sensors()[0])
    return SceneCheck(name, checks, _hunt(shot, quick, seed), tuple(left_out))


def _plugins(scene: mi.Scene) -> dict[str, list[mi.Object]]:
    """The BSDFs, shapes and emitters of a scene, each once, by kind, but for instances."""
    shapes = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    bsdfs = {id(bsdf): bsdf for bsdf in (shape.bsdf() for shape in shapes) if bsdf is not None}
    kinds: dict[str, list[mi.Object]] = {}
    for word, plugins in (("BSDF", bsdfs.values()), ("shape", shapes), ("emitter", scene.emitters())):
        for plugin in plugins:
            kinds.setdefault(f"{word} {class_name(plugin)}", []).append(plugin)
    return kinds


# ------------------------------------- The search for bad pixels -------------------------------------


def _hunt(shot: Shot, quick: bool, seed: int) -> PixelFault | None:
    """Render, and look for a pixel that is not finite: alone if it then still is, else in the whole film."""
    spp = 4 if quick else 32
    bad = _bad(shot, spp, seed)
    if not bad.any():
        return None
    left, top = shot.sensor.film().crop_offset()
    y, x = np.argwhere(bad)[0]
    alone = int(left + x), int(top + y), 1, 1
    params = mi.traverse(shot.sensor)
    crop = {"film.crop_size": alone[2:], "film.crop_offset": alone[:2]}
    before = {key: type(params[key])(params[key]) for key in crop}
    params.update(crop)
    try:
        for count in COUNTS:
            if _bad(shot, count, seed).any():
                return PixelFault(bad.sum(), alone, count, _culprit(shot, count, seed))
    finally:
        params.update(before)
    whole = int(left), int(top), *bad.shape[::-1]
    return PixelFault(bad.sum(), whole, spp, _culprit(shot, spp, seed))


def _bad(shot: Shot, spp: int, seed: int) -> np.ndarray:
    """Which pixels are not finite. [H, W]"""
    picture = mi.render(shot.scene, integrator=shot.integrator, sensor=shot.sensor, spp=spp, seed=seed)
    return ~np.isfinite(np.array(picture)).all(axis=-1)


def _culprit(shot: Shot, spp: int, seed: int) -> str:
    """Follow paths through the crop, and name the object whose own numbers are first not finite."""
    if mi.variant().startswith("scalar"):
        return "something that scalar variants do not reveal: check it in a vectorised one"
    pixels = int(np.prod(np.array(shot.sensor.film().crop_size())))
    for attempt in range(8):
        counts = _follow(shot, min(max(spp, 2**12) * pixels, 2**20), seed + attempt)
        if counts:
            return counts.most_common(1)[0][0]
    return "no object's own numbers: by the integrator, or a sum that overflows"


def _follow(shot: Shot, count: int, seed: int) -> Counter[str]:
    """How often each object was the first to give an infinity or NaN, in one batch of paths."""
    scene = shot.scene
    ctx = mi.BSDFContext()
    counts: Counter[str] = Counter()
    active = mi.Bool(True)
    rng = mi.PCG32(count, initstate=seed)
    draw = rng.next_float32
    # the unit square covers the crop of a cropped film
    ray, _ = shot.sensor.sample_ray(draw(), draw(), mi.Point2f(draw(), draw()), mi.Point2f(draw(), draw()))

    def sound(what: str, pointers: mi.Object, *values: mi.Float | mi.Spectrum) -> mi.Mask:
        """Where values are finite; those that are not are counted for the objects of ``pointers``."""
        bad = active & not_finite(*values)
        if not dr.any(bad):
            return ~bad
        for one in scene.emitters() if what == "emitter" else scene.shapes():
            name = f"{_name(one.bsdf())}, on {_name(one)}" if what == "BSDF" else _name(one)
            here = pointers == type(pointers)(one)
            counts[f"the {what} {name}"] += int(dr.count(bad & here)[0])
        return ~bad

    for _ in range(MAX_BOUNCES):
        si = scene.ray_intersect(ray, active)
        met = si.emitter(scene, active)
        active &= sound("emitter", met, met.eval(si, active))
        active &= si.is_valid()
        active &= sound("shape", si.shape, si.p, si.n, si.sh_frame.n, si.uv)
        ds, light = scene.sample_emitter_direction(si, mi.Point2f(draw(), draw()), True, active)
        active &= sound("emitter", ds.emitter, light)
        bsdf = si.bsdf(ray)
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active & (ds.pdf > 0))
        value = mi.unpolarized_spectrum(value)
        bs, weight = bsdf.sample(ctx, si, draw(), mi.Point2f(draw(), draw()), active)
        weight = mi.unpolarized_spectrum(weight)
        lit = dr.any(weight != 0)
        wo = dr.select(lit, bs.wo, 0)
        stated = dr.select(lit, bs.pdf, 0)
        active &= lit & sound("BSDF", si.shape, value, pdf, weight, wo, stated)
        ray = si.spawn_ray(si.to_world(bs.wo))
        dr.eval(ray, active, rng)
        if not dr.any(active):
            break
    return +counts


def _name(plugin: mi.Object) -> str:
    return f"{class_name(plugin)} {plugin.id()!r}"
