"""Reading a scene for ``mrt_whitted``: first the facts, then, by a plan, the data of its kernels."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .emission import MOST_EMITTERS, arriving, brightness, place
from .hit_errors import CURVED, HitErrors
from .kernel_plan import CutOff, KernelPlan, Mirror, Reason, SceneFacts
from .merged_bsdf import MergedBSDF, material_rows, varies_by_object
from .mesh_api import ray_arrays, ray_flags, surface_interaction, vertex_version
from .parameters import ParameterError
from .planes import Planes
from .point_buffer import PointBuffer, point_buffer
from .point_lights import Lights, numbers_of
from .protocols import MirrorBSDF, PlaneShape, QuadricShape
from .quadric_kinds import KINDS
from .quadrics import quadrics_of
from .replay import held
from .spheres import SphereBlockers, Spheres, is_plain_sphere, is_sphere
from .touching import any_touching
from .variants import but_not, is_jit, varies
from .watch import Notes

# Beyond these sizes, Embree's products of three lengths leave float32
SMALLEST_MESH, LARGEST_MESH = 1e-8, 1e10

# Where a light lies on a surface, shadow rays end by this share of their way short of it: it shines to both
# sides
TOUCHING = 2.0**-10

# What ``SceneData`` makes of the shapes, and the decisions that shape it
OF_SHAPES = ("bvh", "ray_arrays", "planes", "quadrics", "errors", "spheres", "shape_arrays")


def _of_shapes(plan: KernelPlan) -> tuple[Any, ...]:
    return plan.bvh, plan.planes, plan.quadrics, plan.spheres


# Reach of a mirror ray: any number that float32 holds
FARTHEST = 2.0**127


@dataclass
class Hit:
    """The first hit of a ray: an interaction, valid where ``found``, and a bound of its error."""

    si: mi.SurfaceInteraction3f
    found: mi.Bool
    error: mi.Float  # how far the point may be off the surface


class SceneReading:
    """The objects of a scene, sorted by who traces them, and the facts about them."""

    facts: SceneFacts

    def __init__(self, scene: mi.Scene, before: SceneReading | None = None) -> None:
        """Read a scene; what has not changed since ``before`` is taken from there."""
        # Not the scene itself: it owns the integrator, which owns this, and such a ring is never freed
        self.objects = _objects(scene)
        self.shapes = scene.shapes()
        self.environment, self.emitters = scene.environment(), scene.emitters()
        self.bsdfs = _once(s.bsdf() for s in self.shapes)
        known = before is not None and before.objects == self.objects and before.bsdfs == self.bsdfs
        self.notes: Notes = before.notes if before and known else self._new_notes()
        self.forms = [_shape_state(s) for s in self.shapes]
        self.planes = [s for s in self.shapes if isinstance(s, PlaneShape)]
        self.quadrics = [s for s in self.shapes if isinstance(s, QuadricShape)]
        self.native = [s for s in self.shapes if not isinstance(s, (PlaneShape, QuadricShape))]
        self.moving = self._moving()
        if not (before and self.same_shapes(before)):
            _check_sizes(self.native)
        self._tables = [s.quadrics() for s in self.quadrics]
        read = self.notes.read
        self.brightness = [read(brightness, e) for e in self.emitters]
        self.lights = self._lights()
        self.numbers = numbers_of(self.lights, read)
        self.eye = _eye(scene)
        materials = material_rows(self.shapes, read)
        self.unmergeable = materials if isinstance(materials, Reason) else None
        self.materials = [] if isinstance(materials, Reason) else materials
        self.facts = self._read_facts(self._touching(before))

    def _new_notes(self) -> Notes:
        groups = [s for s in self.shapes if varies_by_object(s)]
        return Notes(_once([*self.bsdfs, *self.emitters, *groups]))

    def is_of(self, scene: mi.Scene) -> bool:
        """Return whether this scene was read.

        The id of a scene may have passed to another one, those of objects held here cannot.
        """
        return _objects(scene) == self.objects

    def is_stale(self, scene: mi.Scene) -> bool:
        """Return whether it is another scene, or was changed since."""
        if not self.is_of(scene) or self.notes.refresh() or self._moving() != self.moving:
            return True
        if [_shape_state(s) for s in self.shapes] != self.forms or _eye(scene) != self.eye:
            return True
        return self.bsdfs != _once(s.bsdf() for s in self.shapes)

    def same_shapes(self, other: SceneReading) -> bool:
        """Return whether no shape was moved or edited between two readings."""
        return (self.objects, self.forms, self.moving) == (other.objects, other.forms, other.moving)

    def _moving(self) -> list[bool]:
        return [s.moving_frame() is not None for s in self.quadrics]

    def _touching(self, before: SceneReading | None) -> bool:
        """Return whether a point light is on a surface."""
        self.places = list(filter(None, map(partial(self.notes.read, place), self.lights[:MOST_EMITTERS])))
        if before and self.same_shapes(before) and self.places == before.places:
            return before.facts.touching
        return any_touching(self.shapes, self.places)

    def _lights(self) -> list[Any]:
        pairs = zip(self.emitters, self.brightness, strict=True)
        return [e for e, value in pairs if not e.is_environment() and value != 0]

    def _read_of_bsdfs(self, function: Callable[[Any], Any]) -> list[Any]:
        return [self.notes.read(function, b) for b in self.bsdfs]

    def _read_facts(self, touching: bool) -> SceneFacts:
        quadrics: Counter[str] = Counter()
        for table in self._tables:
            quadrics[table.kind] += len(table.rows)
        delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
        read, largest = self.notes.read, dict(zip(map(id, self.emitters), self.brightness, strict=True))
        surfaces = [largest[id(e)] for e in self.lights if mi.has_flag(e.flags(), mi.EmitterFlags.Surface)]
        return SceneFacts(
            vectorised=is_jit(),
            native_shapes=len(self.native),
            meshes=sum(s.is_mesh() for s in self.native),
            spheres=sum(map(is_sphere, self.native)),
            plain_spheres=sum(map(is_plain_sphere, self.native)),
            planes=len(self.planes),
            quadrics=tuple(sorted(quadrics.items())),
            lights=len(self.lights),
            random_lights=sum(not mi.has_flag(e.flags(), delta) for e in self.lights),
            surface_emitters=len(surfaces),
            environment=self.environment is not None,
            sky=0.0 if self.environment is None else largest[id(self.environment)],
            arriving=sum(arriving(e, largest[id(e)]) for e in self.lights),
            emission=max(surfaces, default=0.0),
            alone=self._alone(),
            touching=touching,
            value=max(self._read_of_bsdfs(_value_bound), default=0.0),
            diffuse=self._has_lobe("diffuse"),
            specular=self._has_lobe("specular"),
            mirrors=tuple(read(_mirror, b) for b in self.bsdfs if has_mirror(b)),
            oriented=any(self._read_of_bsdfs(is_oriented)),
            textured=self.unmergeable is not None and any(self._read_of_bsdfs(is_textured)),
            two_sided=any(mi.has_flag(b.flags(), mi.BSDFFlags.BackSide) for b in self.bsdfs),
            unmergeable=self.unmergeable,
            tabled=self.numbers is not None,
            pinhole=self.eye is not None,
        )

    def _has_lobe(self, name: str) -> bool:
        """Return whether a material may have such a lobe; those outside the table may."""
        return self.unmergeable is not None or any(getattr(m, name).any() for m in self.materials)

    def _alone(self) -> bool:
        """Return whether there is one object only, convex, which reflects on its outside."""
        plain = [s for s in self.native if is_plain_sphere(s)]
        convex = [t for t in self._tables if KINDS[t.kind].closed and len(t.rows) == 1 and not t.flipped]
        one_sided = all(isinstance(b, MirrorBSDF) for b in self.bsdfs)
        return len(self.shapes) == 1 and len(plain) + len(convex) + len(self.planes) == 1 and one_sided


class SceneData:
    """The data of the kernels for a scene, as a plan wants them, and its ray queries.

    What depends on the shapes alone is taken from ``before`` where they are the same.
    """

    bvh: mi.Scene | None  # of the shapes that only Mitsuba can trace; None: the scene itself
    ray_arrays: list[Any] | None  # what is read of it; None: not known yet
    planes: Planes
    quadrics: Any
    errors: HitErrors
    spheres: Spheres | None
    shape_arrays: list[Any]  # what is in these
    lights: Lights
    buffers: list[tuple[PointBuffer, Any]]  # what may be in the way of the lights, with what tests it
    eye: PointBuffer | None  # what of the quadrics the camera may see

    def __init__(self, reading: SceneReading, plan: KernelPlan, before: SceneData | None = None) -> None:
        self.reading, self.facts = reading, reading.facts
        self.limit(plan)
        if before and reading.same_shapes(before.reading) and _of_shapes(plan) == _of_shapes(before.plan):
            for name in OF_SHAPES:
                setattr(self, name, getattr(before, name))
        else:
            self._trace_shapes(plan)
        self.lights = (
            before.lights
            if before and self._same_lights(before)
            else Lights(reading.lights, reading.numbers, plan.lights)
        )
        self.buffers = before.buffers if before and self._same_places(before) else self._light_buffers()
        self.eye = before.eye if before and self._same_view(before) else self._eye_buffer()
        self.environment = reading.environment
        self.merged = MergedBSDF(reading.shapes, reading.materials) if plan.merged else None
        self._arrays = held([self.lights, self.merged, self.buffers, self.eye, self.environment])
        self.ray_flags = ray_flags(
            textures=plan.textures, shading_frames=plan.shading_frames, tangents=plan.tangents
        )

    def _same_lights(self, before: SceneData) -> bool:
        now, then = self.reading, before.reading
        same = (now.lights, now.numbers, self.plan.lights) == (then.lights, then.numbers, before.plan.lights)
        return same and now.numbers is not None

    def _same_places(self, before: SceneData) -> bool:
        same_shapes = self.spheres is before.spheres and self.quadrics is before.quadrics
        return same_shapes and self._places() == before._places() and self.plan.buffers == before.plan.buffers

    def _places(self) -> list[list[float]]:
        return [position for position, _ in self.reading.numbers or ()]

    def _light_buffers(self) -> list[tuple[PointBuffer, Any]]:
        """Return lists of what may be in the way of the lights, with what tests it; empty for none."""
        if not self.plan.buffers:
            return []
        things = [] if self.quadrics is None else [self.quadrics]
        if self.plan.bvh:
            things.append(SphereBlockers(self.reading.native))
        pairs = [(point_buffer(np.array(self._places()), *t.hulls()), t) for t in things]
        buffers = [(buffer, thing) for buffer, thing in pairs if buffer is not None]
        return buffers if len(buffers) == len(pairs) else []

    def _same_view(self, before: SceneData) -> bool:
        same_eye = self.reading.eye == before.reading.eye and self.plan.eye == before.plan.eye
        return same_eye and self.quadrics is before.quadrics

    def _eye_buffer(self) -> PointBuffer | None:
        if not self.plan.eye or self.quadrics is None:
            return None
        return point_buffer(np.array([self.reading.eye]), *self.quadrics.hulls())

    def _trace_shapes(self, plan: KernelPlan) -> None:
        reading = self.reading
        exact = [s for s in reading.quadrics if s.quadrics().kind in plan.quadrics]
        planes = reading.planes if plan.planes else []
        own = {id(s) for s in (*exact, *planes)}
        others = [s for s in reading.shapes if id(s) not in own]
        if others and not plan.bvh:
            raise ValueError(f"the plan leaves {len(others)} shapes untraced: set its bvh to True")
        # The stand-ins of planes and quadrics must not be hit: rays are traced in a scene of the others only
        self.bvh, self.ray_arrays = _scene_of(others) if own else None, None
        self.planes = Planes(planes)
        self.quadrics = quadrics_of(exact)
        self.errors = HitErrors(others)
        self.spheres = Spheres(others) if plan.spheres != "none" else None
        self.shape_arrays = held([self.planes, self.quadrics, self.errors, self.spheres])

    def limit(self, plan: KernelPlan) -> None:
        """Take over a plan that differs in its cut-off alone."""
        self.plan, self.path_limit = plan, plan.cut_off.paths
        # What shapes the code of the kernels, ``arrays`` being their data
        self.form: Hashable = replace(plan, cut_off=CutOff(0.0, plan.cut_off.lights))
        if is_jit() and self.path_limit not in (0, math.inf, self.facts.lights + 1):
            self.path_limit = dr.opaque(mi.Float, self.path_limit)  # a brighter sky needs no new kernel

    # ------------------------------------------- Replay ------------------------------------------------

    def arrays(self, scene: mi.Scene) -> list[Any] | None:
        """Return all that the kernels read; None where they call plugins, which may read anything."""
        plan = self.plan
        tabled = plan.merged and self.lights.known and (plan.spheres == "table" or not plan.bvh)
        plain = self.environment is None or self.environment.class_name() == "ConstantBackgroundEmitter"
        if not (tabled and plain):
            return None
        if self.ray_arrays is None:
            self.ray_arrays = ray_arrays(self.bvh or scene) if plan.bvh else []
        return [*self._arrays, self.path_limit, *self.shape_arrays, *self.ray_arrays]

    # ----------------------------------------- Ray queries ---------------------------------------------

    def intersect(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, *, from_eye: bool = False) -> Hit:
        """Return the nearest hit among Mitsuba's shapes, the quadrics and the analytic planes.

        ``from_eye``: most rays come from the camera.
        """
        t, plane, on_plane = self.planes.intersect(ray, active)
        # What lies behind a plane need not be looked for
        ray = mi.Ray3f(ray.o, ray.d, t, ray.time, ray.wavelengths)
        si, found, scale = self._intersect_shapes(scene, ray, active)
        flat = self.errors.of_flat(si, found)
        if self.quadrics is not None:
            reach = dr.select(found, si.t, ray.maxt)
            nearer = mi.Ray3f(ray.o, ray.d, reach, ray.time, ray.wavelengths)
            quadric = self.quadrics.intersect(nearer, active, self.eye if from_eye else None)
            closer = active & (quadric[0] < reach)
            self.quadrics.put_into(si, ray, quadric, closer, tangents=self.plan.tangents)
            scale = dr.select(closer, self.quadrics.scale(quadric[1], closer), scale)
            flat = None if flat is None else dr.select(closer, dr.inf, flat)
            found = found | closer
        if self.plan.planes:
            on_plane = but_not(on_plane, found)
            scale = self.planes.put_into(si, ray, plane, on_plane, scale, tangents=self.plan.tangents)
            flat = None if flat is None else dr.select(on_plane, dr.inf, flat)
            found = found | on_plane
        si.sh_frame = _frame_along(si) if self.plan.tangents else mi.Frame3f(si.sh_frame.n)
        si.wi = si.to_local(-ray.d)
        si.time, si.wavelengths = ray.time, ray.wavelengths
        error = CURVED * dr.maximum(scale, dr.max(dr.abs(si.p)))
        return Hit(si, found, error if flat is None else dr.minimum(error, flat))

    def _intersect_shapes(
        self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Bool, mi.Float]:
        """Return the interaction with the nearest of Mitsuba's shapes, where there is one, and the size of
        its coordinates.
        """
        if not self.plan.bvh:
            return dr.zeros(mi.SurfaceInteraction3f), mi.Bool(False), mi.Float(0)
        pi = (self.bvh or scene).ray_intersect_preliminary(ray, self.plan.coherent, active)
        found = active & pi.is_valid()
        differentiable = scene.shapes_grad_enabled() or dr.grad_enabled(ray)
        if self.spheres is not None and self.plan.spheres == "table" and not differentiable:
            si, scale = self.spheres.interaction(pi, ray, found)
            return si, found, scale
        si = surface_interaction(self.bvh or scene, pi, ray, self.ray_flags, found)
        if self.spheres is not None:
            self.spheres.put_back(si, found)
        return si, found, self.errors.size(si, found)

    def occluded(
        self, scene: mi.Scene, hit: Hit, light: Any, ds: mi.DirectionSample3f, active: mi.Bool
    ) -> mi.Bool:
        """Return whether anything blocks the segment from ``hit`` to the sample ``ds`` of a light."""
        o = self._off_surface(hit, ds.d)
        to_light = (ds.p - o) * (1 - TOUCHING) if self.plan.touching else ds.p - o
        blocked = self.planes.separate(o, o + to_light if self.plan.touching else ds.p)
        if not self.plan.bvh and self.quadrics is None:
            return blocked
        # Stop short of a light that has a surface of its own
        reach = 1 - mi.math.ShadowEpsilon if self.plan.emission else 1
        ray = mi.Ray3f(o, to_light, reach, hit.si.time, hit.si.wavelengths)
        for buffer, things in self.buffers:
            test = partial(things.block, ray=ray)
            blocked |= buffer.any(light, to_light, but_not(active, blocked), test)
        if self.buffers:
            return blocked
        if self.plan.bvh:
            blocked |= (self.bvh or scene).ray_test(ray, self.plan.coherent, but_not(active, blocked))
        if self.quadrics is not None:
            blocked |= self.quadrics.occluded(ray, but_not(active, blocked))
        return blocked

    def mirror_ray(self, ray: mi.Ray3f, hit: Hit) -> mi.Ray3f:
        """Return the ray reflected at ``hit``."""
        n = hit.si.sh_frame.n
        d = ray.d - 2 * dr.dot(ray.d, n) * n
        return mi.Ray3f(self._off_surface(hit, d), d, FARTHEST, ray.time, ray.wavelengths)

    @staticmethod
    def _off_surface(hit: Hit, d: mi.Vector3f) -> mi.Point3f:
        """Return the point of ``hit`` moved to the side of its surface that ``d`` points to, clear of
        rounding errors.
        """
        distance = hit.error
        n = hit.si.n
        return hit.si.p + n * dr.select(dr.dot(n, d) >= 0, distance, -distance)

    # -------------------------------------------- Materials -----------------------------------------------

    def context(self) -> mi.BSDFContext:
        """Return what of the materials is evaluated."""
        context = mi.BSDFContext()
        if self.plan.lobes == ("diffuse",):
            context.type_mask = +mi.BSDFFlags.Diffuse
        elif self.plan.lobes == ("specular",):
            context.type_mask = +mi.BSDFFlags.Glossy
        return context

    def eval_bsdf(
        self, hit: Hit, wos: list[mi.Vector3f], facing: list[mi.Bool], mirror: bool
    ) -> tuple[list[mi.UnpolarizedSpectrum], mi.UnpolarizedSpectrum, mi.Float]:
        """Return the values f cos θo at ``hit`` towards ``wos``, the mirror reflectance and its index of
        refraction: all of it in one call.
        """
        arguments = (hit.si, wos, facing, hit.found)
        # Not among the arguments, where dispatch would take a bool for its mask
        evaluate = partial(_eval_bsdf, mirror, self.context())
        if not is_jit():
            return evaluate(hit.si.bsdf() if hit.found else None, *arguments)
        if self.merged is None:
            return dr.dispatch(hit.si.bsdf(), evaluate, *arguments)
        # A branch only to keep the code together: mixed with that of shadow rays, it runs out of registers
        return dr.if_stmt(
            arguments, hit.found, partial(evaluate, self.merged), partial(evaluate, None), label="bsdf"
        )


def _check_sizes(shapes: list[mi.Shape]) -> None:
    """Refuse meshes that float32 cannot trace."""
    for shape in shapes:
        if shape.is_mesh():
            _check_size(shape)


def _check_size(mesh: mi.Shape) -> None:
    low, high = (np.array(corner, float).ravel() for corner in (mesh.bbox().min, mesh.bbox().max))
    extent, farthest = (high - low).max(), np.abs([low, high]).max()
    if np.isfinite(farthest) and extent > 0 and not (extent >= SMALLEST_MESH and farthest <= LARGEST_MESH):
        raise ParameterError(
            f'mrt_whitted: the mesh "{mesh.id()}" is {extent:.3g} across and reaches to {farthest:.3g}; '
            f"rays meet meshes from {SMALLEST_MESH:g} to {LARGEST_MESH:g}: scale the scene"
        )


def has_mirror(bsdf: Any) -> bool:
    """Return whether a BSDF reflects like a mirror."""
    return bsdf.has_attribute("mirror_reflectance") or mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection)


def is_textured(bsdf: Any) -> bool:
    """Return whether a BSDF varies over its surface; the flags of Mitsuba's own do not say so."""
    flags = bsdf.flags()
    if isinstance(bsdf, MirrorBSDF):
        return mi.has_flag(flags, mi.BSDFFlags.SpatiallyVarying)
    return any(isinstance(node, mi.Texture) and varies(node) for node in mi.traverse(bsdf).hierarchy)


