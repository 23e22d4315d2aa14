"""The data of the kernels of ``mrt_whitted`` for a scene, and its ray queries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import or_
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lobes import LOBES, Pair
from ..variants import and_not, is_jit
from .facts import Reading
from .hit_errors import HitErrors
from .lights import Lights
from .materials import MaterialTable, has_mirror
from .plan import KernelPlan
from .shapes import Planes, Spheres
from .snapshot import Cache

if TYPE_CHECKING:
    from .buffers import PointBuffer
    from .quadrics import Quadrics

# Relative shortening of shadow rays, so that a surface on which a light lies does not occlude it
SHADOW_EPSILON = 2.0**-14

PLUGINS = __name__.removesuffix("whitted.scene_data")  # how the names of our modules begin

# Maximum length of a reflected ray: any float32
MAX_RAY_T = 2.0**127


@dataclass
class Hit:
    """The first hit of a ray: an interaction, valid where ``found``, and a bound of its error."""

    si: mi.SurfaceInteraction3f
    found: mi.Bool
    error: mi.Float  # how far the point may be off the surface


class SceneData:
    """The data of the kernels for a scene, as a plan wants them, and its ray queries.

    ``cache`` holds the data made of parts of the scene that have not changed since.
    """

    def __init__(self, scene: mi.Scene, reading: Reading, plan: KernelPlan, cache: Cache) -> None:
        now = reading.snapshot
        self.scene = scene
        self.plan = plan
        self.facts = reading.facts
        self.environment = now.environment
        self._cache = cache
        self._shape_key = now.shape_part, plan.bvh, plan.planes, plan.quadrics, plan.spheres
        self._comparable = now.material_part.comparable and now.light_part.comparable
        traced = cache("traced", self._shape_key, _trace, reading, plan)
        bvh, self.planes, self.quadrics, self.errors, self.spheres = traced
        self.bvh = bvh or scene
        self.lights = cache(
            "lights", (now.light_part, plan.lights), Lights, reading.lights, reading.light_rows, plan.lights
        )
        things = [thing for thing in (self.quadrics, self.spheres) if thing is not None]
        blockers = things if plan.light_buffers else []
        light_key = now.light_part, plan.light_buffers, *self._shape_key
        places = [row[0] for row in reading.light_rows or ()]
        #: lists of the objects that may block each light, with the objects, which test rays
        self.light_buffers = cache("light buffers", light_key, _buffers, places, blockers)
        seen = [self.quadrics] if plan.eye_buffer and self.quadrics is not None else []
        eye_key = now.eye, plan.eye_buffer, *self._shape_key
        #: the same of the quadrics that the camera may see
        self.eye_buffers = cache("eye buffers", eye_key, _buffers, [now.eye], seen)
        self.merged: MaterialTable | None = None
        if plan.merged:
            material_key = now.shape_part, now.material_part
            self.merged = cache("merged", material_key, MaterialTable, now.shapes, reading.materials)
        #: of what a path may still bring, as data: a brighter sky needs no new kernel
        self.path_bound = plan.contribution_bounds[0]
        if is_jit() and self.path_bound < dr.inf:
            self.path_bound = dr.opaque(mi.Float, self.path_bound)
        self.ray_flags = mi.RayFlags.UV | mi.RayFlags.ShadingFrame
        self.ray_flags |= +mi.RayFlags.dPdUV if plan.tangents else 0

    def arrays(self) -> list[object] | None:
        """Return all that the kernels read; None where they call plugins, which may read anything."""
        plan = self.plan
        sky = self.environment
        tabulated = (
            plan.merged,
            plan.lights == "none" or self.facts.lights_tabulated,
            plan.spheres == "table" or not plan.bvh,
            sky is None or sky.class_name() == "ConstantBackgroundEmitter",
        )
        if not (self._comparable and all(tabulated)):
            return None
        rays = self._cache("rays", self._shape_key, _ray_arrays, self.bvh) if plan.bvh else []
        own = [self.planes, self.quadrics, self.errors, self.spheres, self.lights, self.merged]
        return [*_arrays_in([*own, self.light_buffers, self.eye_buffers]), *rays, self.path_bound, sky]

    # ----------------------------------------- Ray queries ---------------------------------------------

    def intersect(self, ray: mi.Ray3f, active: mi.Bool, eye: PointBuffer | None = None) -> Hit:
        """Return the nearest hit among Mitsuba's shapes, the quadrics and the analytic planes."""
        plan = self.plan
        t, plane, on_plane = self.planes.intersect(ray, active)
        # The search ends at the plane
        ray = mi.Ray3f(ray.o, ray.d, t, ray.time, ray.wavelengths)
        si = dr.zeros(mi.SurfaceInteraction3f)
        found = mi.Bool(False)
        scale = mi.Float(0)  # size of the coordinates of what is hit
        if plan.bvh:
            pi = self.bvh.ray_intersect_preliminary(ray, plan.coherent, active)
            found = active & pi.is_valid()
            differentiable = self.scene.shapes_grad_enabled() or dr.grad_enabled(ray)
            if self.spheres is not None and plan.spheres == "table" and not differentiable:
                si, scale = self.spheres.interaction(pi, ray, found)
            else:
                si = pi.compute_surface_interaction(ray, self.ray_flags, found)
                if self.spheres is not None:
                    self.spheres.put_back(si, found)
                scale = self.errors.size(si, found)
        if self.quadrics is not None:
            reach = dr.select(found, si.t, ray.maxt)
            nearer = mi.Ray3f(ray.o, ray.d, reach, ray.time, ray.wavelengths)
            quadric = self.quadrics.intersect(nearer, active, eye)
            closer = active & (quadric[0] < reach)
            scale = self.quadrics.fill_interaction(si, ray, quadric, closer, scale, tangents=plan.tangents)
            found = found | closer
        if plan.planes:
            on_plane = and_not(on_plane, found)
            scale = self.planes.fill_interaction(si, ray, plane, on_plane, scale, tangents=plan.tangents)
            found = found | on_plane
        if plan.tangents:
            si.initialize_sh_frame()
        else:
            si.sh_frame = mi.Frame3f(si.sh_frame.n)
        si.wi = si.to_local(-ray.d)
        si.time = ray.time
        si.wavelengths = ray.wavelengths
        return Hit(si, found, self.errors.bound(si, scale, found))

    def occluded(
        self, hit: Hit, light: int | mi.UInt32, ds: mi.DirectionSample3f, active: mi.Bool
    ) -> mi.Bool:
        """True if anything blocks the segment from ``hit`` to the sample ``ds`` of a light.

        ``light``: its number, which chooses its light buffer. Lanes that are not active may be anything.
        """
        o = self._off_surface(hit, ds.d)
        to_light = ds.p - o
        blocked = self.planes.separate(o, o + to_light * (1 - SHADOW_EPSILON))
        # Lights that have a surface of their own are Mitsuba's
        reach = 1 - (mi.math.ShadowEpsilon if self.facts.surface_emitters else SHADOW_EPSILON)
        ray = mi.Ray3f(o, to_light, reach, hit.si.time, hit.si.wavelengths)
        for buffer, things in self.light_buffers:
            test = partial(things.block, ray=ray)
            blocked |= buffer.any(light, to_light, and_not(active, blocked), test)
        if self.light_buffers:
            return blocked
        if self.plan.bvh:
            blocked |= self.bvh.ray_test(ray, self.plan.coherent, and_not(active, blocked))
        if self.quadrics is not None:
            blocked |= self.quadrics.occluded(ray, and_not(active, blocked))
        return blocked

    def mirror_ray(self, ray: mi.Ray3f, hit: Hit) -> mi.Ray3f:
        """Return the ray reflected at ``hit``."""
        n = hit.si.sh_frame.n
        d = ray.d - 2 * dr.dot(ray.d, n) * n
        return mi.Ray3f(self._off_surface(hit, d), d, MAX_RAY_T, ray.time, ray.wavelengths)

    @staticmethod
    def _off_surface(hit: Hit, d: mi.Vector3f) -> mi.Point3f:
        """Return the point of ``hit``, clear of rounding errors on the side that ``d`` points to."""
        n = hit.si.n
        return hit.si.p + n * dr.select(dr.dot(n, d) >= 0, hit.error, -hit.error)

    def eval_bsdf(
        self, hit: Hit, wos: list[mi.Vector3f], facing: list[mi.Bool], mirror: bool
    ) -> tuple[list[mi.UnpolarizedSpectrum], mi.UnpolarizedSpectrum, mi.Float]:
        """Return f cos θo for each local direction of ``wos`` (0 where its ``facing`` is false), the
        reflectance of the mirror (0 if none) and the interior index of refraction (1 if unknown), by a single
        dispatch. ``mirror``: whether to look up the last two."""
        context = context_of(self.plan.lobes)
        arguments = (hit.si, wos, facing, hit.found)
        # Not among the arguments, where dispatch would take a bool for its mask
        evaluate = partial(_eval_bsdf, mirror, context)
        if not is_jit():
            return evaluate(hit.si.bsdf() if hit.found else None, *arguments)
        if self.merged is None:
            return dr.dispatch(hit.si.bsdf(), evaluate, *arguments)
        # A branch only to keep the code together: mixed with that of shadow rays, it runs out of registers
        return dr.if_stmt(
            arguments, hit.found, partial(evaluate, self.merged), partial(evaluate, None), label="bsdf"
        )


