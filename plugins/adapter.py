"""What Mitsuba 3.10 will change for shapes, in one place: how a mesh is made, filled and kept by itself.

As in Mitsuba 3.9, where the constructor takes the sizes, the buffers are parameters of ``mi.traverse``, and
shapes cannot be written in Python but as meshes. Discovery of plugins, the other change, is in ``discovery``.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .variants import is_jit


def construct(
    mesh: Any,
    name: str,
    sizes: tuple[int, int],
    props: Any,
    *,
    normals: bool = False,
    texcoords: bool = False,
) -> None:
    """Construct the base class of a mesh with room for ``sizes``: numbers of vertices and of faces."""
    mi.Mesh.__init__(mesh, name, *sizes, props, has_vertex_normals=normals, has_vertex_texcoords=texcoords)


def keep_apart(mesh: Any, name: str, faces: int) -> None:
    """Mitsuba merges meshes that share a BSDF when it loads a scene, but leaves those with attributes
    alone."""
    mesh.add_attribute(f"face_{name}", 1, [0.0] * faces)


def write_buffers(mesh: Any, **buffers: Any) -> None:
    """Give a mesh its ``faces``, ``vertex_positions``, ... as flat arrays."""
    if is_jit():
        # Scenes are loaded by several threads. The update evaluates the material of the mesh, too, which may
        # come from another one; Dr.Jit wants to be told of such a handover
        dr.detail.new_scope(dr.backend_v(mi.Float))
    parameters = mi.traverse(mesh)
    for name, values in buffers.items():
        parameters[name] = values
    parameters.update()
