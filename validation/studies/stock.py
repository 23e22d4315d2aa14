"""Mitsuba against ours: direct light, gloss and mirrors, materials, meshes, and mistakes made on purpose."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Cone, Material, Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import Axial, camera_directions, reference_render, sensitivity
from mrt_mitsuba.validation.tools.image_tests import compare
from mrt_mitsuba.validation.tools.scenery import AT_CENTRES, camera, rays, with_materials
from mrt_mitsuba.validation.tools.study import Study

TITLE = "Against Mitsuba's own integrators, lights, materials and meshes"

# Pixel by pixel, relative to 1 + value: a few dozen float32 roundings
DIRECT_TOLERANCE = 1e-5
# Pixels on the other side of an edge, or where Mitsuba's shadow rays start beyond what hides the light
DIRECT_SHARE = 1e-3
DISPLACEMENT = 1e-2  # pixels by which float32 may move a highlight of a small ball
WAVES = 3  # periods around the horizon of what mirrors show: smooth
PATH = {"type": "path", "max_depth": 4}
RENDERS = 8  # of which a mean and its variance are taken
# Probability that a comparison calls equal pictures different; seeds are fixed, so it stays passed
LEVEL = 1e-3

Nodes = dict[str, Any]


def run(study: Study, *, quick: bool) -> None:
    """Make all comparisons with what Mitsuba brings."""
    study.text(
        "Lattices are compared with Mitsuba's box filter in antialiasing, the blur with its thinlens camera "
        "in depth-of-field."
    )
    for part in PARTS:
        part(study, quick=quick)


# -------------------------------------------- Direct light only ---------------------------------------------


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
    """Compare direct light in the report's scenes, one light at a time, since ``direct`` picks one at random.

    The light is a stock point light with falloff. Pixels may differ on an edge: where an outline or the edge
    of a shadow is within a hundredth of a pixel, or between where Mitsuba's shadow rays start and where ours
    do; and in a steep highlight, where the colour changes by more than the error within that hundredth.
    """
    size: dict[str, Any] = {"width": 120, "height": 90} if quick else {"width": 320, "height": 240}
    whitted = {"type": "mrt_whitted", "max_depth": 1, "clamp": False, "min_contribution": 0.0}
    exact: dict[str, Any] = {"max_depth": 1, "clamp": False, **size}
    rows: list[dict[str, Any]] = []
    for number in study.each("Direct light", (0, 1, 2, 3) if quick else (0, 1, 2, 3, 4)):
        whole, of_scene, seen = report_scene(number), [], 0.0
        for light, lamp in enumerate(whole.lights):
            scene = dataclasses.replace(whole, lights=(lamp,))
            nodes = mrt.scene_dict(scene, fresnel="dielectric", **size)
            del nodes["sky"]  # direct would light the scene with it
            nodes["light_0"] = mrt.scene_dict(scene, flavor="stock", **size)["light_0"]
            loaded = mi.load_dict(nodes)
            ours, theirs = (mrt.render(loaded, integrator=i, **AT_CENTRES).image for i in (whitted, "direct"))
            error = (np.abs(ours - theirs) / (1 + theirs)).max(axis=-1)
            found = sensitivity(scene, displacement=DISPLACEMENT, **exact)
            truth, moved = found.reference, reference_render(scene, start="mitsuba", **exact)
            # The tracer's light has no falloff; relative to the colour, so small a step does not feel it
            steep = error <= found.spread / (1 + truth.image.max(axis=-1))
            edge = found.silhouette | found.shadow | (moved.lights != truth.lights)
            near = ~_beyond_stand_in(scene, truth)
            off = (error > DIRECT_TOLERANCE) & near
            seen = max(seen, ((ours > 0.05).any(axis=-1) & near).mean())
            figures = {
                "median": float(np.median(error[near])),
                "99.9 %": float(np.quantile(error[near], 0.999)),
                "off by > 1e-5": int(off.sum()),
                "on an edge": int((off & edge).sum()),
                "in a steep highlight": int((off & ~edge & steep).sum()),
                "beyond the stand-in": int((~near).sum()),
                "without a reason": int((off & ~edge & ~steep).sum()),
            }
            of_scene.append({"scene": number, "light": light, **figures})
        rows += of_scene
        name, pixels = f"direct light, scene {number}", size["width"] * size["height"]
        median, why = max(r["median"] for r in of_scene), "least fault: 1 in a million of the light"
        study.at_most(f"{name}: median difference", median, 3e-7, why)
        share = max(r["off by > 1e-5"] for r in of_scene) / pixels
        why = "edges and what hides lights; measured 7 in 76,800, and 36 among the 600 spheres of scene 4"
        study.at_most(f"{name}: share of pixels off by > 1e-5", share, DIRECT_SHARE, why)
        why = "else there is nothing to compare"
        study.at_least(f"{name}: share of pixels that one of the lights reaches", seen, 0.05, why)
        why = "each is held to an edge, a steep highlight or the start of Mitsuba's shadow rays"
        left = sum(r["without a reason"] for r in of_scene)
        study.at_most(f"{name}: of these without a reason", left, 0, why)
    note = (
        "Stock point light, no sky. Differences relative to 1 + value. To direct, a plane is a square of "
        "side 100: beyond, there is nothing. Mitsuba's shadow rays start 9e-5 (1 + |p|) off their surface, "
        "ours a few roundings: edges of shadows differ where the tracer says that this matters."
    )
    title = "mrt_whitted without bounces and clamp against direct, light by light"
    study.records("direct", title, rows, note)


# ------------------------------------- The mirror as the limit of gloss -------------------------------------


def gloss(study: Study, *, quick: bool) -> None:
    """Hold the gloss of ``path``, of ever less roughness, to the mirrors of ``mrt_whitted``."""
    alphas = (0.3, 0.1, 0.03, 0.01, 0.003) if quick else (0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
    width, height, spp = (64, 48, 64) if quick else (160, 120, 512)
    path = {"type": "path", "max_depth": 8, "rr_depth": 100}

    def spheres(alpha: float) -> Nodes:
        """Return four black, shiny spheres in a smooth environment."""
        black: dict[str, Any] = {"alpha": alpha, "ior": 3.0, "diffuse": (0, 0, 0), "specular": (1, 1, 1)}
        scene = with_materials(report_scene(0), lambda m: dataclasses.replace(m, **black))
        scene = dataclasses.replace(scene, planes=(), lights=())
        nodes = mrt.scene_dict(scene, width=width, height=height, fresnel="dielectric")
        return {**nodes, "sky": {"type": "envmap", "bitmap": mi.Bitmap(_waves())}}

    whitted = {"type": "mrt_whitted", "min_contribution": 0.0}
    mirror = mrt.render(spheres(alphas[0]), **AT_CENTRES, layers=["depth"], integrator=whitted)
    sphere, errors = np.isfinite(mirror.layers["depth.Z"]), []
    for seed, alpha in enumerate(alphas):
        image = mrt.render(spheres(alpha), **AT_CENTRES, spp=spp, seed=seed, integrator=path).image
        errors.append(float(np.abs(image - mirror.image)[sphere].mean() / mirror.image[sphere].mean()))
    slope = float(np.polyfit(np.log(alphas), np.log(errors), 1)[0])
    first, last = (f"gloss of alpha {alpha:g} against the mirror term" for alpha in (alphas[0], alphas[-1]))
    study.at_least(first, errors[0], 0.05, "else there is nothing to compare")
    study.at_most(last, errors[-1], 2e-3, "what is left is noise, as wide as the lobe")
    why = "blur itself has slope 2, noise slope 1"
    study.at_least("slope of that difference over alpha", slope, 0.9, why)
    title, error = "Glossy reflection of path against the mirror term", "mean relative difference"
    study.table("gloss", title, ["alpha", error], list(zip(alphas, errors, strict=True)))


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


def _stock_scenes() -> dict[str, tuple[Nodes, Nodes, int, float]]:
    """Return shapes, Mitsuba's integrator, rays a pixel, and the difference that counts, by name."""
    turn = mi.ScalarTransform4f().translate([0, 1, 0]).rotate([1, 0, 0], -90).scale(3)  # seen from below
    paper = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    lamp = {"type": "point", "position": [1, -2, 1], "intensity": 10.0}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(_waves()), "scale": 1.0}
    bulb = {"type": "sphere", "center": [0, -2, 2], "radius": 0.1}
    bulb["emitter"] = {"type": "area", "radiance": 100.0}
    direct: Nodes = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
    kinds: dict[str, Nodes] = {
        "mrt_cone": {"apex": [-1.2, 1, 0], "base_center": [-1.2, 0, 0], "radius": 0.7},
        "mrt_plane": {"normal": [0, 0, 1], "distance": 2.0},
        "mrt_group": {"numbers": mi.Bitmap(np.array([[-1, -1, 0, 0.5]], np.float32))},
    }
    turned = {name: {"type": name, **numbers, "flip_normals": True} for name, numbers in kinds.items()}
    lit = {"ball": {"type": "sphere", "center": [1, 0, 0]}, "lamp": lamp}
    height = {"type": "bitmap", "bitmap": mi.Bitmap(0.5 * _waves())}
    bumps = {"type": "bumpmap", "texture": height, "scale": 0.4}
    # The ring of scene 5, whose corners have the normals of a torus
    mesh = report_scene(5).meshes[0]
    points = (mesh.vertices - np.float32([0.2, 0.75, -0.2])) * np.float32(1.6)
    around = points * [1, 1, 0]
    middle = 0.88 * around / np.linalg.norm(around, axis=1, keepdims=True)
    arrays = {"positions": points, "faces": mesh.faces, "normals": points - middle}
    smooth: Nodes = {name: mi.Bitmap(np.ascontiguousarray(a[np.newaxis])) for name, a in arrays.items()}
    mirror = {"type": "mrt_mesh", **smooth, "bsdf": {"type": "conductor"}}
    return {
        "two-sided paper from behind": ({"paper": {"type": "rectangle", "to_world": turn, "bsdf": paper},
                                         "lamp": lamp}, direct, 1, 1e-5),
        "a smooth mirror": ({"mirror": mirror, "sky": sky},
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


# ----------------------------------- The mesh that stands in for a cone -----------------------------------

CONE = Cone((0.2, 1.5, -0.1), (0.5, 0.4, 0.3), 0.65, Material(1.5, 0.1, (0, 0, 0), (0, 0, 0)))
SEGMENTS = (64, 128, 256, 512, 1024)
SAME_PART = 1e-2  # relative; beyond, near the rim, one ray met the side and the other the base


def mesh_cones(study: Study, *, quick: bool) -> None:
    """Hold the meshes that other integrators see to the exact cone; their error falls with n⁻²."""
    rng, count = np.random.default_rng(3), 100_000 if quick else 1_000_000
    middle = np.mean([CONE.apex, CONE.base_center], axis=0)
    o = rng.normal(size=(count, 3))
    o = 4 * o / np.linalg.norm(o, axis=1, keepdims=True) + middle
    d = middle + rng.uniform(-0.4, 0.4, size=(count, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = o.astype(np.float32), d.astype(np.float32)
    with np.errstate(all="ignore"):
        exact = Axial([CONE]).distances(o.astype(float), d.astype(float))[:, 0]
    numbers = {"apex": list(CONE.apex), "base_center": list(CONE.base_center), "radius": CONE.radius}
    errors, others = {}, {}
    for n in SEGMENTS:
        cone = {"type": "mrt_cone", **numbers, "segments": n}
        scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "cone": cone})
        found = np.array(scene.ray_intersect_preliminary(rays(o, d)).t)
        both = np.isfinite(found) & np.isfinite(exact)
        relative = np.abs(found[both] / exact[both] - 1)
        errors[n] = float(relative[relative < SAME_PART].mean())
        missed = np.isfinite(found) != np.isfinite(exact)
        others[n] = float(missed.mean() + np.sum(relative >= SAME_PART) / count)
    slope = -float(np.polyfit(np.log(SEGMENTS), np.log(list(errors.values())), 1)[0])
    # The mean takes in rays near rims and the apex, and at 1024 sides float32 adds to it
    why = "theory: 2, and rims and the apex; a mesh wider by a thousandth is beyond"
    study.at_most("slope of the error of a mesh cone: |exponent - 2|", abs(slope - 2), 0.15, why)
    # The height of a chord of 2π/n over an arc of radius r is r (π/n)²/2; rays are 3 to 5 long
    chord = CONE.radius * (np.pi / 256) ** 2 / 2 / 3
    why = "the chord's height over the distance; half as many sides leave four times as much"
    study.at_most("mean error at 256 sides, the default", errors[256], chord, why)
    why = "a share: silhouette, rim and apex within a chord's height, a few times 7.5e-5; a leak adds to it"
    study.at_most("rays that meet another part, or nothing, at 256 sides", others[256], 1e-3, why)
    rows = [[n, 2 * n, errors[n], others[n]] for n in SEGMENTS]
    columns = ["sides", "triangles", "mean relative error", "other part or nothing"]
    study.table("mesh_cones", f"Mesh cones against the exact one, {count} rays", columns, rows)


# --------------------------------- Whole scenes, right and with mistakes ---------------------------------


def physical(scene: Scene) -> Scene:
    """Return a scene that Mitsuba's plugins take: colours up to 1, positive roughness, no diffuse part.

    Then ``mrt_bsdf`` and ``roughplastic``, which refracts diffuse light, are the same. Lobes narrower than
    0.1 make fireflies: no mean of some hundred samples of them is normal, as the tests need it.
    """

    def material(m: Material) -> Material:
        r, g, b = (min(c, 1.0) for c in m.specular)
        alpha = max(abs(m.alpha), 0.1)
        return dataclasses.replace(m, alpha=alpha, specular=(r, g, b), diffuse=(0.0, 0.0, 0.0))

    return with_materials(scene, material)


def _each_material(key: str, change: Callable[[Any], Any]) -> Callable[[Nodes], Nodes]:
    def changed(node: Any) -> Any:
        ours = isinstance(node, dict) and node["type"] == "mrt_bsdf"
        return {**node, key: change(node[key])} if ours else node

    return lambda nodes: {name: changed(node) for name, node in nodes.items()}


def _brighter(nodes: Nodes) -> Nodes:
    """Return the scene with lights and sky 1.02 times as bright."""
    result = dict(nodes)
    for name, node in nodes.items():
        for key in {"intensity", "radiance"} & set(node if isinstance(node, dict) else ()):
            color = {**node[key], "value": [1.02 * c for c in node[key]["value"]]}
            result[name] = {**node, key: color}
    return result


MISTAKES: dict[str, Callable[[Nodes], Nodes]] = {
    "radiance x 1.02": _brighter,
    "alpha x 1.05": _each_material("alpha", lambda alpha: 1.05 * alpha),
    "flipped normal of one sphere": lambda n: {**n, "sphere_0": {**n["sphere_0"], "flip_normals": True}},
    "dropped light": lambda nodes: {name: node for name, node in nodes.items() if name != "light_1"},
    "schlick for dielectric": _each_material("fresnel", lambda _: "schlick"),
}


def whole_scenes(study: Study, *, quick: bool) -> None:
    """Compare the report's scenes under path, black but for their gloss; with mistakes they must differ."""
    size: dict[str, Any] = {"width": 64, "height": 48} if quick else {"width": 120, "height": 90}
    spp = 16 if quick else 64
    rows = []

    def renders(nodes: Nodes, integrator: Nodes, seed: int, **places: str) -> np.ndarray:
        """Return RENDERS independent renders, by default through the pixels' centres."""
        scene, seeds = mi.load_dict(nodes), range(seed, seed + RENDERS)
        options: dict[str, Any] = {"integrator": integrator, "spp": spp, **AT_CENTRES, **places}
        return np.array([mrt.render(scene, **options, seed=s).image for s in seeds])

    def add(what: str, ours: np.ndarray, theirs: np.ndarray, right: bool = False) -> None:
        found = compare(ours, theirs, level=LEVEL)
        if right:
            why = "least fault: the mistakes below, 2 % of the light and 5 % of alpha among them"
            study.at_least(f"p of equality, {what}", found.p, LEVEL, why)
        else:
            study.at_most(f"p of equality with {what}", found.p, LEVEL, "it must be seen")
        each = found.p_values.values()
        rows.append([what, ", ".join(found.detected_by) or "-", *each, found.rel_rmse])

    for number in study.each("Whole scenes", (0, 1, 3) if quick else (0, 1, 2, 3, 4)):
        scene = physical(report_scene(number))
        stock = mrt.scene_dict(scene, flavor="stock", **size)
        # Ours, but for the lights and finite planes of the other
        kept = {name: node for name, node in stock.items() if name.startswith(("light_", "plane_"))}
        ours = mrt.scene_dict(scene, fresnel="dielectric", **size) | kept
        theirs = renders(stock, PATH, 1000)
        add(f"scene {number}", renders(ours, PATH, 0), theirs, right=True)
        if number == 0:
            for name, change in MISTAKES.items():
                add(name, renders(change(ours), PATH, 0), theirs)
    # The clamp has no counterpart among Mitsuba's plugins: our own render loses it
    scene_1 = mrt.scene_dict(1, fresnel="dielectric", **size)
    unclamped, clamped = (
        renders(scene_1, {"type": "mrt_whitted", "clamp": clamp}, seed, lattice="film")
        for clamp, seed in ((False, 0), (True, 1000))
    )
    add("dropped clamp", unclamped, clamped)
    title = "mrt_bsdf against roughplastic in whole scenes, right and with mistakes: p values of equality"
    note = (
        f"{RENDERS} renders of {spp} samples a pixel each; equal pictures are rejected once in {1 / LEVEL:g}."
    )
    columns = ["what", "found by", "pixel", "tile", "image", "relRMSE"]
    study.table("whole-scenes", title, columns, rows, note)


PARTS = (direct, gloss, materials, mesh_cones, whole_scenes)