def context_of(lobes: Sequence[str]) -> mi.BSDFContext:
    """Return the context in which BSDFs have some lobes, by name; all of them for none."""
    context = mi.BSDFContext()
    if 0 < len(lobes) < len(LOBES):
        flags = [+getattr(mi.BSDFFlags, lobe.flag) for lobe in LOBES if lobe.name in lobes]
        context.type_mask = reduce(or_, flags)  # several lobes may have the same one
    return context


def _trace(
    reading: Reading, plan: KernelPlan
) -> tuple[mi.Scene | None, Planes, Quadrics | None, HitErrors, Spheres | None]:
    """Sort the shapes by who traces them.

    Returns a scene of those that only Mitsuba can trace, None where that is the scene itself; the planes and
    the quadrics; and, of Mitsuba's shapes, the errors of hits and the spheres.
    """
    exact = [s for s in reading.quadrics if s.table.kind in plan.quadrics]
    planes = reading.planes if plan.planes else []
    own = {*exact, *planes}
    others = [s for s in reading.snapshot.shapes if s not in own]
    bvh = None
    if others and not plan.bvh:
        raise ValueError(f"the plan leaves {len(others)} shapes untraced: set its bvh to True")
    if own and others:
        # The stand-ins of planes and quadrics must not be hit: rays are traced in a scene of the others only.
        # Mitsuba names an object after its key, and these belong to another scene: they get their names back
        things = [*others, *reading.snapshot.groups]
        names = [thing.id() for thing in things]
        shapes = {f"shape_{i}": thing for i, thing in enumerate(things)}
        bvh = mi.load_dict({"type": "scene", **shapes})
        for thing, name in zip(things, names, strict=True):
            thing.set_id(name)
    spheres = Spheres(others) if plan.spheres != "none" else None
    quadrics = None
    if exact:
        from .quadrics import Quadrics  # only for scenes that have some

        quadrics = Quadrics(exact)
    return bvh, Planes(planes), quadrics, HitErrors(others), spheres