def is_oriented(bsdf: Any) -> bool:
    """Return whether a BSDF depends on how the surface is turned about its normal."""
    if isinstance(bsdf, MirrorBSDF):
        return False
    names = {node.class_name() for node in mi.traverse(bsdf).hierarchy}
    if names & {"BumpMap", "NormalMap"} or mi.has_flag(bsdf.flags(), mi.BSDFFlags.Anisotropic):
        return True
    return not type(bsdf).__module__.startswith("mitsuba")  # somebody else's, which may ask for anything


def _frame_along(si: mi.SurfaceInteraction3f) -> mi.Frame3f:
    """Return the shading frame whose s is along dp/du; any frame where that is nothing, as at an apex."""
    n = si.sh_frame.n
    s = si.dp_du - n * dr.dot(n, si.dp_du)
    length = dr.norm(s)
    known = length > 1e-4 * dr.norm(si.dp_du)
    s = s / dr.select(known, length, 1)
    any_frame = mi.Frame3f(n)
    return mi.Frame3f(dr.select(known, s, any_frame.s), dr.select(known, dr.cross(n, s), any_frame.t), n)


def _value_bound(bsdf: Any) -> float:
    return bsdf.value_bound() if isinstance(bsdf, MirrorBSDF) else math.inf


def _mirror(bsdf: Any) -> Mirror:
    return bsdf.mirror_bound() if isinstance(bsdf, MirrorBSDF) else Mirror(1.0, 1.0)


