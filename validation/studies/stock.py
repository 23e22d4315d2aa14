"""Mitsuba against ours: direct light, gloss and mirrors, approximations, mistakes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.scene.shapes import torus
from mrt_mitsuba.validation.oracles.reference import camera_directions, reference_render
from mrt_mitsuba.validation.studies import approximations, mutations
from mrt_mitsuba.validation.tools.gallery import curves, gallery
from mrt_mitsuba.validation.tools.scenery import AT_CENTRES, camera, with_materials
from mrt_mitsuba.validation.tools.sensitivity import sensitivity
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Against Mitsuba's own integrators, lights and materials"

# Pixel by pixel, relative to 1 + value: a few dozen float32 roundings
DIRECT_TOLERANCE = 1e-5
# Pixels on the other side of an edge, or where Mitsuba's shadow rays start beyond what hides the light
DIRECT_SHARE = 1e-3

DISPLACEMENT = 1e-2  # pixels by which float32 may move a highlight of a small ball

# How smooth the surroundings are that the mirrors show: a few periods around the horizon
WAVES = 3


def run(study: Study, *, quick: bool) -> None:
    """Make all comparisons with what Mitsuba brings."""
    study.text(
        "Lattices are compared with Mitsuba's box filter in antialiasing, the blur with its thinlens camera "
        "in depth-of-field."
    )
    for part in PARTS:
        part(study, quick=quick)


# -------------------------------------------- Direct light only ---------------------------------------------


@dataclass(frozen=True)
class DirectComparison:
    """``mrt_whitted`` without bounces and clamp against ``direct``, under one stock light.

    ``error`` [H, W]: largest difference in a channel, relative to 1 + value. The others [H, W]: pixels where
    the stand-in of a plane has ended; where an outline or the edge of a shadow is within a hundredth of a
    pixel, or between the places where Mitsuba's shadow rays start and ours; and those whose own colour
    changes by more than the error within that hundredth, as in the highlights of smooth spheres.
    """

    ours: np.ndarray
    theirs: np.ndarray
    error: np.ndarray
    beyond: np.ndarray
    edge: np.ndarray
    steep: np.ndarray

    @property
    def off(self) -> np.ndarray:
        """Pixels [H, W] off by more than the tolerance, where there is something to compare."""
        return (self.error > DIRECT_TOLERANCE) & ~self.beyond

    @property
    def unexplained(self) -> int:
        """Pixels off for no reason."""
        return int(np.sum(self.off & ~self.edge & ~self.steep))

    @property
    def seen(self) -> float:
        """Share of pixels that the light reaches, where there is something to compare."""
        return float(((self.ours > 0.05).any(axis=-1) & ~self.beyond).mean())

    def figures(self) -> dict[str, float]:
        """Return what the study's table has."""
        near, off = self.error[~self.beyond], self.off
        return {
            "median": float(np.median(near)),
            "99.9 %": float(np.quantile(near, 0.999)),
            "off by > 1e-5": int(off.sum()),
            "on an edge": int((off & self.edge).sum()),
            "in a steep highlight": int((off & ~self.edge & self.steep).sum()),
            "beyond the stand-in": int(self.beyond.sum()),
            "without a reason": self.unexplained,
        }


