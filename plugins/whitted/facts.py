"""Reading a scene for ``mrt_whitted``: its objects, sorted by who traces them, and the facts about them."""

from __future__ import annotations

from collections import Counter
from typing import Any

import mitsuba as mi
import numpy as np

from .. import classes_of
from ..lobes import LOBES
from ..parameters import ParameterError
from ..variants import is_jit
from .lights import brightness, light_rows
from .materials import has_mirror, is_anisotropic, is_mrt_bsdf, is_textured, material_rows
from .plan import Mirror, SceneFacts
from .shapes import is_sphere
from .snapshot import Cache, Snapshot

# Beyond these sizes, Embree's products of three lengths leave float32
MIN_MESH_EXTENT = 1e-8
MAX_MESH_COORDINATE = 1e10


Facts = dict[str, Any]  # some of ``SceneFacts``, by name


class Reading:
    """A snapshot of a scene and the facts in it; ``cache`` holds those of parts that have not changed since.

    What the kernels may do in place of calling a plugin is known by its class: an ``MrtPlane`` has an
    equation, an ``AxialMesh`` or ``MrtGroup`` stands for quadrics, an ``MrtBSDF`` or ``MrtLight`` is a row of
    a table. A class of somebody else's that derives from one of these may do anything, and is called.
    """

    def __init__(self, snapshot: Snapshot, cache: Cache) -> None:
        self.snapshot = snapshot
        shapes = snapshot.shape_part
        materials = snapshot.material_part
        lights = snapshot.light_part
        planes = classes_of("planes")
        quadrics = classes_of("quadrics")
        self.planes = [s for s in snapshot.shapes if type(s) in planes]
        self.quadrics = [s for s in snapshot.shapes if type(s) in quadrics]
        self.native = [s for s in snapshot.shapes if type(s) not in (*planes, *quadrics)]
        #: the rows of the materials by shape, none where they have no place in one table
        self.materials, of_materials = cache("material facts", (shapes, materials), _read_materials, snapshot)
        of_shapes = cache("shape facts", shapes, self._read_shapes)
        #: the lights, and their rows where all have one
        self.lights, self.light_rows, of_lights = cache("light facts", lights, _read_lights, snapshot)
        self.facts = SceneFacts(
            **of_lights,
            **of_materials,
            **of_shapes,
            pinhole=snapshot.eye is not None,
            differentiated=any(part.differentiated for part in (shapes, materials, lights)),
        )

    def _read_shapes(self) -> Facts:
        """Return the facts about the shapes."""
        meshes = [s for s in (*self.native, *self.snapshot.inner) if s.is_mesh()]
        for mesh in meshes:
            _check_size(mesh)
        spheres = [s for s in self.native if is_sphere(s)]
        quadrics = Counter[str]()
        for shape in self.quadrics:
            quadrics[shape.table.kind] += len(shape.table.rows)
        return {
            "vectorised": is_jit(),
            "native_shapes": len(self.native),
            "meshes": len(meshes),
            "spheres": len(spheres),
            "plain_spheres": sum(not (s.has_flipped_normals() or s.is_emitter()) for s in spheres),
            "planes": len(self.planes),
            "quadrics": tuple(sorted(quadrics.items())),
        }


def _check_size(mesh: mi.Mesh) -> None:
    low, high = np.array([mesh.bbox().min, mesh.bbox().max], float)
    extent = (high - low).max()
    farthest = np.abs([low, high]).max()
    fits = extent >= MIN_MESH_EXTENT and farthest <= MAX_MESH_COORDINATE
    if np.isfinite(farthest) and extent > 0 and not fits:
        raise ParameterError(
            f'mrt_whitted: the mesh "{mesh.id()}" is {extent:.3g} across and reaches to {farthest:.3g}; rays '
            f"meet meshes from {MIN_MESH_EXTENT:g} to {MAX_MESH_COORDINATE:g}: scale the scene"
        )


def _read_lights(
    snapshot: Snapshot,
) -> tuple[list[mi.Emitter], list[list[list[float]]] | None, Facts]:
    """Return the lights, their rows where all have some, and the facts about them."""
    largest = {e: brightness(e) for e in snapshot.emitters}
    lights = [e for e in snapshot.emitters if not e.is_environment() and largest[e] != 0]
    rows = light_rows(lights)
    environment = snapshot.environment
    delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
    surfaces = [largest[e] for e in lights if mi.has_flag(e.flags(), mi.EmitterFlags.Surface)]
    facts = {
        "lights": len(lights),
        "random_lights": sum(not mi.has_flag(e.flags(), delta) for e in lights),
        "surface_emitters": len(surfaces),
        "environment": environment is not None,
        "sky": 0.0 if environment is None else largest[environment],
        "emission": max(surfaces, default=0.0),
        "lights_tabulated": rows is not None,
    }
    return lights, rows, facts


def _read_materials(snapshot: Snapshot) -> tuple[list[np.ndarray], Facts]:
    """Return the materials as rows of a table, none where they have no place in one, and the facts."""
    bsdfs = snapshot.bsdfs
    rows, merge_obstacle = material_rows(snapshot.shapes)
    # Kernels leave out lobes by their flags; materials outside the table may have any
    flags = {lobe.flag for k, lobe in enumerate(LOBES, start=1) if any(row[k].any() for row in rows)}
    lobes = [(lobe.name, bool(merge_obstacle) or lobe.flag in flags) for lobe in LOBES]
    mirrors = []
    for bsdf in filter(has_mirror, bsdfs):
        mirrors.append(bsdf.mirror_bound() if is_mrt_bsdf(bsdf) else Mirror(1.0, 1.0))
    facts = {
        "lobes": tuple(lobes),
        "mirrors": tuple(mirrors),
        "anisotropic": any(map(is_anisotropic, bsdfs)),
        "textured": bool(merge_obstacle) and any(map(is_textured, bsdfs)),
        "merge_obstacle": merge_obstacle,
    }
    return rows, facts