def _buffers(
    places: list, things: Sequence[Quadrics | Spheres]
) -> list[tuple[PointBuffer, Quadrics | Spheres]]:
    """Return lists of the things around points, with the things; none of no thing."""
    if not things:
        return []
    from .buffers import PointBuffer  # only for scenes that have some

    return [(PointBuffer(np.array(places), *thing.boxes()), thing) for thing in things]


def _eval_bsdf(
    mirror: bool,
    context: mi.BSDFContext,
    bsdf: mi.BSDF | MaterialTable | None,
    si: mi.SurfaceInteraction3f,
    wos: list[mi.Vector3f],
    facing: list[mi.Bool],
    active: mi.Bool,
) -> tuple[list[mi.UnpolarizedSpectrum], mi.UnpolarizedSpectrum, mi.Float]:
    reflectance = mi.UnpolarizedSpectrum(0)
    int_ior = mi.Float(1)
    if bsdf is None:
        return [mi.UnpolarizedSpectrum(0) for _ in wos], reflectance, int_ior
    seen = zip(wos, facing, strict=True)
    if isinstance(bsdf, MaterialTable):
        lobes = bsdf.lobes(si)
        values = [lobes.value(context, Pair.above(si.wi, wo, there)) for wo, there in seen]
        if mirror:
            reflectance = lobes.mirror_reflectance
            int_ior = lobes.given["int_ior"]
        return values, reflectance, int_ior
    values = [mi.unpolarized_spectrum(bsdf.eval(context, si, wo, there)) for wo, there in seen]
    if mirror and bsdf.has_attribute("mirror_reflectance"):
        reflectance = bsdf.eval_attribute("mirror_reflectance", si, active)
        int_ior = bsdf.eval_attribute_1("int_ior", si, active)
    elif mirror and has_mirror(bsdf):
        context = mi.BSDFContext()
        context.type_mask = +mi.BSDFFlags.DeltaReflection
        _, weight = bsdf.sample(context, si, mi.Float(0), mi.Point2f(0), active)
        reflectance = mi.unpolarized_spectrum(weight)
    return values, reflectance, int_ior


def _ray_arrays(scene: mi.Scene) -> list[object]:
    """Return the arrays of a scene that Embree's queries read; elsewhere, the scene.

    To see a scene, Dr.Jit looks at all objects of all scenes, which takes 20 µs for each.
    """
    if not mi.variant().startswith("llvm"):
        return [scene]
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal):
        indices = dr.detail.collect_indices(scene)
    handle = mi.UInt64(0)
    arrays: list[mi.UInt32] = dr.detail.update_indices([handle, handle, handle, mi.UInt32(0)], indices[:4])
    expected = dr.reinterpret_array(mi.UInt32, scene.shapes_dr())
    known = np.array_equal(np.sort(arrays[-1]), np.sort(expected))
    return arrays if known else [scene]  # fields may come in another order


def _arrays_in(value: object) -> list[Any]:
    """Return the arrays in a value, with those inside containers and objects of this package."""
    if isinstance(value, type):
        return []
    if dr.is_array_v(value):
        return [value] if dr.width(value) else []  # Dr.Jit aborts on an array of nothing
    if type(value).__module__.startswith(PLUGINS) and hasattr(value, "__dict__"):
        value = vars(value)
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list | tuple):
        return []
    return [array for part in value for array in _arrays_in(part)]
