"""How Mitsuba makes meshes and interactions, in one place: version 3.10 changes all of it.

Decided by what is there, not by a version number:

- Buffers: parameters ``vertex_positions``, ... of ``mi.traverse`` (3.9), tensors ``positions``, ... (3.10).
- What an interaction holds: ``RayFlags.UV`` and ``ShadingFrame`` (3.9), or ``Shading`` for both (3.10).
- Who computes it: the preliminary intersection (3.9) or the scene (3.10).

Discovery of plugins, the other change, is in ``discovery``.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .variants import is_jit

# Names of the buffers: here, where they are flat arrays, and where they are tensors of rows
TENSORS = {
    "vertex_positions": "positions",
    "vertex_normals": "normals",
    "vertex_texcoords": "texcoords",
    "faces": "faces",
}


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
    """Keep Mitsuba from merging the mesh with others of its BSDF: it leaves those with attributes alone."""
    mesh.add_attribute(f"face_{name}", 1, [0.0] * faces)


def write_buffers(mesh: Any, **buffers: Any) -> None:
    """Give a mesh its ``faces``, ``vertex_positions``, ... as flat arrays."""
    if is_jit():
        # Scenes are loaded by several threads. The update evaluates the material of the mesh, too, which may
        # come from another one; Dr.Jit must know of such a handover
        dr.detail.new_scope(dr.backend_v(mi.Float))
    parameters = mi.traverse(mesh)
    for name, values in buffers.items():
        if name in parameters:
            parameters[name] = values
        else:
            kind = mi.TensorXu if name == "faces" else mi.TensorXf
            width = 2 if name == "vertex_texcoords" else 3
            parameters[TENSORS[name]] = kind(values, (len(values) // width, width))
    parameters.update()


def vertex_version(shape: Any) -> int:
    """Return what changes when the vertices of a mesh do; 0 where nothing says so."""
    if not is_jit() or not isinstance(shape, mi.Mesh):
        return 0
    if hasattr(shape, "vertex_positions_buffer"):
        return shape.vertex_positions_buffer().index
    return shape.positions.array.index


def triangles(mesh: Any) -> np.ndarray:
    """Return the corners of a mesh's triangles, float64 [M, 3, 3]."""
    parameters = mi.traverse(mesh)
    points, faces = (
        np.array(parameters[name if name in parameters else TENSORS[name]])
        for name in ("vertex_positions", "faces")
    )
    return points.astype(np.float64).reshape(-1, 3)[faces.reshape(-1, 3)]


def ray_arrays(scene: mi.Scene) -> list[Any]:
    """Return what Embree's queries read of a scene; elsewhere, the scene.

    To see a scene, Dr.Jit looks at all objects of all scenes, which takes 20 µs for each.
    """
    if not mi.variant().startswith("llvm"):
        return [scene]
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal):
        indices = dr.detail.collect_indices(scene)
    handles, shapes = [mi.UInt64(0)] * 3, mi.UInt32(0)
    found: list[Any] = dr.detail.update_indices([*handles, shapes], indices[:4])
    expected = dr.reinterpret_array(mi.UInt32, scene.shapes_dr())
    numbers, known = (np.sort(array) for array in (found[-1], expected))
    return found if np.array_equal(numbers, known) else [scene]  # fields may come in another order


def ray_flags(*, textures: bool, shading_frames: bool, tangents: bool) -> int:
    """Return the flags of an interaction with texture coordinates, normals, derivatives by them."""
    flags = +mi.RayFlags.dPdUV if tangents else +mi.RayFlags.Minimal
    if hasattr(mi.RayFlags, "Shading"):
        return flags | +mi.RayFlags.Shading if textures or shading_frames else flags
    if textures:
        flags |= +mi.RayFlags.UV
    if shading_frames:
        flags |= +mi.RayFlags.ShadingFrame
    return flags


def surface_interaction(
    scene: mi.Scene, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, flags: int, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    """Return the interaction of a preliminary intersection."""
    if hasattr(pi, "compute_surface_interaction"):
        return pi.compute_surface_interaction(ray, flags, active)
    return scene.compute_surface_interaction(pi, ray, flags, active)
