"""``mrt_whitted``: the report's recursive ray tracer as a Mitsuba integrator."""

from __future__ import annotations

import contextlib
import signal
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..parameters import LARGEST, ParameterError, PluginError, choice, flag, integer, number, spectrum
from ..signals import left_to_other_threads
from ..variants import and_not, construct_quietly, largest
from .facts import Reading
from .plan import BUDGETS, KernelPlan, SceneFacts, make_plan
from .scene_data import Hit, SceneData
from .snapshot import Cache, Snapshot

if TYPE_CHECKING:
    from .buffers import PointBuffer

# A sixteenth of a step of an 8-bit picture: the sum of many cut paths stays below half a step, and on average
# over the report's scenes below 1e-5
MIN_CONTRIBUTION = 1 / 16 / 255

DISCONTINUITY_WARNING = (
    "mrt_whitted: derivatives by shapes leave out how outlines and the edges of shadows move. Of scenes that "
    "Mitsuba can trace as meshes, prb_projective and direct_projective have all of them."
)


@dataclass
class Trace:
    """Radiance of a bundle of camera rays, and by-products."""

    radiance: mi.UnpolarizedSpectrum
    direct: mi.UnpolarizedSpectrum  # the part without specular reflections
    hit: Hit  # of the camera ray
    bounces: mi.UInt32  # specular reflections traced
    shadow_rays: mi.UInt32  # shadow rays traced


@dataclass
class Path:
    """Specular paths, one for each camera ray: the state of the loop over bounces."""

    ray: mi.Ray3f  # the next to be traced
    throughput: mi.UnpolarizedSpectrum  # product of the mirror reflectances so far
    radiance: mi.UnpolarizedSpectrum  # light found so far
    depth: mi.UInt32  # cost of the bounces so far
    bounces: mi.UInt32  # specular reflections traced
    shadow_rays: mi.UInt32  # shadow rays traced
    active: mi.Bool  # paths that go on
    sampler: mi.Sampler  # None where all lights are points


@dataclass
class Sums:
    """Sums over the lights at a hit: the state of the loop over them."""

    radiance: mi.UnpolarizedSpectrum
    shadow_rays: mi.UInt32
    sampler: mi.Sampler  # None where all lights are points


