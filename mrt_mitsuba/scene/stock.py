"""Scenes with Mitsuba's own plugins in place of this project's."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.scene.model import Node, Scene

# The finite stand-in of a plane, scene units: beyond, float32 makes its intersections visibly wrong
STOCK_EXTENT = 100.0

STOCK_SHAPES = ("sphere", "mrt_plane")  # all that have a counterpart


def stock(nodes: Node, scene: Scene) -> Node:
    """Replace every plugin of this project by its nearest stock equivalent."""
    result: Node = {}
    for name, node in nodes.items():
        kind = node["type"] if isinstance(node, dict) else ""
        result[name] = node
        if kind == "mrt_whitted":
            result[name] = {"type": "path", "max_depth": 4}
        elif kind == "mrt_bsdf":
            result[name] = _stock_bsdf(node)
        elif kind == "mrt_light":  # with falloff, of the same irradiance at the camera's target
            squared = sum((a - b) ** 2 for a, b in zip(node["position"], scene.camera.target, strict=True))
            value = [squared * c for c in node["intensity"]["value"]]
            result[name] = {**node, "type": "point", "intensity": {"type": "rgb", "value": value}}
        elif kind == "mrt_plane":
            result[name] = {"type": "rectangle", "to_world": _square(node), "bsdf": node["bsdf"]}
        elif kind.startswith("mrt_"):
            raise SceneError(
                f"{name} has no counterpart among Mitsuba's plugins: {kind} is made of arrays, or a mesh to "
                "them; write_xml, or mrt export, writes it into a file"
            )
    return result


def _stock_bsdf(node: Node) -> Node:
    """Return ``roughplastic``, or ``diffuse`` where nothing is reflected, with colours up to 1."""
    colors = {name: dict(node[name]) for name in ("diffuse_reflectance", "specular_reflectance")}
    for color in colors.values():
        if color["type"] == "rgb":
            color["value"] = [min(c, 1.0) for c in color["value"]]
        elif color["type"] == "mrt_texture":  # the nearest texel as stored, half a texel off the report's
            color |= {"type": "bitmap", "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    if colors["specular_reflectance"].get("value") == [0.0, 0.0, 0.0]:
        return {"type": "diffuse", "reflectance": colors["diffuse_reflectance"]}
    rough = {"alpha": max(abs(node["alpha"]), 1e-4), "int_ior": node["int_ior"], "ext_ior": 1.0}
    return {"type": "roughplastic", "distribution": "beckmann", **rough, **colors}


def _square(plane: Node) -> mi.ScalarTransform4f:
    """Return the transform of Mitsuba's rectangle, which has half size 1 and faces +z, into a plane."""
    length = np.linalg.norm(plane["normal"])
    ahead = np.divide(plane["normal"], length)
    foot = np.multiply(-plane["distance"] / length, plane["normal"])
    up = [0, 0, 1] if abs(ahead[2]) < 0.9 else [1, 0, 0]
    to_world = mi.ScalarTransform4f().look_at(foot, foot + ahead, up)
    return to_world.scale([STOCK_EXTENT / 2, STOCK_EXTENT / 2, 1])
