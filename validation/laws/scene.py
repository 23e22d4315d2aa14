"""``check_scene``: every BSDF, shape and emitter of a scene by its laws, and a hunt for NaN pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
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
from mrt_mitsuba.scene.open import Source, open_scene
from mrt_mitsuba.validation.laws.bsdf import check_bsdf
from mrt_mitsuba.validation.laws.emitter import check_emitter
from mrt_mitsuba.validation.laws.examine import Check
from mrt_mitsuba.validation.laws.probe import not_finite
from mrt_mitsuba.validation.laws.shape import check_shape
from mrt_mitsuba.validation.laws.subject import class_name
from mrt_mitsuba.validation.page import save_report
from mrt_mitsuba.validation.study import Study

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
        """Write the page (``index.html``), ``summary.json`` and CSV files. Raises ``OutputError``."""
        picture = Study("picture", "picture")
        bad = self.fault.pixels if self.fault else 0
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
    lights = partial(check_emitter, scene=source.scene)
    check_of: dict[str, Callable[..., Check]]
    check_of = {"BSDF": check_bsdf, "shape": check_shape, "emitter": lights}
    checks = {}
    left_out = []
    chosen = {kind: range(0, len(alike), max(len(alike) // ALIKE, 1)) for kind, alike in kinds.items()}
    with (progress or Progress()).stage("Laws", sum(map(len, chosen.values()))) as advance:
        for kind, alike in kinds.items():
            for number in chosen[kind]:
                plugin = alike[number]
                name = f"{kind} {plugin.id() or number}"
                if name in checks:
                    name = f"{name} ({number})"
                check = check_of[kind.split()[0]](plugin, quick=quick, seed=seed)
                checks[name] = replace(check, subject=name)
                advance(1)
            more = len(alike) - len(chosen[kind])
            if more:
                left_out.append(f"{more} more of {kind} are like those that were checked")
    instances = sum(shape.class_name() == "Instance" for shape in source.scene.shapes())
    if instances:
        left_out.append(f"{instances} instances are not checked: give a dict of one with its group")
    return SceneCheck(source.name, checks, _hunt(source, quick, seed), tuple(left_out))


def _plugins(scene: mi.Scene) -> dict[str, list[mi.Object]]:
    """The BSDFs, shapes and emitters of a scene, each once, by kind, but for instances."""
    shapes = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    bsdfs = {id(bsdf): bsdf for bsdf in (shape.bsdf() for shape in shapes) if bsdf is not None}
    kinds: dict[str, list[mi.Object]] = {}
    for word, plugins in (("BSDF", bsdfs.values()), ("shape", shapes), ("emitter", scene.emitters())):
        for plugin in plugins:
            kinds.setdefault(f"{word} {class_name(plugin)}", []).append(plugin)
    return kinds


# ------------------------------------------------- The hunt -----------------------------------------------


def _hunt(source: Source, quick: bool, seed: int) -> Fault | None:
    """Render, and look for a pixel that is not finite: alone if it then still is, else in the whole film."""
    spp = 4 if quick else 32
    bad = _bad(source, spp, seed)
    if not bad.any():
        return None
    left, top = source.sensor.film().crop_offset()
    y, x = np.argwhere(bad)[0]
    alone = int(left + x), int(top + y), 1, 1
    params = mi.traverse(source.sensor)
    crop = {"film.crop_size": alone[2:], "film.crop_offset": alone[:2]}
    before = {key: type(params[key])(params[key]) for key in crop}
    params.update(crop)
    try:
        for count in COUNTS:
            if _bad(source, count, seed).any():
                return Fault(bad.sum(), alone, count, _culprit(source, count, seed))
    finally:
        params.update(before)
    whole = int(left), int(top), *bad.shape[::-1]
    return Fault(bad.sum(), whole, spp, _culprit(source, spp, seed))


def _bad(source: Source, spp: int, seed: int) -> np.ndarray:
    """Which pixels are not finite. [H, W]"""
    picture = mi.render(source.scene, integrator=source.integrator, sensor=source.sensor, spp=spp, seed=seed)
    return ~np.isfinite(np.array(picture)).all(axis=-1)


def _culprit(source: Source, spp: int, seed: int) -> str:
    """Follow paths through the crop, and name the object whose own numbers are first not finite."""
    if mi.variant().startswith("scalar"):
        return "something that scalar variants do not reveal: check it in a vectorised one"
    pixels = int(np.prod(np.array(source.sensor.film().crop_size())))
    for attempt in range(8):
        counts = _follow(source, min(max(spp, 2**12) * pixels, 2**20), seed + attempt)
        if counts:
            return counts.most_common(1)[0][0]
    return "no object's own numbers: by the integrator, or a sum that overflows"


def _follow(source: Source, count: int, seed: int) -> Counter[str]:
    """How often each object was the first to give an infinity or NaN, in one batch of paths."""
    scene = source.scene
    ctx = mi.BSDFContext()
    counts: Counter[str] = Counter()
    active = mi.Bool(True)
    rng = mi.PCG32(count, initstate=seed)
    draw = rng.next_float32
    # the unit square covers the crop of a cropped film
    ray, _ = source.sensor.sample_ray(draw(), draw(), mi.Point2f(draw(), draw()), mi.Point2f(draw(), draw()))

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
