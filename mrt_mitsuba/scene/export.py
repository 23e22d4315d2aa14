"""Scenes as XML files: with this project's plugins, or with Mitsuba's own only."""

from __future__ import annotations

import os
import re
from typing import Any

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.files.replacing import replacing
from mrt_mitsuba.options import StrPath, Values, check, choice
from mrt_mitsuba.scene.loading import load_file
from mrt_mitsuba.scene.model import FLAVORS, SIZE, Node, Scene
from mrt_mitsuba.scene.open import in_terms
from mrt_mitsuba.scene.report import report_scene, scene_dict
from mrt_mitsuba.scene.stock import STOCK_SHAPES, stock


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
    hold arrays: each mesh, and in the stock flavor each cone and cylinder, goes into a PLY file next to it,
    named after the XML file and the shape; all files are replaced, or none.

    Raises ``OutputError`` if a file cannot be written, or is one that the scene is read from; ``SceneError``
    for groups of objects (``mrt_group``), which have neither an XML form nor a stock counterpart; and what
    ``render`` raises for a scene or an option.
    """
    check("flavor", choice(*FLAVORS), flavor)
    terms = in_terms(scene, model)
    files: dict[str, bytes] = {}  # of shapes, by their paths
    inputs: set[str] = set()
    focus: dict[str, object] = {}  # what Mitsuba's cameras have no parameters for, and ``render`` reads
    if terms is None and isinstance(scene, str | os.PathLike):
        given = {"fresnel": fresnel, "width": width, "height": height, "flavor=stock": flavor == "stock"}
        for name, value in given.items():
            if value:
                raise UsageError(f"{name} is of no use with an XML file, which is written as it is")
        runtime.use()
        text, values = load_file(os.fspath(scene), params or {}, inputs, as_text=True)
        focus = {name: values[name] for name in ("focaldist", "focalrange") if name in values}
    elif params:
        raise UsageError(f"params: only an XML file declares names, such as {next(iter(params))}")
    else:
        terms = terms or report_scene(scene)  # type: ignore[arg-type]  # which refuses anything else
        nodes = scene_dict(
            terms, fresnel=fresnel or "schlick", width=width or SIZE[0], height=height or SIZE[1]
        )
        files = _put_into_files(nodes, os.path.splitext(os.fspath(path))[0], flavor)
        nodes = stock(nodes, terms) if flavor == "stock" else nodes
        import mitsuba as mi

        variant = runtime.use()
        runtime.use("scalar_rgb")  # where the writer looks plugins up, whatever the current variant
        runtime.use(variant)
        text = mi.parser.write_string(mi.parser.parse_dict(mi.parser.ParserConfig(variant), nodes))
        if terms.focal_distance is not None:
            focus = {"focaldist": terms.focal_distance, "focalrange": terms.focal_range}
        inputs |= terms.files
    lines = "".join(f'\n    <default name="{name}" value="{value}"/>' for name, value in focus.items())
    before, tag, after = re.split("(<scene[^>]*>)", text, maxsplit=1)
    text = f"{before}{tag}{lines}{after}\n"
    with replacing(*files, path, inputs=inputs) as opened:
        for stream, content in zip(opened, (*files.values(), text.encode()), strict=True):
            stream.write(content)
    return [*files, os.fspath(path)]


def _put_into_files(nodes: Node, stem: str, flavor: str) -> dict[str, bytes]:
    """Replace meshes by readers of binary PLY files, and textures in memory by those of EXR files; return
    the files by their paths."""
    import mitsuba as mi

    files: dict[str, bytes] = {}
    for name, node in nodes.items():
        kind = node["type"] if isinstance(node, dict) else ""
        if kind == "mrt_group":
            raise SceneError(
                f"{name} cannot be written as XML: mrt_group is made of arrays; render it from Python, or "
                "write at most 1000 spheres or 100 objects of another kind"
            )
        is_shape = kind != "" and "bsdf" in node
        if kind == "mrt_mesh" or (flavor == "stock" and is_shape and kind not in STOCK_SHAPES):
            file = f"{stem}_{name}.ply"
            bsdf = node.pop("bsdf")
            stream = mi.MemoryStream()
            mi.load_dict(node).write_ply(stream)
            files[file] = stream.raw_buffer()
            flat = {"face_normals": True} if kind == "mrt_mesh" and "normals" not in node else {}
            nodes[name] = {"type": "ply", "filename": os.path.basename(file), **flat, "bsdf": bsdf}
        elif kind == "mrt_bsdf" and "bitmap" in node["diffuse_reflectance"]:
            file = f"{stem}_{name}.exr"
            stream = mi.MemoryStream()
            texture = node["diffuse_reflectance"]
            texture.pop("bitmap").write(stream, mi.Bitmap.FileFormat.OpenEXR)
            files[file] = stream.raw_buffer()
            texture["filename"] = os.path.basename(file)
    return files