class MrtWhitted(mi.SamplingIntegrator):
    r"""Whitted-style ray tracing: direct light, hard shadows, perfect specular reflections.

    .. math::
        L(x, d) = \sum_i \mathrm{clamp}_{[0,1]}\bigl(E_i f(x, \omega_i, -d) \cos\theta_i\bigr) V_i
                  + k_s F(\theta)\, L(x', r)

    with r the mirror direction, and the sky where a ray meets nothing. Shading goes through ``si.bsdf()``:
    k_s F is the attribute ``mirror_reflectance`` of an ``mrt_bsdf``, and the delta reflection of any other
    BSDF. Lights are all emitters of the scene; those without a delta position take one random sample each.
    ``mrt_plane``, ``mrt_cone``, ``mrt_cylinder`` and ``mrt_group`` shapes are intersected analytically.
    ``hide_emitters`` is refused: surfaces that emit are seen.

    ==================== ======== ============ ===========================================================
    name                 type     default      unit or range
    ==================== ======== ============ ===========================================================
    ``max_depth``        integer  10           >= 1, bounce budget: a ray at this depth is black
    ``sky``              spectrum (from scene) radiance of a miss; default the environment emitter, else 0
    ``clamp``            boolean  true         clamp each light's contribution to [0, 1], as the report does
    ``min_contribution`` float    1/16/255     >= 0; a path ends when what it may still bring is below, and a
                                               light is taken as visible when what it adds, times the number
                                               of lights, is below; see docs/maths.md
    ``bounce_budget``    string   report       ``report``: a bounce costs max(1, 10 - int(10 int_ior));
                                               ``plain``: 1
    ==================== ======== ============ ===========================================================

    .. code-block:: python

        {'type': 'mrt_whitted', 'max_depth': 10, 'clamp': True}

    .. code-block:: xml

        <integrator type="mrt_whitted">
            <integer name="max_depth" value="10"/>
        </integrator>

    Nearest stock plugin: ``direct``, which it equals at ``max_depth`` 1 without clamp. Polarisation is
    ignored.

    Derivatives follow materials, lights and surfaces through the mirror rays; backwards, that takes memory in
    proportion to ``max_depth``. They leave out how outlines and the edges of shadows move with a shape or a
    light: of a shape, that may be most of its derivative, even its sign, and a warning says so once.
    The equation of an ``mrt_plane`` is fixed when it is made; moving its vertices changes only its stand-in
    for other integrators.
    """

    plugin_name = "mrt_whitted"
    #: names of the layers for which ``trace`` returns what they need, next to those of the first hit
    provided_layers = frozenset({"direct", "reflection", "bounces", "shadow_rays"})

    def __init__(self, props: mi.Properties) -> None:
        construct_quietly(self, props)
        if props.get("hide_emitters", False):
            raise ParameterError('mrt_whitted: "hide_emitters" is not accepted; remove the emitter\'s shape')
        self.max_depth = integer(props, "max_depth", 10, least=1, most=2**32 - 1)
        self.sky: mi.Texture = spectrum(props, "sky", emissive=True) if "sky" in props else None
        self.clamp = flag(props, "clamp", True)
        self.min_contribution = number(props, "min_contribution", MIN_CONTRIBUTION, least=0)
        self.bounce_budget = choice(props, "bounce_budget", BUDGETS)
        self._snapshot: Snapshot | None = None  # of the scene that was looked at last
        self._cache = Cache()
        self._warned = False  # of outlines
        self._rendering: SceneData | None = None  # what ``sample`` traces while ``render`` runs

    # ------------------------------------- Mitsuba's interface ----------------------------------------

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        before = self._rendering
        with left_to_other_threads():
            self._rendering = self.prepare(scene)
            # Mitsuba calls this under a handler of Ctrl-C that would take itself for the one before it. Only
            # the main thread may set one, and only one of Python's
            with contextlib.suppress(ValueError, TypeError):
                signal.signal(signal.SIGINT, signal.getsignal(signal.SIGINT))
            try:
                return mi.SamplingIntegrator.render(self, scene, sensor, seed, spp, develop, evaluate)
            finally:
                self._rendering = before

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
        trace = self.trace(scene, sampler, mi.Ray3f(ray), active, self._rendering)
        return mi.depolarizer(trace.radiance), trace.hit.found, []

    def to_string(self) -> str:
        return (
            f"MrtWhitted[max_depth={self.max_depth}, clamp={self.clamp}, "
            f"min_contribution={self.min_contribution:g}, bounce_budget={self.bounce_budget}, sky={self.sky}]"
        )

    # ------------------------------------------- Plan --------------------------------------------------

    def kernel_plan(self, facts: SceneFacts) -> KernelPlan:
        """Decide what the kernels for such a scene hold."""
        return make_plan(facts, self, None if self.sky is None else largest(self.sky))

    def prepare(self, scene: mi.Scene) -> SceneData:
        """Read a scene as it is now, and make the data of the kernels for ``trace``.

        Cheap where nothing has changed since the last call.
        """
        self._snapshot = Snapshot(scene, self._snapshot)
        if self._snapshot.shape_part.differentiated and not self._warned:
            self._warned = True
            mi.Log(mi.LogLevel.Warn, DISCONTINUITY_WARNING)
        reading = Reading(self._snapshot, self._cache)
        return SceneData(scene, reading, self.kernel_plan(reading.facts), self._cache)

    # ------------------------------------------- Tracing -----------------------------------------------

    def trace(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler | None,
        ray: mi.Ray3f,
        active: mi.Bool = True,
        data: SceneData | None = None,
    ) -> Trace:
        """Return the radiance along ``ray`` and by-products; Dr.Jit computes only those that are read.

        ``data``: from ``prepare``, which is called without it, for the scene as it is now.
        """
        data = self.prepare(scene) if data is None else data
        try:
            return self._trace(data, sampler, ray, active)
        except Exception as error:
            described = _plugin_error(error)
            if described is None:
                raise
            raise described from error

    def _trace(self, data: SceneData, sampler: mi.Sampler | None, ray: mi.Ray3f, active: mi.Bool) -> Trace:
        path = Path(
            ray,
            throughput=mi.UnpolarizedSpectrum(1),
            radiance=mi.UnpolarizedSpectrum(0),
            depth=mi.UInt32(0),
            bounces=mi.UInt32(0),
            shadow_rays=mi.UInt32(0),
            active=mi.Bool(active),
            sampler=sampler if data.facts.random_lights else None,
        )
        # The camera ray, which the layers look at, comes before the loop
        eye = data.eye_buffers[0][0] if data.eye_buffers else None
        path, hit = self._follow(data, path, eye)
        direct = path.radiance
        if data.plan.mirrors:

            def bounce(path: Path) -> tuple[Path]:
                bounces = path.bounces + 1
                path, _ = self._follow(data, path)
                path.bounces = bounces
                return (path,)

            (path,) = dr.while_loop(
                (path,),
                attrgetter("active"),
                bounce,
                label="mirror bounces",
                # Derivatives are propagated backwards through as many, whose state is stored
                max_iterations=self.max_depth if data.facts.differentiated else None,
            )
        return Trace(path.radiance, direct, hit, path.bounces, path.shadow_rays)

    def _follow(self, data: SceneData, path: Path, eye: PointBuffer | None = None) -> tuple[Path, Hit]:
        """Trace the next ray of each path; return the paths after it, and its hit."""
        hit = data.intersect(path.ray, path.active, eye)
        radiance, shadow_rays, reflectance, cost = self._shade(data, path, hit)
        # Finite, as an infinite one times no light would be NaN
        throughput = dr.minimum(path.throughput * reflectance, LARGEST)
        depth = path.depth + cost
        # Without a known bound, paths end where nothing is left: zero times infinity exceeds nothing
        goes_on = (depth < self.max_depth) & (dr.max(throughput) * data.path_bound > self.min_contribution)
        after = Path(
            data.mirror_ray(path.ray, hit),
            throughput=throughput,
            radiance=path.radiance + path.throughput * radiance,
            depth=depth,
            bounces=path.bounces,
            shadow_rays=path.shadow_rays + shadow_rays,
            active=hit.found & goes_on,
            sampler=path.sampler,
        )
        return after, hit

    # ------------------------------------------- Shading -----------------------------------------------

    def _shade(
        self, data: SceneData, path: Path, hit: Hit
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UInt32, mi.UnpolarizedSpectrum, mi.UInt32]:
        """Return the light that leaves ``hit`` back along the ray of ``path``, or the sky; the number of
        shadow rays; and the reflectance of the mirror ray and its cost in the bounce budget.
        """
        # A branch: in many packets every ray misses
        state = hit, path.throughput, path.sampler
        shade = partial(self._shade_surface, data)
        radiance, *others, _ = dr.if_stmt(state, hit.found, shade, _shade_nothing, label="surface")
        if data.plan.sky != "none":
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.wi = -path.ray.d
            si.wavelengths = path.ray.wavelengths
            away = and_not(path.active, hit.found)
            sky = self.sky if data.plan.sky == "parameter" else data.environment
            radiance += dr.select(away, mi.unpolarized_spectrum(sky.eval(si, away)), 0)
        return radiance, *others

    def _shade_surface(
        self, data: SceneData, hit: Hit, throughput: mi.UnpolarizedSpectrum, sampler: mi.Sampler | None
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UInt32, mi.UnpolarizedSpectrum, mi.UInt32, mi.Sampler | None]:
        plan = data.plan
        si = hit.si
        sums = Sums(mi.UnpolarizedSpectrum(0), mi.UInt32(0), sampler)
        emitter = si.emitter(data.scene, hit.found) if data.facts.surface_emitters else None
        if emitter is not None:  # as it is of most surfaces in scalar variants
            sums.radiance += mi.unpolarized_spectrum(emitter.eval(si, hit.found))
        add = partial(self._add_lights, data, hit, throughput)
        sums, reflectance, int_ior = add(range(data.lights.unrolled), sums, mirror=plan.mirrors)
        if plan.lights in ("loop", "table"):

            def add_next(light: mi.UInt32, sums: Sums) -> tuple[mi.UInt32, Sums]:
                return light + 1, add([light], sums, mirror=False)[0]

            def is_left(light: mi.UInt32, sums: Sums) -> mi.Bool:
                return hit.found & (light < data.lights.count)

            _, sums = dr.while_loop((mi.UInt32(0), sums), is_left, add_next, label="lights")
        cost = mi.UInt32(1)
        if self.bounce_budget == "report":
            tenths = mi.Int32(dr.minimum(10 * int_ior, 10))
            cost = mi.UInt32(dr.maximum(10 - tenths, 1))
        return sums.radiance, sums.shadow_rays, reflectance, cost, sums.sampler

    def _add_lights(
        self,
        data: SceneData,
        hit: Hit,
        throughput: mi.UnpolarizedSpectrum,
        lights: Sequence[int | mi.UInt32],
        sums: Sums,
        *,
        mirror: bool,
    ) -> tuple[Sums, mi.UnpolarizedSpectrum, mi.Float]:
        """Add the contributions of some lights, and the shadow rays traced for them.

        Returns the sums, and the mirror reflectance and its index of refraction, which come from the same
        call.
        """
        si = hit.si
        samples = []
        for light in lights:
            u = sums.sampler.next_2d(hit.found) if data.facts.random_lights else mi.Point2f(0.5)
            ds, arriving = data.lights.sample(light, si, u, hit.found)
            samples.append((light, ds, mi.unpolarized_spectrum(arriving), hit.found & (ds.pdf > 0)))
        wos = [si.to_local(ds.d) for _, ds, _, _ in samples]
        facing = [lit for *_, lit in samples]
        values, reflectance, int_ior = data.eval_bsdf(hit, wos, facing, mirror)
        radiance = sums.radiance
        shadow_rays = sums.shadow_rays
        for (light, ds, arriving, lit), bsdf_value in zip(samples, values, strict=True):
            value = arriving * bsdf_value
            if self.clamp:
                value = dr.clip(value, 0, 1)
            share = dr.max(dr.abs(throughput * value))
            traced = lit & (share * data.plan.contribution_bounds[1] > self.min_contribution)
            visible = and_not(lit, data.occluded(hit, light, ds, traced))
            radiance = radiance + dr.select(visible, value, 0)
            shadow_rays = shadow_rays + dr.select(traced, mi.UInt32(1), mi.UInt32(0))
        return Sums(radiance, shadow_rays, sums.sampler), reflectance, int_ior