def _eval_bsdf(
    mirror: bool,
    context: mi.BSDFContext,
    bsdf: Any,
    si: mi.SurfaceInteraction3f,
    wos: list[mi.Vector3f],
    facing: list[mi.Bool],
    active: mi.Bool,
) -> tuple[list[mi.UnpolarizedSpectrum], mi.UnpolarizedSpectrum, mi.Float]:
    values = [mi.UnpolarizedSpectrum(0) for _ in wos]
    reflectance, int_ior = mi.UnpolarizedSpectrum(0), mi.Float(1)
    if bsdf is None:
        return values, reflectance, int_ior
    values = [
        mi.unpolarized_spectrum(bsdf.eval(context, si, wo, seen))
        for wo, seen in zip(wos, facing, strict=True)
    ]
    if mirror and bsdf.has_attribute("mirror_reflectance"):
        reflectance = bsdf.eval_attribute("mirror_reflectance", si, active)
        int_ior = bsdf.eval_attribute_1("int_ior", si, active)
    elif mirror and has_mirror(bsdf):
        context = mi.BSDFContext()
        context.type_mask = +mi.BSDFFlags.DeltaReflection
        reflectance = mi.unpolarized_spectrum(bsdf.sample(context, si, mi.Float(0), mi.Point2f(0), active)[1])
    return values, reflectance, int_ior


