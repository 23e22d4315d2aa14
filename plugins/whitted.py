"""``mrt_whitted``: the report's recursive ray tracer as a Mitsuba integrator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from .intersect import intersect_plane
from .lookup import ByShape, Table
from .parameters import choice, flag, integer, number, spectrum
from .quadrics import is_quadric, quadrics_of
from .variants import but_not, is_jit, pointer

BUDGETS = ("report", "plain")

# A sixteenth of a step of an 8-bit picture: what many cut paths add up to stays below half a step, and on
# average over the report's scenes below 1e-5
MIN_CONTRIBUTION = 1 / 16 / 255

# A secondary ray starts this far off its surface, relative to the size of the coordinates involved: 32
# float32 roundings, a few times what intersection, projection and ray test lose together
OFFSET = 32 * 2.0**-24

# Reach of a mirror ray: any number that float32 holds
FARTHEST = 2.0**127

# Up to this many lights the kernel holds the code of each; beyond, it loops over them
UNROLLED_LIGHTS = 8


@dataclass
class Hit:
    """What a ray meets first: an interaction, valid where ``found``, and the size of its coordinates."""

    si: mi.SurfaceInteraction3f
    found: mi.Bool
    scale: mi.Float


@dataclass
class Trace:
    """Radiance of a bundle of camera rays, and what fell out of computing it."""

    radiance: mi.UnpolarizedSpectrum
    direct: mi.UnpolarizedSpectrum  # the part of it that needs no mirror ray
    hit: Hit  # of the camera ray
    bounces: mi.UInt32  # mirror rays traced
    shadow_rays: mi.UInt32  # shadow rays traced


@dataclass
class LightSample:
    """One light as seen from a hit."""

    ds: mi.DirectionSample3f
    wo: mi.Vector3f  # local direction to it
    weight: mi.UnpolarizedSpectrum  # what arrives from there, over the density of the direction
    facing: mi.Bool  # is it on the lit side


@dataclass
class Shading:
    """What a surface adds to a path."""

    radiance: mi.UnpolarizedSpectrum
    shadow_rays: mi.UInt32
    reflectance: mi.UnpolarizedSpectrum  # of the mirror ray
    cost: mi.UInt32  # of the mirror ray, to the bounce budget


class MrtWhitted(mi.SamplingIntegrator):
    r"""Whitted-style ray tracing: direct light, hard shadows, perfect mirror rays.

    .. math::
        L(x, d) = \sum_i \mathrm{clamp}_{[0,1]}\bigl(E_i f(x, \omega_i, -d) \cos\theta_i\bigr) V_i
                  + k_s F(\theta)\, L(x', r)

    with r the mirror direction, and the sky where a ray meets nothing. Shading goes through ``si.bsdf()``:
    k_s F is the attribute ``mirror_reflectance`` of an ``mrt_bsdf``, and the delta reflection of any other
    BSDF. Lights are all emitters of the scene; those without a delta position take one random sample each.
    ``mrt_plane``, ``mrt_cone``, ``mrt_cylinder`` and ``mrt_group`` shapes are intersected analytically.

    ==================== ======== ============ ===========================================================
    name                 type     default      unit or range
    ==================== ======== ============ ===========================================================
    ``max_depth``        integer  10           >= 1, bounce budget: a ray at this depth is black
    ``sky``              spectrum (from scene) radiance of a miss; default the environment emitter, else 0
    ``clamp``            boolean  true         clamp each light's contribution to [0, 1], as the report does
    ``min_contribution`` float    1/16/255     >= 0; a path ends when its throughput times the number of
                                               lights plus one (the sky) is below, and a light is taken as
                                               visible when what it adds, times the number of lights, is
                                               below
    ``bounce_budget``    string   report       ``report``: a bounce costs max(1, 10 - int(10 int_ior));
                                               ``plain``: 1
    ==================== ======== ============ ===========================================================

    .. code-block:: python

        {'type': 'mrt_whitted', 'max_depth': 10, 'clamp': True}

    .. code-block:: xml

        <integrator type="mrt_whitted">
            <integer name="max_depth" value="10"/>
        </integrator>

    Nearest stock plugin: ``direct``, which it equals at ``max_depth`` 1 without clamp. Differentiable at
    ``max_depth`` 1 only (the bounces are a loop of unknown length). The equation of an ``mrt_plane`` is fixed
    when it is made; moving its vertices changes only its stand-in for other integrators. Polarisation is
    ignored.
    """

    def __init__(self, props: mi.Properties):
        _construct(self, props)
        self.max_depth = integer(props, "max_depth", 10, least=1)
        self.sky = spectrum(props, "sky", emissive=True) if "sky" in props else None
        self.clamp = flag(props, "clamp", True)
        self.min_contribution = number(props, "min_contribution", MIN_CONTRIBUTION, least=0)
        self.bounce_budget = choice(props, "bounce_budget", BUDGETS)
        self._prepared: Prepared | None = None

    # ------------------------------------- Mitsuba's interface ----------------------------------------

    def render(self, scene, sensor, seed=0, spp=0, develop=True, evaluate=True):
        self.prepare(scene)
        return mi.SamplingIntegrator.render(self, scene, sensor, seed, spp, develop, evaluate)

    def sample(self, scene, sampler, ray, medium=None, active=True):
        trace = self.trace(scene, sampler, mi.Ray3f(ray), active)
        return mi.depolarizer(trace.radiance), trace.hit.found, []

    def aov_names(self):
        return []

    def to_string(self) -> str:
        return (
            f"MrtWhitted[max_depth={self.max_depth}, clamp={self.clamp}, "
            f"min_contribution={self.min_contribution:g}, bounce_budget={self.bounce_budget}, sky={self.sky}]"
        )

    # ------------------------------------------- Scene -------------------------------------------------

    def prepare(self, scene) -> Prepared:
        """Read what a render needs from the scene; cheap where nothing has changed since the last call."""
        if self._prepared is None or self._prepared.is_stale(scene):
            self._prepared = Prepared(scene)
        return self._prepared

    # ------------------------------------------- Tracing -----------------------------------------------

    def trace(self, scene, sampler, ray, active=True) -> Trace:
        """Radiance along ``ray`` and its by-products; what is not read from the result is not computed."""
        prepared = self._prepared
        if prepared is None or not prepared.is_of(scene):
            prepared = self.prepare(scene)

        # ------------------------------ The camera ray, first of a peeled loop ------------------------------
        active = mi.Bool(active)
        hit = prepared.intersect(scene, ray, active)
        mirror = self.bounces(prepared)
        shading = self._shade(prepared, scene, sampler, ray, hit, mi.UnpolarizedSpectrum(1), active, mirror)
        if not mirror:
            return Trace(shading.radiance, shading.radiance, hit, mi.UInt32(0), shading.shadow_rays)
        throughput, depth = shading.reflectance, shading.cost
        state = {
            "radiance": shading.radiance,
            "throughput": throughput,
            "ray": prepared.mirror_ray(ray, hit),
            "depth": depth,
            "bounces": mi.UInt32(0),
            "shadow_rays": shading.shadow_rays,
            "active": hit.found & self._continues(prepared, throughput, depth),
            "sampler": sampler if prepared.random else None,
        }

        # ------------------------------------------ Mirror bounces ------------------------------------------
        def bounce(s: dict) -> tuple[dict]:
            ray, active = s["ray"], s["active"]
            hit = prepared.intersect(scene, ray, active)
            shading = self._shade(prepared, scene, s["sampler"], ray, hit, s["throughput"], active, mirror)
            throughput = s["throughput"] * shading.reflectance
            depth = s["depth"] + shading.cost
            return (
                {
                    "radiance": s["radiance"] + dr.select(active, s["throughput"] * shading.radiance, 0),
                    "throughput": throughput,
                    "ray": prepared.mirror_ray(ray, hit),
                    "depth": depth,
                    "bounces": s["bounces"] + 1,
                    "shadow_rays": s["shadow_rays"] + shading.shadow_rays,
                    "active": active & hit.found & self._continues(prepared, throughput, depth),
                    "sampler": s["sampler"],
                },
            )

        (final,) = dr.while_loop((state,), lambda s: s["active"], bounce, label="mirror bounces")
        return Trace(final["radiance"], shading.radiance, hit, final["bounces"], final["shadow_rays"])

    def bounces(self, prepared) -> bool:
        """Can any mirror ray of the scene matter: is one bright enough, and within the bounce budget?"""
        continues = [
            self._continues(prepared, mi.UnpolarizedSpectrum(reflectance), self._cost(mi.Float(int_ior)))
            for reflectance, int_ior in prepared.mirror_bounds
        ]
        return any(c if isinstance(c, bool) else c[0] for c in continues)

    def _continues(self, prepared, throughput, depth):
        """May a path of this throughput and depth still change the picture?"""
        bound = len(prepared.lights) + 1
        return (depth < self.max_depth) & (dr.max(throughput) * bound > self.min_contribution)

    # ------------------------------------------- Shading -----------------------------------------------

    def _shade(self, prepared, scene, sampler, ray, hit, throughput, active, mirror: bool) -> Shading:
        """Light that leaves ``hit`` back along ``ray``, and its mirror reflection if ``mirror``; or the sky.

        ``throughput`` is that of the path up to ``hit``.
        """

        def at_surface(hit, throughput, sampler):
            return self._shade_surface(prepared, scene, sampler, hit, throughput, mirror), sampler

        def nowhere(hit, throughput, sampler):
            black = mi.UnpolarizedSpectrum(0)
            return Shading(black, mi.UInt32(0), black, mi.UInt32(0)), sampler

        # A branch, because packets whose rays all miss are many
        state = hit, throughput, sampler if prepared.random else None
        shading, _ = dr.if_stmt(state, hit.found, at_surface, nowhere, label="surface")
        shading.radiance += self._sky(prepared, ray, but_not(active, hit.found))
        return shading

    def _shade_surface(self, prepared, scene, sampler, hit, throughput, mirror: bool) -> Shading:
        si, radiance = hit.si, mi.UnpolarizedSpectrum(0)
        if prepared.emissive:
            radiance += mi.unpolarized_spectrum(si.emitter(scene, hit.found).eval(si, hit.found))
        unrolled = prepared.lights if prepared.unrolled else []
        samples = [self._light_sample(prepared, light, sampler, hit) for light in unrolled]
        values, reflectance, int_ior = prepared.eval_bsdf(hit, samples, mirror)
        shadow_rays = mi.UInt32(0)
        for sample, value in zip(samples, values, strict=True):
            lit, traced = self._visible_part(prepared, scene, hit, throughput, sample, value)
            radiance += lit
            shadow_rays += traced
        if not prepared.unrolled:
            radiance, shadow_rays = self._loop_over_lights(
                prepared, scene, sampler, hit, throughput, radiance
            )
        return Shading(radiance, shadow_rays, reflectance, self._cost(int_ior))

    def _cost(self, int_ior):
        """What a bounce off a material of this index takes from the bounce budget."""
        if self.bounce_budget == "plain":
            return mi.UInt32(1)
        return mi.UInt32(dr.maximum(10 - mi.Int32(dr.minimum(10 * int_ior, 10)), 1))

    def _loop_over_lights(self, prepared, scene, sampler, hit, throughput, radiance):
        lights = prepared.light_pointers

        def step(i, radiance, shadow_rays, sampler):
            light = dr.gather(mi.EmitterPtr, lights, i, hit.found)
            sample = self._light_sample(prepared, light, sampler, hit)
            (value,), _, _ = prepared.eval_bsdf(hit, [sample], mirror=False)
            lit, traced = self._visible_part(prepared, scene, hit, throughput, sample, value)
            return i + 1, radiance + lit, shadow_rays + traced, sampler

        state = (mi.UInt32(0), radiance, mi.UInt32(0), sampler if prepared.random else None)
        state = dr.while_loop(state, lambda i, *_: hit.found & (i < dr.width(lights)), step, label="lights")
        return state[1], state[2]

    def _light_sample(self, prepared, light, sampler, hit) -> LightSample:
        """The direction to a light and what arrives from it, if nothing is in between."""
        u = sampler.next_2d(hit.found) if prepared.random else mi.Point2f(0.5)
        ds, weight = light.sample_direction(hit.si, u, hit.found)
        wo = hit.si.to_local(ds.d)
        facing = hit.found & (ds.pdf > 0)
        if prepared.one_sided:
            facing &= mi.Frame3f.cos_theta(wo) > 0
        return LightSample(ds, wo, mi.unpolarized_spectrum(weight), facing)

    def _visible_part(self, prepared, scene, hit, throughput, sample, bsdf_value):
        """A light's contribution where nothing blocks it, and the number of shadow rays that took to know."""
        value = sample.weight * bsdf_value
        if self.clamp:
            value = dr.clip(value, 0, 1)
        matters = dr.max(dr.abs(throughput * value)) * len(prepared.lights) > self.min_contribution
        traced = sample.facing & matters
        visible = but_not(sample.facing, prepared.occluded(scene, hit, sample.ds, traced))
        return dr.select(visible, value, 0), dr.select(traced, mi.UInt32(1), mi.UInt32(0))

    def _sky(self, prepared, ray, active):
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -ray.d
        si.wavelengths = ray.wavelengths
        if self.sky is not None:
            return dr.select(active, self.sky.eval(si, active), 0)
        if prepared.environment is None:
            return mi.UnpolarizedSpectrum(0)
        return dr.select(active, mi.unpolarized_spectrum(prepared.environment.eval(si, active)), 0)


def _eval_bsdf(mirror: bool, bsdf, si, wos, facing, active):
    """Of one BSDF: its values f cos θo towards ``wos``, its mirror reflectance and its index of
    refraction."""
    values = [mi.UnpolarizedSpectrum(0) for _ in wos]
    reflectance, int_ior = mi.UnpolarizedSpectrum(0), mi.Float(1)
    if bsdf is None:
        return values, reflectance, int_ior
    context = mi.BSDFContext()
    values = [
        mi.unpolarized_spectrum(bsdf.eval(context, si, wo, seen))
        for wo, seen in zip(wos, facing, strict=True)
    ]
    if mirror and bsdf.has_attribute("mirror_reflectance"):
        reflectance = bsdf.eval_attribute("mirror_reflectance", si, active)
        int_ior = bsdf.eval_attribute_1("int_ior", si, active)
    elif mirror and _has_mirror(bsdf):
        context.type_mask = +mi.BSDFFlags.DeltaReflection
        reflectance = mi.unpolarized_spectrum(bsdf.sample(context, si, mi.Float(0), mi.Point2f(0), active)[1])
    return values, reflectance, int_ior


class Prepared:
    """What the integrator reads from a scene once, before it traces anything, and its ray queries."""

    def __init__(self, scene):
        # Not the scene itself: it owns the integrator, which owns this, and such a ring is never freed
        self.objects = _objects(scene)
        self.fingerprint = _fingerprint(scene)
        shapes = scene.shapes()
        self.planes = _Planes([s for s in shapes if hasattr(s, "unit_normal")])
        self.quadrics = quadrics_of(shapes)
        others = [s for s in shapes if not (hasattr(s, "unit_normal") or is_quadric(s))]
        # The stand-ins of planes and quadrics must not be hit: rays are traced in a scene of the others only
        self.bvh = _scene_of(others) if len(others) < len(shapes) else None
        self.shape_count = len(others)
        self.scales, self.spheres = _Scales(others), _Spheres(others)
        self._read_emitters(scene)
        self._read_bsdfs({id(b): b for b in (s.bsdf() for s in shapes)}.values())
        mergeable = self.bsdfs and all(hasattr(b, "merged") for b in self.bsdfs)
        self.merged = self.bsdfs[0].merged(shapes) if mergeable else None
        self.versions = self._versions()
        meshes = any(s.is_mesh() for s in others)
        if meshes:
            self.ray_flags |= +mi.RayFlags.ShadingFrame
        # Embree's treatment of packets of like rays pays where there are thousands of triangles to meet
        self.coherent = meshes
        # Then a table of centres and radii does the work of a call to every shape
        self.only_spheres = is_jit() and not self.textured and all(map(_is_plain_sphere, others))

    def _read_emitters(self, scene) -> None:
        self.environment = scene.environment()
        self.lights = [e for e in scene.emitters() if not e.is_environment()]
        self.unrolled = len(self.lights) <= UNROLLED_LIGHTS or not is_jit()
        self.light_pointers = None if self.unrolled else pointer("Emitter", self.lights)
        self.light_handling = "unrolled" if self.unrolled else "in a loop"
        delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
        self.random = any(not mi.has_flag(e.flags(), delta) for e in self.lights)
        self.emissive = any(mi.has_flag(e.flags(), mi.EmitterFlags.Surface) for e in self.lights)

    def _read_bsdfs(self, bsdfs) -> None:
        self.bsdfs = bsdfs = list(bsdfs)
        self.mirror_bounds = [
            b.mirror_bound() if hasattr(b, "mirror_bound") else (1.0, 1.0) for b in bsdfs if _has_mirror(b)
        ]
        self.one_sided = not any(mi.has_flag(b.flags(), mi.BSDFFlags.BackSide) for b in bsdfs)
        self.textured = any(mi.has_flag(b.flags(), mi.BSDFFlags.SpatiallyVarying) for b in bsdfs)
        self.ray_flags = +mi.RayFlags.Minimal
        if self.textured:
            self.ray_flags |= +mi.RayFlags.UV

    def is_of(self, scene) -> bool:
        """Is it this scene that was read? The id of a scene may have passed to another one, those of objects
        held here cannot.
        """
        return _objects(scene) == self.objects

    def is_stale(self, scene) -> bool:
        return (
            not self.is_of(scene)
            or self._versions() != self.versions
            or _fingerprint(scene) != self.fingerprint
        )

    def _versions(self) -> list[int]:
        """Change when the parameters of an ``mrt_bsdf`` do, of which bounds are kept."""
        return [getattr(b, "version", 0) for b in self.bsdfs]

    # ----------------------------------------- Ray queries ---------------------------------------------

    def intersect(self, scene, ray, active) -> Hit:
        """The nearest of Mitsuba's shapes, the quadrics and the analytic planes."""
        t, plane, on_plane = self.planes.intersect(ray, active)
        # What lies behind a plane need not be looked for
        ray = mi.Ray3f(ray.o, ray.d, t, ray.time, ray.wavelengths)
        si, found, scale = self._intersect_shapes(scene, ray, active)
        if self.quadrics is not None:
            reach = dr.select(found, si.t, ray.maxt)
            quadric = self.quadrics.intersect(
                mi.Ray3f(ray.o, ray.d, reach, ray.time, ray.wavelengths), active
            )
            closer = active & (quadric[0] < reach)
            self.quadrics.put_into(si, ray, quadric, closer)
            scale = dr.select(closer, self.quadrics.scale(quadric[1], closer), scale)
            found = found | closer
        if self.planes:
            on_plane = but_not(on_plane, found)
            scale = self.planes.put_into(si, ray, plane, on_plane, scale)
            found = found | on_plane
        si.sh_frame = mi.Frame3f(si.sh_frame.n)
        si.wi = si.to_local(-ray.d)
        si.time, si.wavelengths = ray.time, ray.wavelengths
        return Hit(si, found, dr.maximum(scale, dr.max(dr.abs(si.p))))

    def _intersect_shapes(self, scene, ray, active):
        """Interaction with the nearest of Mitsuba's shapes, where there is one, and the size of its
        coordinates.
        """
        if not self.shape_count:
            return dr.zeros(mi.SurfaceInteraction3f), mi.Bool(False), mi.Float(0)
        pi = (self.bvh or scene).ray_intersect_preliminary(ray, self.coherent, active)
        found = active & pi.is_valid()
        if self.only_spheres and not (scene.shapes_grad_enabled() or dr.grad_enabled(ray)):
            si, scale = self.spheres.interaction(pi, ray, found)
            return si, found, scale
        si = pi.compute_surface_interaction(ray, self.ray_flags, found)
        self.spheres.put_back(si, found)
        return si, found, self.scales(si, found)

    def occluded(self, scene, hit, ds, active):
        """Does anything block the segment from ``hit`` to the light sample ``ds``?"""
        o = self._off_surface(hit, ds.d)
        blocked = mi.Bool(False)
        for equation in self.planes.equations:
            # Opposite sides: no distance is computed, so none can be wrong
            blocked |= _height(o, *equation) * _height(ds.p, *equation) < 0
        if not self.shape_count and self.quadrics is None:
            return blocked
        to_light = ds.p - o
        # Stop short of a light that has a surface of its own
        reach = 1 - mi.math.ShadowEpsilon if self.emissive else 1
        ray = mi.Ray3f(o, to_light, reach, hit.si.time, hit.si.wavelengths)
        if self.shape_count:
            blocked |= (self.bvh or scene).ray_test(ray, self.coherent, but_not(active, blocked))
        if self.quadrics is not None:
            blocked |= self.quadrics.occluded(ray, but_not(active, blocked))
        return blocked

    def eval_bsdf(self, hit, samples, mirror: bool):
        """Values of the BSDF at ``hit`` towards light samples, and its mirror reflection: all of it in one
        call."""
        arguments = (hit.si, [s.wo for s in samples], [s.facing for s in samples], hit.found)
        evaluate = partial(_eval_bsdf, mirror)  # dispatch would take a bool among the arguments for its mask
        if not is_jit():
            return evaluate(hit.si.bsdf() if hit.found else None, *arguments)
        if self.merged is None:
            return dr.dispatch(hit.si.bsdf(), evaluate, *arguments)
        # A branch only to keep the code together: mixed with that of shadow rays, it runs out of registers
        return dr.if_stmt(
            arguments, hit.found, partial(evaluate, self.merged), partial(evaluate, None), label="bsdf"
        )

    def mirror_ray(self, ray, hit):
        """The ray reflected at ``hit``."""
        n = hit.si.sh_frame.n
        d = ray.d - 2 * dr.dot(ray.d, n) * n
        return mi.Ray3f(self._off_surface(hit, d), d, FARTHEST, ray.time, ray.wavelengths)

    @staticmethod
    def _off_surface(hit, d):
        """The point of ``hit`` moved to the side of its surface that ``d`` points to, clear of rounding
        errors."""
        distance = OFFSET * hit.scale
        n = hit.si.n
        return hit.si.p + n * dr.select(dr.dot(n, d) >= 0, distance, -distance)


class _Planes:
    """The analytic side of all ``mrt_plane`` shapes, as kernel data."""

    def __init__(self, shapes):
        self.equations = [(mi.Vector3f(s.unit_normal.tolist()), mi.Float(s.distance)) for s in shapes]
        # The same kernel serves every plane of every scene: its numbers are data
        dr.make_opaque(self.equations)
        self.tangents = [Table(mi.Vector3f, [s.tangents[k] for s in shapes]) for k in range(2)]
        self.shapes = Table("Shape", shapes)

    def __len__(self) -> int:
        return len(self.equations)

    def intersect(self, ray, active):
        """Distance of the nearest plane (else ``ray.maxt``), its number, and whether there is one."""
        t, index, found = mi.Float(ray.maxt), mi.UInt32(0), mi.Bool(False)
        for k, (normal, distance) in enumerate(self.equations):
            t_plane = intersect_plane(ray.o, ray.d, normal, distance)
            closer = active & (t_plane < t)
            t = dr.select(closer, t_plane, t)
            index = dr.select(closer, mi.UInt32(k), index)
            found = found | closer
        return t, index, found

    def _equation(self, index):
        """Normal and distance of plane ``index``: of few planes, quicker chosen than looked up."""
        (normal, distance), *others = self.equations
        for k, (n, d) in enumerate(others, start=1):
            normal, distance = dr.select(index == k, n, normal), dr.select(index == k, d, distance)
        return normal, distance

    def put_into(self, si, ray, index, where, scale):
        """Make ``si`` the interaction of ``ray`` with plane ``index`` at t = ray.maxt, and return the size of
        its coordinates; ``scale`` elsewhere.
        """
        n, distance = self._equation(index)
        p = dr.fma(ray.d, ray.maxt, ray.o)
        # Along a grazing ray the error of t is far larger than that of the plane
        p -= n * _height(p, n, distance)
        si.t = dr.select(where, ray.maxt, si.t)
        si.p = dr.select(where, p, si.p)
        si.n = dr.select(where, mi.Normal3f(n), si.n)
        si.sh_frame.n = dr.select(where, mi.Normal3f(n), si.sh_frame.n)
        uv = mi.Point2f(*(dr.dot(tangent(index, where), p) for tangent in self.tangents))
        si.uv = dr.select(where, uv, si.uv)
        si.shape = dr.select(where, self.shapes(index, where), si.shape)
        return dr.select(where, dr.abs(distance), scale)


def _height(p, normal, distance):
    """Signed distance of a point from a plane."""
    return dr.dot(normal, p) + distance


class _Scales:
    """Size of the coordinates of the shape that was hit: the largest number in its bounding box."""

    def __init__(self, shapes):
        sizes = [_coordinate_size(s.bbox()) for s in shapes]
        # The shapes inside an instance are not of the scene's own: the largest for them
        self.by_shape = ByShape(mi.Float, shapes, sizes, max(sizes, default=0.0)) if shapes else None

    def __call__(self, si, found):
        return mi.Float(0) if self.by_shape is None else self.by_shape(si, found)


class _Spheres:
    """Centres and radii of Mitsuba's spheres.

    Mitsuba takes a hit from the distance along the ray. From a hundred radii away that is further off the
    sphere than secondary rays start, and the sphere would lie in its own shadow.
    """

    def __init__(self, shapes):
        rows = [_center_and_radius(s) for s in shapes]
        self.by_shape = (
            ByShape(mi.Vector4f, shapes, rows, [0.0] * 4) if any(any(row) for row in rows) else None
        )

    def interaction(self, pi, ray, found):
        """What ``compute_surface_interaction`` gives, but for derivatives and texture coordinates, and the
        size of the coordinates: spheres only.
        """
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t, si.shape = dr.select(found, pi.t, dr.inf), dr.select(found, pi.shape, None)
        center, radius = self._center_and_radius(si, found)
        n = dr.normalize(dr.fma(ray.d, pi.t, ray.o) - center)
        si.p = dr.fma(n, radius, center)
        si.n = si.sh_frame.n = mi.Normal3f(n)
        return si, dr.max(dr.abs(center)) + radius

    def _center_and_radius(self, si, found):
        row = self.by_shape(si, found)
        return mi.Point3f(row.x, row.y, row.z), row.w

    def put_back(self, si, found) -> None:
        """Move hits of spheres onto them, along the radius."""
        if self.by_shape is None:
            return
        center, radius = self._center_and_radius(si, found)
        p = dr.detach(si.p)
        v = p - center
        length = dr.norm(v)
        on_sphere = found & (radius > 0) & (length > 0)
        # A shift without a derivative: how the hit moves with the sphere is for Mitsuba to say
        si.p += dr.select(on_sphere, center + v * (radius / dr.select(on_sphere, length, 1)) - p, 0)


def _center_and_radius(shape) -> list[float]:
    """Of a sphere; zeros for another shape."""
    if shape.shape_type() != +mi.ShapeType.Sphere:
        return [0.0] * 4
    low, high = ([float(c) for c in corner] for corner in (shape.bbox().min, shape.bbox().max))
    return [0.5 * (a + b) for a, b in zip(low, high, strict=True)] + [0.5 * (high[0] - low[0])]


def _is_plain_sphere(shape) -> bool:
    return shape.shape_type() == +mi.ShapeType.Sphere and not (
        shape.has_flipped_normals() or shape.is_emitter()
    )


def _construct(integrator, props) -> None:
    """Mitsuba logs a warning about every Python integrator in a scalar variant; ``mrt.render`` gives its
    own."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        mi.SamplingIntegrator.__init__(integrator, props)
    finally:
        mi.set_log_level(level)


def _has_mirror(bsdf) -> bool:
    return bsdf.has_attribute("mirror_reflectance") or mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection)


def _scene_of(shapes):
    if not shapes:
        return None
    # Mitsuba names an object after its key, and these belong to another scene: they keep their names
    names = [s.id() or f"shape_{i}" for i, s in enumerate(shapes)]
    if len(set(names)) < len(names):
        names = [f"shape_{i}" for i in range(len(shapes))]
    return mi.load_dict({"type": "scene", **dict(zip(names, shapes, strict=True))})


def _coordinate_size(bbox) -> float:
    return max(abs(float(x)) for corner in (bbox.min, bbox.max) for x in corner)


def _objects(scene) -> list:
    return [*scene.shapes(), *scene.emitters()]


def _fingerprint(scene) -> tuple:
    """Changes whenever a shape was moved or a mesh edited: what ``Prepared`` holds would then be out of
    date."""
    return tuple(_shape_fingerprint(s) for s in scene.shapes())


def _shape_fingerprint(shape) -> tuple:
    bbox = shape.bbox()
    version = shape.vertex_positions_buffer().index if is_jit() and isinstance(shape, mi.Mesh) else 0
    return (version, *bbox.min, *bbox.max)


mi.register_integrator("mrt_whitted", MrtWhitted)
