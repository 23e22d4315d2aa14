"""A scene in the report's terms, and its translation to a Mitsuba dict.

Lengths are in scene units, colours are linear RGB. ``Scene.to_dict()`` gives the plugins of this project,
``report.scene_dict`` also the nearest equivalents among Mitsuba's own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.options import choice, integer

if TYPE_CHECKING:
    import mitsuba as mi
    import numpy as np

Vector = tuple[float, float, float]
Color = tuple[float, float, float]
Node = dict[str, Any]  # an object as ``mi.load_dict`` takes it

# The sky of most scenes of the report
BLUE_SKY: Color = (0.2, 0.2, 0.7)

SIZE = (800, 600)  # default image size in pixels, for scenes without a film
SIDE = integer(1, 65536)  # image side in pixels; whether the memory suffices is checked later
FRESNEL = choice("schlick", "dielectric")
CONVENTION = choice("report", "standard")  # of MTL files, and of how textures are looked up
FLAVORS = ("mrt", "stock")  # this project's plugins, or Mitsuba's own
MAX_FLOAT = 3.4e38  # largest float32
FOCAL_RANGE = 2.0  # half-width of the sharp zone
# Options that apply to OBJ files only
MODEL_OPTIONS = ("convention", "camera", "target", "up", "fov")


@dataclass(frozen=True)
class Camera:
    """Pinhole camera; ``hfov`` is the horizontal field of view in degrees."""

    position: Vector
    target: Vector
    up: Vector = (0, 1, 0)
    hfov: float = 60.0

    def problem(self) -> str:
        """Return why the camera is invalid; an empty text if it is valid."""
        import numpy as np

        for name in ("position", "target", "up"):
            value = getattr(self, name)
            if not _all_finite(value, 3):
                return f"the camera's {name} is {value!r}, but must be three finite numbers up to 3.4e38"
        if not _all_finite([self.hfov], 1) or not 0 < self.hfov < 180:
            return f"the camera's hfov is {self.hfov!r}, but must be more than 0 and less than 180 degrees"
        forward = np.subtract(self.target, self.position)
        if not forward.any():
            return f"camera and target are the same point, {list(self.position)}: move one of them"
        # Their angle, as a share of its largest sine
        across = np.linalg.norm(np.cross(forward, self.up))
        if across <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(self.up):
            return f"the camera looks along up={list(self.up)}: choose another up, such as up=0,0,1"
        return ""


@dataclass(frozen=True)
class Material:
    """Index of refraction, roughness alpha, specular Ks, diffuse Kd; a picture (its path) replaces Kd."""

    ior: float
    alpha: float
    specular: Color
    diffuse: Color
    texture: str | None = None
    scale: tuple[float, float] = field(default=(1.0, 1.0), repr=False)  #: texture coordinates times it,
    offset: tuple[float, float] = field(default=(0.0, 0.0), repr=False)  #: plus this
    #: base and gain: base + gain · texel is the colour
    texture_range: tuple[float, float] = field(default=(0.0, 1.0), repr=False)


@dataclass(frozen=True)
class Light:
    """Point light without falloff."""

    position: Vector
    color: Color


@dataclass(frozen=True)
class Sphere:
    """A sphere around a point."""

    center: Vector
    radius: float
    material: Material


@dataclass(frozen=True)
class Plane:
    """normal · P + distance = 0, with the normal taken as normalised."""

    normal: Vector
    distance: float
    material: Material


@dataclass(frozen=True)
class Cone:
    """A closed cone, from the centre of its base to its apex; the radius is that of the base."""

    apex: Vector
    base_center: Vector
    radius: float
    material: Material


@dataclass(frozen=True)
class Cylinder:
    """A closed cylinder; its axis goes from p0 to p1."""

    p0: Vector
    p1: Vector
    radius: float
    material: Material


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one material; a normal is on the side from which corners run counter-clockwise."""

    vertices: np.ndarray  # float32 [N, 3]
    faces: np.ndarray  # uint32 [M, 3]
    material: Material
    uvs: np.ndarray | None = None  # float32 [N, 2]
    normals: np.ndarray | None = None  # float32 [N, 3], of smooth triangles


