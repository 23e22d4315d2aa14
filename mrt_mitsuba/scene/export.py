"""Scenes as Mitsuba dicts and XML files: with this project's plugins, or with Mitsuba's own only."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.files.replacing import replacing
from mrt_mitsuba.machine import Budget
from mrt_mitsuba.options import StrPath, Values, check, choice
from mrt_mitsuba.scene.loading import load_file
from mrt_mitsuba.scene.model import FRESNEL, SIDE, SIZE, Node, Scene
from mrt_mitsuba.scene.open import in_terms
from mrt_mitsuba.scene.report import report_scene

if TYPE_CHECKING:
    import mitsuba as mi
    from numpy.typing import ArrayLike

FLAVORS = ("mrt", "stock")

# The finite stand-in of a plane, scene units: beyond, float32 makes its intersections visibly wrong
STOCK_EXTENT = 100.0


def scene_dict(
    scene: int | Scene, *, width: int = 800, height: int = 600, fresnel: str = "schlick", flavor: str = "mrt"
) -> Node:
    """Return a scene as a plain Mitsuba dict; ``mi.load_dict`` takes it (after ``mrt.register()``).

    ``flavor``: "mrt" for this project's plugins; "stock" for the nearest equivalents among Mitsuba's, which
    any Mitsuba program opens: ``roughplastic`` for the material, ``point`` lights as bright at the camera's
    target, finite squares for planes, ``cylinder`` and two ``disk`` for a cylinder, ``bitmap`` for a
    texture, and ``path`` with few bounces. Cones and meshes have one in files only: see ``write_xml``.

    Raises ``UsageError`` for an unknown scene, flavor or formula and for a size out of range, ``SceneError``
    for a scene without a stock flavor.
    """
    check("flavor", choice(*FLAVORS), flavor)
    width = check("width", SIDE, width)
    height = check("height", SIDE, height)
    fresnel = check("fresnel", FRESNEL, fresnel)
    runtime.use()
    terms = scene if isinstance(scene, Scene) else report_scene(scene)
    result = terms.to_dict(width=width, height=height, fresnel=fresnel)
    return result if flavor == "mrt" else _stock(result, terms)


def write_xml(
    scene: int | Scene | StrPath,
    path: StrPath,
    *,
    flavor: str = "mrt",
    fresnel: str | None = None,
    width: int | None = None,
    height: int | None = None,
    params: Values | None = None,
    **model: Any,
) -> list[str]:
    """Write a scene as XML through Mitsuba's own writer; return the paths of what was written.

    ``scene`` and what follows ``flavor`` are those of ``render``, a scene being a number, a ``Scene``, or the
    path of an OBJ or XML file; an XML file is written with its includes and parameters filled in. XML cannot
    hold arrays: each mesh, and in the stock flavor each cone, goes into a PLY file next to it, named after
    the XML file and the shape; all files are replaced, or none.

    Raises ``OutputError`` if a file cannot be written, or is one that the scene is read from; ``SceneError``
    for groups of objects (``mrt_group``), which have neither an XML form nor a stock counterpart; and what
    ``render`` raises for a scene or an option.
    """
    check("flavor", choice(*FLAVORS), flavor)
    terms = in_terms(scene, model)
    files: dict[str, bytes] = {}  # of shapes, by their paths
    focus: dict[str, object] = {}  # what Mitsuba's cameras have no parameters for, and ``render`` reads
    if terms is None and isinstance(scene, str | os.PathLike):
        given = {"fresnel": fresnel, "width": width, "height": height, "flavor=stock": flavor == "stock"}
        for name, value in given.items():
            if value:
                raise UsageError(f"{name} is of no use with an XML file, which is written as it is")
        runtime.use()
        budget = Budget.of(None)
        text, values = load_file(os.fspath(scene), params or {}, budget, as_text=True)
        focus = {name: values[name] for name in ("focaldist", "focalrange") if name in values}
        inputs: Iterable[str] = budget.inputs
    elif params:
        raise UsageError(f"params: only an XML file declares names, such as {next(iter(params))}")
    else:
        terms = terms or report_scene(scene)  # type: ignore[arg-type]  # which refuses anything else
        nodes = scene_dict(
            terms, fresnel=fresnel or "schlick", width=width or SIZE[0], height=height or SIZE[1]
        )
        files = _put_into_files(nodes, os.path.splitext(os.fspath(path))[0], flavor)
        nodes = _stock(nodes, terms) if flavor == "stock" else nodes
        import mitsuba as mi

        variant = runtime.use()
        runtime.use("scalar_rgb")  # where the writer looks plugins up, whatever the current variant
        runtime.use(variant)
        text = mi.parser.write_string(mi.parser.parse_dict(mi.parser.ParserConfig(variant), nodes))
        if terms.focal_distance is not None:
            focus = {"focaldist": terms.focal_distance, "focalrange": terms.focal_range}
        inputs = terms.files
    lines = "".join(f'\n    <default name="{name}" value="{value}"/>' for name, value in focus.items())
    before, tag, after = re.split("(<scene[^>]*>)", text, maxsplit=1)
    text = f"{before}{tag}{lines}{after}\n"
    with replacing(*files, path, inputs=inputs) as opened:
        for stream, content in zip(opened, (*files.values(), text.encode()), strict=True):
            stream.write(content)
    return [*files, os.fspath(path)]


def _put_into_files(nodes: Node, stem: str, flavor: str) -> dict[str, bytes]:
    """Replace meshes by readers of binary PLY files; return the files by their paths."""
    import mitsuba as mi

    files: dict[str, bytes] = {}
    for name, node in nodes.items():
        kind = node["type"] if isinstance(node, dict) else ""
        if kind == "mrt_group":
            raise SceneError(
                f"{name} cannot be written as XML: mrt_group is made of arrays; render it from Python, or "
                "write at most 1000 spheres or 100 objects of another kind"
            )
        if kind == "mrt_mesh" or (kind == "mrt_cone" and flavor == "stock"):
            file = f"{stem}_{name}.ply"
            bsdf = node.pop("bsdf")
            stream = mi.MemoryStream()
            mi.load_dict(node).write_ply(stream)
            files[file] = stream.raw_buffer()
            flat = {"face_normals": True} if kind == "mrt_mesh" and "normals" not in node else {}
            nodes[name] = {"type": "ply", "filename": os.path.basename(file), **flat, "bsdf": bsdf}
    return files


def _stock(nodes: Node, scene: Scene) -> Node:
    """Replace every plugin of this project by its nearest stock equivalent, which may take several nodes."""
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
            foot = np.multiply(-node["distance"] / np.linalg.norm(node["normal"]), node["normal"])
            square = _facing(foot, node["normal"], STOCK_EXTENT / 2)
            result[name] = {"type": "rectangle", "to_world": square, "bsdf": node["bsdf"]}
        elif kind == "mrt_cylinder":  # an open tube, and at each end a disc that faces away from the other
            result[f"{name}_tube"] = {**result.pop(name), "type": "cylinder"}
            ends = node["p0"], node["p1"]
            for number, (center, opposite) in enumerate((ends, ends[::-1])):
                to_world = _facing(center, np.subtract(center, opposite), node["radius"])
                result[f"{name}_disc{number}"] = {"type": "disk", "to_world": to_world, "bsdf": node["bsdf"]}
        elif kind.startswith("mrt_"):
            raise SceneError(
                f"{name} has no counterpart among Mitsuba's plugins: {kind} is made of arrays, or a mesh to "
                "them; write_xml, or mrt export, writes meshes and cones into files"
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


def _facing(center: ArrayLike, normal: ArrayLike, half_size: float) -> mi.ScalarTransform4f:
    """Return the transform that places Mitsuba's rectangle or disc, which has half size 1 and faces +z."""
    import mitsuba as mi

    ahead = np.divide(normal, np.linalg.norm(normal))
    up = [0, 0, 1] if abs(ahead[2]) < 0.9 else [1, 0, 0]
    to_world = mi.ScalarTransform4f().look_at(np.array(center), np.add(center, ahead), up)
    return to_world.scale([half_size, half_size, 1])