def _scene_of(shapes: list[mi.Shape]) -> mi.Scene | None:
    if not shapes:
        return None
    # Mitsuba names an object after its key, and these belong to another scene: they keep their names
    names = [s.id() or f"shape_{i}" for i, s in enumerate(shapes)]
    if len(set(names)) < len(names):
        names = [f"shape_{i}" for i in range(len(shapes))]
    return mi.load_dict({"type": "scene", **dict(zip(names, shapes, strict=True))})


def _once(things: Iterable[Any]) -> list[Any]:
    """Return each object once."""
    return list({id(thing): thing for thing in things}.values())


def _eye(scene: mi.Scene) -> list[float] | None:
    """Return where all rays of the first camera come from; None where that is no point."""
    sensor = next(iter(scene.sensors()), None)
    if sensor is None or sensor.class_name() != "PerspectiveCamera":
        return None
    place = np.array(sensor.world_transform().translation(), float).ravel()
    return place.tolist() if place.shape == (3,) and np.isfinite(place).all() else None


def _objects(scene: mi.Scene) -> list[Any]:
    return [*scene.shapes(), *scene.emitters()]


def _shape_state(shape: Any) -> tuple:
    bbox = shape.bbox()
    return (vertex_version(shape), *bbox.min, *bbox.max)
