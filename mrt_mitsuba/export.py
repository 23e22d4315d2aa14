"""Scenes as Mitsuba dicts and XML files: with this project's plugins, or with Mitsuba's own only."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene import Scene
from mrt_mitsuba.scenes import report_scene

FLAVORS = ("mrt", "stock")

# The finite stand-in of a plane, scene units: beyond, float32 makes its intersections visibly wrong
STOCK_EXTENT = 100.0


def scene_dict(
    scene: int | Scene,
    *,
    width: int = 800,
    height: int = 600,
    fresnel: str = "schlick",
    flavor: str = "mrt",
) -> dict[str, Any]:
    """Return a scene as a plain Mitsuba dict; ``mi.load_dict`` takes it (after ``mrt.register()``).

    ``flavor``: "mrt" for this project's plugins; "stock" for the nearest equivalents among Mitsuba's, which any Mitsuba
    program opens: ``roughplastic`` for the material, ``point`` lights as bright at the camera's target, finite squares
    for planes, and ``path`` with few bounces for the integrator.

    Raises ``UsageError`` for an unknown scene or flavor.
    """
    if flavor not in FLAVORS:
        raise UsageError(f"flavor={flavor!r}: must be {' or '.join(FLAVORS)}")
    runtime.use()
    scene = scene if isinstance(scene, Scene) else report_scene(scene)
    result = scene.to_dict(width=width, height=height, fresnel=fresnel)
    return result if flavor == "mrt" else _stock(result, scene)


def write_xml(scene: int | Scene, path: str | os.PathLike[str], *, flavor: str = "mrt", fresnel: str = "schlick") -> None:
    """Write a scene as XML through Mitsuba's own writer; raise ``OutputError`` if the file cannot be written."""
    from mrt_mitsuba.output import replacing

    text = xml_text(scene, flavor=flavor, fresnel=fresnel)
    with replacing(path) as file:
        file.write(text.encode())


def xml_text(scene: int | Scene, *, flavor: str = "mrt", fresnel: str = "schlick") -> str:
    """Return the XML of a scene."""
    import mitsuba as mi

    scene_as_dict = scene_dict(scene, flavor=flavor, fresnel=fresnel)
    variant = mi.variant()
    # The writer looks plugins up in scalar_rgb, whatever the current variant
    runtime.use("scalar_rgb")
    runtime.use(variant)
    state = mi.parser.parse_dict(mi.parser.ParserConfig(variant), scene_as_dict)
    return mi.parser.write_string(state) + "\n"


def _stock(scene_as_dict: dict[str, Any], scene: Scene) -> dict[str, Any]:
    """Replace every plugin of this project by its nearest stock equivalent."""
    return {name: _stock_node(node, scene) if isinstance(node, dict) else node for name, node in scene_as_dict.items()}


def _stock_node(node: dict[str, Any], scene: Scene) -> dict[str, Any]:
    replace = _REPLACEMENTS.get(node["type"])
    return replace(node, scene) if replace else node


def _stock_integrator(node: dict[str, Any], scene: Scene) -> dict[str, Any]:
    return {"type": "path", "max_depth": 4}


def _stock_bsdf(node: dict[str, Any], scene: Scene) -> dict[str, Any]:
    """The same lobes over a diffuse base; colours above one and negative roughness have no stock counterpart."""

    def clipped(color: dict[str, Any]) -> dict[str, Any]:
        return {**color, "value": [min(c, 1.0) for c in color["value"]]} if color["type"] == "rgb" else color

    return {
        "type": "roughplastic",
        "distribution": "beckmann",
        "alpha": max(abs(node["alpha"]), 1e-4),
        "int_ior": node["int_ior"],
        "ext_ior": 1.0,
        "diffuse_reflectance": clipped(node["diffuse_reflectance"]),
        "specular_reflectance": clipped(node["specular_reflectance"]),
    }


def _stock_light(node: dict[str, Any], scene: Scene) -> dict[str, Any]:
    """A light with falloff, of the same irradiance at the camera's target."""
    squared = sum((a - b) ** 2 for a, b in zip(node["position"], scene.camera.target, strict=True))
    color = {**node["intensity"], "value": [c * squared for c in node["intensity"]["value"]]}
    return {"type": "point", "position": node["position"], "intensity": color}


def _stock_plane(node: dict[str, Any], scene: Scene) -> dict[str, Any]:
    import mitsuba as mi

    length = sum(c * c for c in node["normal"]) ** 0.5
    normal = [c / length for c in node["normal"]]
    foot = [-node["distance"] * c for c in normal]
    up = [0, 0, 1] if abs(normal[2]) < 0.9 else [1, 0, 0]
    to_world = mi.ScalarTransform4f().look_at(foot, [p + n for p, n in zip(foot, normal, strict=True)], up)
    # Mitsuba's rectangle is [-1, 1]², facing +z
    to_world = to_world @ mi.ScalarTransform4f().scale([STOCK_EXTENT / 2, STOCK_EXTENT / 2, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": node["bsdf"]}


_REPLACEMENTS: dict[str, Callable[[dict[str, Any], Scene], dict[str, Any]]] = {
    "mrt_whitted": _stock_integrator,
    "mrt_bsdf": _stock_bsdf,
    "mrt_light": _stock_light,
    "mrt_plane": _stock_plane,
}