def compare_direct(scene: Scene, light: int, *, width: int, height: int) -> DirectComparison:
    """Render a scene with one of its lights, as a stock point light with falloff, by ``mrt_whitted`` and by
    ``direct``.

    One light at a time, since ``direct`` picks one at random.
    """
    scene = dataclasses.replace(scene, lights=(scene.lights[light],))
    size: dict[str, Any] = {"width": width, "height": height}
    nodes = mrt.scene_dict(scene, fresnel="dielectric", **size)
    del nodes["sky"]  # direct would light the scene with it
    nodes["light_0"] = mrt.scene_dict(scene, flavor="stock", **size)["light_0"]
    loaded = mi.load_dict(nodes)
    whitted = {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
    ours, theirs = (
        mrt.render(loaded, integrator=integrator, **AT_CENTRES).image for integrator in (whitted, "direct")
    )
    exact: dict[str, Any] = {"max_depth": 1, "clamp": False, **size}
    found = sensitivity(scene, displacement=DISPLACEMENT, **exact)
    moved = reference_render(scene, start="mitsuba", **exact)
    error = (np.abs(ours - theirs) / (1 + theirs)).max(axis=-1)
    # The tracer's light has no falloff; relative to the colour, that makes no difference to so small a step
    steep = error <= found.spread / (1 + found.reference.image.max(axis=-1))
    edge = found.silhouette | found.shadow | (moved.lights != found.reference.lights)
    return DirectComparison(ours, theirs, error, _beyond_stand_in(scene, found.reference), edge, steep)


def _beyond_stand_in(scene: Scene, reference: Any, extent: float = 100.0) -> np.ndarray:
    """Return where a ray meets a plane outside the circle in its stand-in; ``extent`` is the default of
    ``mrt_plane``."""
    height, width = reference.depth.shape
    rows, columns = np.mgrid[:height, :width]
    d = camera_directions(scene.camera, width, height, columns.ravel() + 0.5, height - rows.ravel() - 0.5)
    hit = np.isfinite(reference.depth)
    p = scene.camera.position + np.where(hit, reference.depth, 0)[..., None] * d.reshape(height, width, 3)
    beyond = np.zeros((height, width), bool)
    for i, plane in enumerate(scene.planes):
        foot = -plane.distance * np.array(plane.normal) / np.linalg.norm(plane.normal)
        outside = np.linalg.norm(p - foot, axis=-1) > extent / 2
        beyond |= outside & (reference.object_id == len(scene.spheres) + i)
    return beyond


def direct(study: Study, *, quick: bool) -> None:
    """Compare direct light in the report's scenes, light by light."""
    size: dict[str, Any] = {"width": 120, "height": 90} if quick else {"width": 320, "height": 240}
    rows: list[dict[str, Any]] = []
    numbers = (0, 1, 2, 3) if quick else (0, 1, 2, 3, 4)
    for number in study.each("Direct light", numbers):
        scene = report_scene(number)
        found = [compare_direct(scene, light, **size) for light in range(len(scene.lights))]
        rows += [{"scene": number, "light": light, **c.figures()} for light, c in enumerate(found)]
        name, share = f"direct light, scene {number}", max(c.off.mean() for c in found)
        median, why = max(c.figures()["median"] for c in found), "least fault: 1 in a million of the light"
        study.at_most(f"{name}: median difference", median, 3e-7, why)
        why = "edges and what hides lights; measured 7 in 76,800, and 36 among the 600 spheres of scene 4"
        study.at_most(f"{name}: share of pixels off by > 1e-5", share, DIRECT_SHARE, why)
        seen, why = max(c.seen for c in found), "else there is nothing to compare"
        study.at_least(f"{name}: share of pixels that one of the lights reaches", seen, 0.05, why)
        why = "each is held to an edge, a steep highlight or the start of Mitsuba's shadow rays"
        study.at_most(f"{name}: of these without a reason", sum(c.unexplained for c in found), 0, why)
    note = (
        "Stock point light, no sky. Differences relative to 1 + value. To direct, a plane is a square of "
        "side 100: beyond, there is nothing. Mitsuba's shadow rays start 9e-5 (1 + |p|) off their surface, "
        "ours a few roundings: edges of shadows differ where the tracer says that this matters."
    )
    title = "mrt_whitted without bounces and clamp against direct, light by light"
    study.records("direct", title, rows, note)


# ------------------------------------- The mirror as the limit of gloss -------------------------------------


@dataclass(frozen=True)
class GlossLimit:
    """How far the glossy reflection of ``path`` is from the mirror term of ``mrt_whitted``, per alpha."""

    alphas: Sequence[float]
    errors: Sequence[float]  # mean absolute difference over the mean of the mirror
    pictures: Sequence[np.ndarray]  # the mirror, then the gloss of each alpha
    slope: float  # of log error over log alpha


def gloss_limit(alphas: Sequence[float], *, width: int, height: int, spp: int, seed: int = 0) -> GlossLimit:
    """Render four black, shiny spheres in a smooth environment, as mirrors and with gloss."""
    whitted = {"type": "mrt_whitted", "min_contribution": 0.0}
    nodes = _shiny_spheres(alphas[0], width, height)
    mirror = mrt.render(nodes, **AT_CENTRES, layers=["depth"], integrator=whitted)
    sphere = np.isfinite(mirror.layers["depth.Z"])
    pictures, errors = [mirror.image], []
    for i, alpha in enumerate(alphas):
        path = {"type": "path", "max_depth": 8, "rr_depth": 100}
        spheres = _shiny_spheres(alpha, width, height)
        gloss = mrt.render(spheres, **AT_CENTRES, spp=spp, seed=seed + i, integrator=path).image
        pictures.append(gloss)
        errors.append(float(np.abs(gloss - mirror.image)[sphere].mean() / mirror.image[sphere].mean()))
    slope = float(np.polyfit(np.log(alphas), np.log(errors), 1)[0])
    return GlossLimit(tuple(alphas), tuple(errors), pictures, slope)


def _shiny_spheres(alpha: float, width: int, height: int) -> dict[str, Any]:
    scene = report_scene(0)
    black: dict[str, Any] = {"alpha": alpha, "ior": 3.0, "diffuse": (0, 0, 0), "specular": (1, 1, 1)}
    scene = with_materials(scene, lambda m: dataclasses.replace(m, **black))
    scene = dataclasses.replace(scene, planes=(), lights=())
    nodes = mrt.scene_dict(scene, width=width, height=height, fresnel="dielectric")
    return {**nodes, "sky": {"type": "envmap", "bitmap": mi.Bitmap(_waves())}}


def gloss(study: Study, *, quick: bool) -> None:
    """Hold gloss of ever less roughness to the mirror."""
    alphas = (0.3, 0.1, 0.03, 0.01, 0.003) if quick else (0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
    size: dict[str, Any] = (
        {"width": 64, "height": 48, "spp": 64} if quick else {"width": 160, "height": 120, "spp": 512}
    )
    found = gloss_limit(alphas, **size)
    what, why = f"gloss of alpha {alphas[0]:g} against the mirror term", "else there is nothing to compare"
    study.at_least(what, found.errors[0], 0.05, why)
    what = f"gloss of alpha {alphas[-1]:g} against the mirror term"
    study.at_most(what, found.errors[-1], 2e-3, "what is left is noise, as wide as the lobe")
    why = "blur itself has slope 2, noise slope 1"
    study.at_least("slope of that difference over alpha", found.slope, 0.9, why)
    title, error = "Glossy reflection of path against the mirror term", "mean relative difference"
    study.table("gloss", title, ["alpha", error], list(zip(found.alphas, found.errors, strict=True)))
    line = {f"slope {found.slope:.2f}": (found.alphas, found.errors)}
    caption = "Difference between path with mrt_bsdf and the mirror rays of mrt_whitted."
    study.plot("gloss", "Gloss becomes a mirror", curves(line, "alpha", error, ticks=alphas), caption)
    names = ["mirror of mrt_whitted", *(f"path, alpha {alpha:g}" for alpha in alphas)]
    figure = gallery(dict(zip(names, found.pictures, strict=True)), columns=3)
    study.plot("gloss_pictures", "Gloss, and the mirror", figure)


# ---------------------------------- Mitsuba's own materials and surfaces -----------------------------------


def materials(study: Study, *, quick: bool) -> None:
    """Check what the report does not have: Mitsuba's integrators draw it alike, ray by ray."""
    for name, (shapes, theirs, spp, limit) in _stock_scenes().items():
        sensor = camera([0, -1, 5], [0, 0, 0], [0, 1, 0], 64, 48, fov=40)
        nodes = {"type": "scene", "sensor": sensor, **shapes}
        ours = {"type": "mrt_whitted", "clamp": False, "bounce_budget": "plain", "max_depth": 5}
        images = [
            mrt.render(mi.load_dict(nodes), integrator=i, spp=spp, seed=3, **AT_CENTRES).image
            for i in (ours, theirs)
        ]
        off = np.abs(images[0] - images[1]).max(axis=-1) > limit * (1 + images[1].max(axis=-1))
        why = f"by {limit:g} relative to 1 + value; measured 3 of 3072, at edges of what a mirror shows"
        study.at_most(f"{name}: share of pixels off", off.mean(), 2e-3, why)
        seen, why = (images[1] > 1e-3).any(axis=-1).mean(), "a black picture would be no comparison"
        study.at_least(f"{name}: share of pixels to compare", seen, 0.1, why)


def _stock_scenes() -> dict[str, tuple[dict[str, Any], dict[str, Any], int, float]]:
    """Return shapes, Mitsuba's integrator, rays a pixel, and the difference that counts, by name."""
    turn = mi.ScalarTransform4f().translate([0, 1, 0]).rotate([1, 0, 0], -90).scale(3)  # seen from below
    paper = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    lamp = {"type": "point", "position": [1, -2, 1], "intensity": 10.0}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(_waves()), "scale": 1.0}
    bulb = {"type": "sphere", "center": [0, -2, 2], "radius": 0.1}
    bulb["emitter"] = {"type": "area", "radiance": 100.0}
    direct: dict[str, Any] = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
    kinds: dict[str, dict[str, Any]] = {
        "mrt_cone": {"apex": [-1.2, 1, 0], "base_center": [-1.2, 0, 0], "radius": 0.7},
        "mrt_plane": {"normal": [0, 0, 1], "distance": 2.0},
        "mrt_group": {"numbers": mi.Bitmap(np.array([[-1, -1, 0, 0.5]], np.float32))},
    }
    turned = {name: {"type": name, **numbers, "flip_normals": True} for name, numbers in kinds.items()}
    lit = {"ball": {"type": "sphere", "center": [1, 0, 0]}, "lamp": lamp}
    height = {"type": "bitmap", "bitmap": mi.Bitmap(0.5 * _waves())}
    bumps = {"type": "bumpmap", "texture": height, "scale": 0.4}
    return {
        "two-sided paper from behind": ({"paper": {"type": "rectangle", "to_world": turn, "bsdf": paper},
                                         "lamp": lamp}, direct, 1, 1e-5),
        "a smooth mirror": ({"mirror": {**_smooth_ball(), "bsdf": {"type": "conductor"}}, "sky": sky},
                            {"type": "path", "max_depth": 6, "rr_depth": 100}, 1, 5e-3),
        "a bumpy ball": ({"ball": {"type": "sphere", "bsdf": {**bumps, "bsdf": {"type": "diffuse"}}},
                          "lamp": lamp}, direct, 1, 1e-4),
        "shapes turned inside out": ({**lit, **turned}, direct, 1, 1e-4),
        "an area light": ({"ball": {"type": "sphere", "bsdf": {"type": "diffuse"}}, "bulb": bulb},
                          direct, 16, 1e-5),
    }  # fmt: skip


def _waves() -> np.ndarray:
    y, x = np.mgrid[:64, :128] / 64 * np.pi
    waves = [1 + 0.8 * np.sin(WAVES * x + phase) * np.sin(y) for phase in (0, 2, 4)]
    return np.stack(waves, axis=-1).astype(np.float32)


def _smooth_ball() -> dict[str, Any]:
    """Return a coarse ball whose corners have the normals of a sphere."""
    mesh = torus((0, 0, 0), 0.9, 0.5, report_scene(0).spheres[0].material, rings=16, sides=8)
    around = mesh.vertices * [1, 1, 0]
    middle = 0.9 * around / np.linalg.norm(around, axis=1, keepdims=True)
    arrays = {"positions": mesh.vertices, "faces": mesh.faces, "normals": mesh.vertices - middle}
    bitmaps = {name: mi.Bitmap(np.ascontiguousarray(a[np.newaxis])) for name, a in arrays.items()}
    return {"type": "mrt_mesh", **bitmaps}


PARTS = (direct, gloss, materials, approximations.run, mutations.run)