def _shade_nothing(
    hit: Hit, throughput: mi.UnpolarizedSpectrum, sampler: mi.Sampler | None
) -> tuple[mi.UnpolarizedSpectrum, mi.UInt32, mi.UnpolarizedSpectrum, mi.UInt32, mi.Sampler | None]:
    # Dr.Jit writes results into what a branch returns, and runs branches anew for derivatives: two objects
    black = mi.UnpolarizedSpectrum(0)
    no_mirror = mi.UnpolarizedSpectrum(0)
    return black, mi.UInt32(0), no_mirror, mi.UInt32(0), sampler


def _plugin_error(error: BaseException) -> PluginError | None:
    """Return an error that names the plugin which raised, and its message, where Dr.Jit's own says "see
    above"; None for an error that is nobody's.
    """
    cause = error
    while cause.__cause__ is not None:
        cause = cause.__cause__
    if not isinstance(cause, Exception):  # an interrupt
        return None
    for frame, _ in reversed(list(traceback.walk_tb(cause.__traceback__))):
        plugin = frame.f_locals.get("self")
        if isinstance(plugin, mi.Object) and not isinstance(plugin, MrtWhitted):
            name = type(plugin).__name__
            function = frame.f_code.co_name
            return PluginError(f"mrt_whitted: {name}.{function} raised {type(cause).__name__}: {cause}")
    return None if cause is error else PluginError(f"mrt_whitted: {cause}")