@dataclass(frozen=True)
class Scene:
    """Everything that a render needs except the size of the picture and the sampling."""

    camera: Camera
    sky: Color
    lights: tuple[Light, ...]
    spheres: tuple[Sphere, ...] = ()
    planes: tuple[Plane, ...] = ()
    cones: tuple[Cone, ...] = ()
    cylinders: tuple[Cylinder, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    texturing: str = "report"  # or "standard": bilinear, sRGB-aware
    focal_distance: float | None = None
    focal_range: float = FOCAL_RANGE
    title: str = field(default="", compare=False)
    files: frozenset[str] = field(default=frozenset(), compare=False)  #: that it was read from

    def to_dict(self, *, width: int = 800, height: int = 600, fresnel: str = "schlick") -> Node:
        """Return the scene as a Mitsuba dict of this project's plugins, with materials shared by reference.

        Raises ``SceneError`` for a camera, a sky or an object of numbers that make no sense.
        """
        _check(self)
        names: dict[Material, str] = {}  # one definition for each material that differs

        def bsdf(material: Material) -> dict[str, str]:
            return {"type": "ref", "id": names.setdefault(material, f"material_{len(names)}")}

        shapes: Node = {}
        for kind in OBJECTS:
            plugin = "sphere" if kind == "sphere" else f"mrt_{kind}"
            single = getattr(self, f"{kind}s")
            grouped = []
            if len(single) > MAX_SINGLE.get(kind, math.inf):
                grouped = [thing for thing in single if thing.material.texture is None]
                single = [thing for thing in single if thing.material.texture is not None]
            for i, thing in enumerate(single):
                *parameters, (_, material) = vars(thing).items()
                values = {n: float(v) if n in ("radius", "distance") else list(v) for n, v in parameters}
                shapes[f"{kind}_{i}"] = {"type": plugin, **values, "bsdf": bsdf(material)}
            if grouped:
                shape, own = _group(kind, grouped, fresnel)
                shapes[f"{kind}s"] = {**shape, "bsdf": own or bsdf(grouped[0].material)}
        for i, m in enumerate(self.meshes):
            shapes[f"mesh_{i}"] = {**_mesh(m, self.texturing), "bsdf": bsdf(m.material)}
        result: Node = {"type": "scene"}
        if self.meshes:  # by default, Embree lets rays through between slivers
            result["embree_use_robust_intersections"] = True
        result["integrator"] = {"type": "mrt_whitted"}
        result["sensor"] = _sensor(self.camera, width, height)
        result["sky"] = {"type": "constant", "radiance": _rgb(self.sky)}
        for i, light in enumerate(self.lights):
            place = list(light.position)
            result[f"light_{i}"] = {"type": "mrt_light", "position": place, "intensity": _rgb(light.color)}
        for material, name in names.items():
            result[name] = _mrt_bsdf(material, fresnel, self.texturing)
        return result | shapes


# Kinds of objects: each has a field of ``Scene``, with an s, and a plugin, mrt_ and its name, or Mitsuba's
# sphere. All fields of the class except the material, which comes last, are parameters of the plugin
OBJECTS: dict[str, type] = {"sphere": Sphere, "cone": Cone, "cylinder": Cylinder, "plane": Plane}
# Maximum number of single shapes of a kind; more make one shape: Mitsuba takes 0.1 ms to load a native shape
# and over 1 ms for one in Python, each inside the one before, up to Python's limit of recursion
MAX_SINGLE = {kind: 1000 if kind == "sphere" else 100 for kind in OBJECTS if kind != "plane"}


def _all_finite(values: Sequence[float], count: int) -> bool:
    """True if these are ``count`` numbers within the range of a float32."""
    try:
        return len(values) == count and all(abs(value) <= MAX_FLOAT for value in values)
    except TypeError:
        return False


def _check(scene: Scene) -> None:
    """Reject values for which Mitsuba silently renders nothing, or noise. Plugins check the rest."""
    problem = scene.camera.problem()
    if problem:
        raise SceneError(problem)
    if not _all_finite(scene.sky, 3):
        raise SceneError(f"sky is {scene.sky!r}, but must be three finite numbers: red, green and blue")
    if scene.texturing not in ("report", "standard"):
        raise SceneError(f"texturing is {scene.texturing!r}, but must be report or standard")
    for kind in MAX_SINGLE:
        for i, thing in enumerate(getattr(scene, f"{kind}s")):
            *points, radius, _ = vars(thing).values()
            placed = all(_all_finite(point, 3) for point in points)
            if not (placed and _all_finite([radius], 1) and radius > 0):
                raise SceneError(f"{kind}s[{i}] is {thing!r}, but must have finite places and a radius > 0")


def _sensor(camera: Camera, width: int, height: int) -> Node:
    """Return the camera as a Mitsuba dict, with a film of a size in pixels."""
    import mitsuba as mi

    reach = math.dist(camera.position, camera.target)  # of scenes far smaller or larger than the report's
    to_world = mi.ScalarTransform4f().look_at(list(camera.position), list(camera.target), list(camera.up))
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb"}
    return {
        "type": "perspective",
        "fov": camera.hfov,
        "fov_axis": "x",
        "near_clip": 0.01 * min(1.0, reach),
        "far_clip": 1e5 * max(1.0, reach / 10),
        # the original's picture is mirrored left to right against a right-handed camera
        "to_world": to_world.scale([-1, 1, 1]),
        "film": {**film, "component_format": "float32", "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 16},
    }


def _rgb(color: Color) -> Node:
    return {"type": "rgb", "value": list(color)}


def _group(kind: str, objects: list, fresnel: str) -> tuple[Node, Node | None]:
    """Return one shape of many objects, and a BSDF that looks up values by object; None if all are equal."""
    import mitsuba as mi
    import numpy as np

    own = [each.material for each in objects]
    places = [vars(each).values() for each in objects]
    tables: dict[str, list] = {"numbers": [[*chain(*points), radius] for *points, radius, _ in places]}
    values = {
        "alpha": [(m.alpha,) for m in own],
        "int_ior": [(max(m.ior, _SMALLEST_IOR),) for m in own],
        "diffuse_reflectance": [m.diffuse for m in own],
        "specular_reflectance": [m.specular for m in own],
    }
    by_object = {name: {"type": "mesh_attribute", "name": f"face_{name}"} for name in values}
    differ = len(set(own)) > 1
    tables |= {f"face_{name}": rows for name, rows in values.items() if differ}
    bitmaps = {name: mi.Bitmap(np.array(rows, np.float32)) for name, rows in tables.items()}
    bsdf = {"type": "mrt_bsdf", "fresnel": fresnel, **by_object} if differ else None
    return {"type": "mrt_group", "kind": kind, **bitmaps}, bsdf


def _mesh(m: Mesh, texturing: str) -> Node:
    import mitsuba as mi
    import numpy as np

    arrays = {"positions": m.vertices, "faces": m.faces}
    if m.uvs is not None:
        # The report looks up the first row of a picture at v = 0; files, and Mitsuba's ``obj``, the last one
        v = m.uvs[:, 1] if texturing == "report" else 1 - m.uvs[:, 1]
        # Bitmaps have one, three or four channels
        arrays["texcoords"] = np.stack([m.uvs[:, 0], v, np.zeros_like(v)], axis=1)
    if m.normals is not None:
        arrays["normals"] = m.normals
    return {"type": "mrt_mesh", **{name: mi.Bitmap(array[np.newaxis]) for name, array in arrays.items()}}


# An index of zero switches reflection off in the report's files. The formulas reflect everything there, as
# they do, to float32, at this index, which a BSDF can handle
_SMALLEST_IOR = 1e-8


def _mrt_bsdf(m: Material, fresnel: str, texturing: str) -> Node:
    diffuse = _rgb(m.diffuse)
    if m.texture is not None:  # looked up as in the report, or as by Mitsuba: bilinear, sRGB-aware, repeated
        kind = "mrt_texture" if texturing == "report" else "bitmap"
        diffuse = {"type": kind, "filename": os.path.abspath(m.texture)}
        if m.texture_range != (0.0, 1.0):
            diffuse = {"type": kind, "bitmap": _ranged(m, texturing)}
    return {
        "type": "mrt_bsdf",
        "alpha": float(m.alpha),
        "int_ior": max(float(m.ior), _SMALLEST_IOR),
        "fresnel": fresnel,
        "diffuse_reflectance": diffuse,
        "specular_reflectance": _rgb(m.specular),
    }


def _ranged(m: Material, texturing: str) -> mi.Bitmap:
    """Return the picture of a texture with its base and gain applied to the values that are looked up."""
    import mitsuba as mi
    import numpy as np

    picture = mi.Bitmap(str(m.texture))
    if texturing == "report":
        picture.set_srgb_gamma(False)
    texels = np.array(picture.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False))
    base, gain = m.texture_range
    return mi.Bitmap(np.maximum(base + gain * texels, 0).astype(np.float32))
