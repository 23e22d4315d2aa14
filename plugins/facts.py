"""Reading a scene for ``mrt_whitted``: its objects, sorted by who traces them, and the facts about them."""

from __future__ import annotations

from collections import Counter
from typing import Any

import mitsuba as mi
import numpy as np

from .kernel_plan import Mirror, SceneFacts
from .lights import brightness
from .lobes import LOBES, material_rows
from .parameters import ParameterError
from .simple_shapes import is_sphere
from .snapshot import Kept, Snapshot
from .variants import is_jit, varies

# Beyond these sizes, Embree's products of three lengths leave float32
SMALLEST_MESH, LARGEST_MESH = 1e-8, 1e10


class Reading:
    """A snapshot of a scene and what is read of it, by part; ``kept`` spares reading a part again.

    Plugins declare by methods what ``mrt_whitted`` may do in place of calling them: a plane by
    ``unit_normal``, ``distance`` and ``tangents``; a mesh that stands for exact quadrics by ``quadrics()``
    (a ``QuadricTable``) and ``moving_frame()``; a light of a table by ``numbers()``; a BSDF with the
    attributes ``mirror_reflectance`` and ``int_ior`` by ``mirror_bound()``, one of a table by ``row()``, too.
    """

    def __init__(self, snapshot: Snapshot, kept: Kept) -> None:
        self.snapshot = snapshot
        shapes, materials, lights = snapshot.shape_part, snapshot.material_part, snapshot.light_part
        self.planes = [s for s in snapshot.shapes if hasattr(s, "unit_normal")]
        self.quadrics = [s for s in snapshot.shapes if hasattr(s, "quadrics")]
        own = {id(s) for s in (*self.planes, *self.quadrics)}
        self.native = [s for s in snapshot.shapes if id(s) not in own]
        self.materials, of_materials = kept(
            "material facts", (shapes, materials), lambda: _materials(snapshot)
        )
        of_shapes = kept("shape facts", shapes, self._read_shapes)
        self.lights, self.numbers, of_lights = kept("light facts", lights, lambda: _lights(snapshot))
        self.facts = SceneFacts(**of_lights, **of_materials, **of_shapes, pinhole=snapshot.eye is not None)

    def _read_shapes(self) -> dict[str, Any]:
        meshes = [s for s in (*self.native, *self.snapshot.inner) if s.is_mesh()]
        for mesh in meshes:
            low, high = (np.array(corner, float).ravel() for corner in (mesh.bbox().min, mesh.bbox().max))
            extent, farthest = (high - low).max(), np.abs([low, high]).max()
            fits = extent >= SMALLEST_MESH and farthest <= LARGEST_MESH
            if np.isfinite(farthest) and extent > 0 and not fits:
                raise ParameterError(
                    f'mrt_whitted: the mesh "{mesh.id()}" is {extent:.3g} across and reaches to '
                    f"{farthest:.3g}; rays meet meshes from {SMALLEST_MESH:g} to {LARGEST_MESH:g}: scale the "
                    "scene"
                )
        spheres = [s for s in self.native if is_sphere(s)]
        quadrics = Counter[str]()
        for table in (s.quadrics() for s in self.quadrics):
            quadrics[table.kind] += len(table.rows)
        return {
            "vectorised": is_jit(),  # is the variant one that compiles kernels
            "native_shapes": len(self.native),  # that only Mitsuba can trace
            "meshes": len(meshes),  # of the native ones, and of those in groups
            "spheres": len(spheres),
            # Those that face outwards and do not emit
            "plain_spheres": sum(not (s.has_flipped_normals() or s.is_emitter()) for s in spheres),
            "planes": len(self.planes),  # infinite ones
            "quadrics": tuple(sorted(quadrics.items())),  # kinds of exact ones, and how many of each
        }


def _lights(snapshot: Snapshot) -> tuple[list[Any], list[Any] | None, dict[str, Any]]:
    """Return the lights, their numbers where all have some, and the facts about them."""
    largest = {id(e): brightness(e) for e in snapshot.emitters}
    lights = [e for e in snapshot.emitters if not e.is_environment() and largest[id(e)] != 0]
    numbers: list[Any] | None = None
    if is_jit() and not mi.is_spectral and all(hasattr(light, "numbers") for light in lights):
        numbers = [light.numbers() for light in lights]
        numbers = None if None in numbers else numbers
    environment = snapshot.environment
    delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
    surfaces = [largest[id(e)] for e in lights if mi.has_flag(e.flags(), mi.EmitterFlags.Surface)]
    return lights, numbers, {
        "lights": len(lights),  # emitters but for the environment and what is black
        "random_lights": sum(not mi.has_flag(e.flags(), delta) for e in lights),
        "surface_emitters": len(surfaces),
        "environment": environment is not None,
        "sky": 0.0 if environment is None else largest[id(environment)],  # its radiance; inf if not known
        "emission": max(surfaces, default=0.0),  # the same of the surfaces
        "tabled": numbers is not None,  # can the lights be
    }  # fmt: skip


def _materials(snapshot: Snapshot) -> tuple[list[Any], dict[str, Any]]:
    """Return the materials as rows of a table, none where they have no place in one, and the facts."""
    bsdfs, found = snapshot.bsdfs, material_rows(snapshot.shapes)
    rows, unmergeable = ([], found) if isinstance(found, str) else (found, "")
    return rows, {
        # All that mrt_bsdf has, and whether a material has them; those outside the table may have any
        "lobes": tuple(
            (lobe.name, bool(unmergeable) or any(row[1 + k].any() for row in rows))
            for k, lobe in enumerate(LOBES)
        ),
        "mirrors": tuple(
            b.mirror_bound() if hasattr(b, "mirror_bound") else Mirror(1.0, 1.0)
            for b in bsdfs
            if has_mirror(b)
        ),
        "oriented": any(map(is_oriented, bsdfs)),  # does one depend on tangents
        "textured": bool(unmergeable) and any(map(is_textured, bsdfs)),  # does one vary over its surface
        "two_sided": any(mi.has_flag(b.flags(), mi.BSDFFlags.BackSide) for b in bsdfs),  # lit from behind
        "unmergeable": unmergeable,  # why they have no place in one table; "" where they do
    }  # fmt: skip


def has_mirror(bsdf: Any) -> bool:
    """Return whether a BSDF reflects like a mirror."""
    return bsdf.has_attribute("mirror_reflectance") or mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection)


def is_textured(bsdf: Any) -> bool:
    """Return whether a BSDF varies over its surface; the flags of Mitsuba's own do not say so."""
    if hasattr(bsdf, "mirror_bound"):
        return mi.has_flag(bsdf.flags(), mi.BSDFFlags.SpatiallyVarying)
    return any(map(varies, mi.traverse(bsdf).hierarchy))


def is_oriented(bsdf: Any) -> bool:
    """Return whether a BSDF depends on how the surface is turned about its normal."""
    if hasattr(bsdf, "mirror_bound"):
        return False
    names = {node.class_name() for node in mi.traverse(bsdf).hierarchy}
    if names & {"BumpMap", "NormalMap"} or mi.has_flag(bsdf.flags(), mi.BSDFFlags.Anisotropic):
        return True
    return not type(bsdf).__module__.startswith("mitsuba")  # somebody else's, which may ask for anything
