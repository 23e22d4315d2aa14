"""Camera rays and values of integrators along them, from which the layers are made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.files.layers import FIRST_HIT, TABLE
from mrt_mitsuba.plugins import classes_of, is_known
from mrt_mitsuba.plugins.parameters import ParameterError
from mrt_mitsuba.plugins.variants import is_jit, text_of
from mrt_mitsuba.plugins.whitted.plan import KernelPlan, SceneFacts
from mrt_mitsuba.rendering.film import Film
from mrt_mitsuba.scene.open import Source

if TYPE_CHECKING:
    from mrt_mitsuba.plugins.whitted.integrator import Trace
    from mrt_mitsuba.plugins.whitted.scene_data import SceneData


OF_FILMS = "RGBAW"  # channels of their own, a letter each


class RayValues:
    """Values along camera rays by the names of layers, computed only where a layer is traced.

    ``valid``: whether the integrator found anything, Mitsuba's alpha; ``aovs``: its own channels;
    ``trace``: the result of an integrator with a ``kernel_plan``; None for any other, where Mitsuba finds the
    first hit.
    """

    def __init__(
        self,
        shader: Shader,
        ray: mi.Ray3f,
        weight: mi.Spectrum,
        radiance: mi.UnpolarizedSpectrum,
        valid: mi.Bool,
        *,
        aovs: Sequence[mi.Float] = (),
        trace: Trace | Any = None,
    ) -> None:
        self.shader = shader
        self.ray = ray
        self.trace = trace
        self.weight = mi.unpolarized_spectrum(weight)
        self.valid = valid
        self.aovs = aovs
        self.spectrum = radiance * self.weight  #: radiance with the sensor's weight
        self.image = to_rgb(self.spectrum, ray)
        if trace is not None:
            self.si = trace.hit.si
            self.found = trace.hit.found

    @cached_property
    def si(self) -> mi.SurfaceInteraction3f:
        """Interaction at the first hit."""
        return self.shader.scene.ray_intersect(mi.Ray3f(self.ray))

    @cached_property
    def found(self) -> mi.Bool:
        """True where rays hit anything."""
        return self.si.is_valid()

    @property
    def depth(self) -> mi.Float:
        """Distance of the first hit from the camera; along the ray where the sensor has no single origin."""
        sensor = self.shader.sensor
        distance = self.si.t
        if sensor.class_name() in ("PerspectiveCamera", "ThinLensCamera"):
            # not si.t: rays start at the near plane
            eye = mi.Point3f(sensor.world_transform().translation()) + self.shader.shift(self.si.time)
            distance = dr.norm(self.si.p - eye)
        return dr.select(self.found, distance, math.inf)

    @property
    def normal(self) -> mi.Vector3f:
        """Geometric normal at the first hit; 0 for a miss."""
        return dr.select(self.found, mi.Vector3f(self.si.n), 0)

    @property
    def albedo(self) -> mi.Color3f:
        """Diffuse reflectance at the first hit; 0 for a miss."""
        albedo = mi.UnpolarizedSpectrum(0)
        if is_jit() or self.found:
            bsdf = self.si.bsdf(mi.RayDifferential3f(self.ray))
            albedo = mi.UnpolarizedSpectrum(bsdf.eval_diffuse_reflectance(self.si, self.found))
        return to_rgb(dr.select(self.found, albedo, 0), self.ray)

    @property
    def square(self) -> mi.Color3f:
        """Square of the picture."""
        return self.image * self.image

    # Of an integrator with a trace

    @property
    def direct(self) -> mi.Color3f:
        """Linear sRGB without specular reflections, with the sensor's weight."""
        return to_rgb(self.trace.direct * self.weight, self.ray)

    @property
    def reflection(self) -> mi.Color3f:
        """Linear sRGB that specular reflections add, with the sensor's weight."""
        return to_rgb((self.trace.radiance - self.trace.direct) * self.weight, self.ray)

    @property
    def bounces(self) -> mi.Float:
        """Number of specular reflections."""
        return self.trace.bounces

    @property
    def shadow_rays(self) -> mi.Float:
        """Number of shadow rays."""
        return self.trace.shadow_rays


class Shader:
    """An integrator on a scene, seen by a camera that moves by ``motion`` from time 0 to 1.

    ``mrt_whitted`` has a plan of its kernels and knows layers of its own; any other integrator that follows
    camera rays gives the picture, and Mitsuba the first hit; the rest give whole pictures and no layers.
    """

    facts: SceneFacts | None = None  #: what its kernels depend on; None where it does not say
    kernel: KernelPlan | None = None  #: what its kernels hold
    random = True  #: whether it draws random numbers
    whole = False  #: whether it gives whole pictures only

    def __init__(self, source: Source, motion: Sequence[float] | None) -> None:
        integrator = source.integrator
        self.scene = source.scene
        self.sensor = source.sensor
        self.motion = motion
        self.width = source.width
        self.height = source.height
        self.film = Film(source.sensor)
        self.integrator = integrator
        self.name = integrator.class_name()
        self._data: SceneData | None = None
        #: names of those that can be traced, without internal ones
        self.layers = frozenset(name for name, layer in TABLE.items() if layer.source == FIRST_HIT)
        self._derivatives = isinstance(integrator, mi.CppADIntegrator)  # such as prb
        if isinstance(integrator, classes_of("mrt_whitted")):
            try:
                self._data = integrator.prepare(self.scene)
            except ParameterError as error:
                raise SceneError(str(error)) from None
            self.name = integrator.plugin_name
            self.facts = self._data.facts
            self.kernel = self._data.plan
            self.random = self.facts.random_lights > 0
            self.layers |= integrator.provided_layers
        else:
            if self._derivatives:
                self.name = type(integrator).__name__
            self.whole = (
                not isinstance(integrator, mi.SamplingIntegrator)
                or "StokesIntegrator" in text_of(integrator)  # Mitsuba would crash in its sample
                or _depth(integrator, "render") < _depth(integrator, "sample")
            )
            if self.whole:
                self.layers = frozenset()
        self.aovs = tuple(integrator.aov_names())  #: names of the integrator's own channels
        names = [*OF_FILMS, *self.aovs]
        twice = sorted({name for name in self.aovs if names.count(name) > 1})
        if twice:  # Mitsuba's films refuse them, too
            raise SceneError(
                f"the integrator and films have several channels named {twice[0]}; name each differently"
            )

    def read(self) -> list[Any] | None:
        """All that the kernels of ``values`` read; None where they may read anything."""
        arrays = None if self._data is None else self._data.arrays()
        sky = getattr(self.integrator, "sky", None)
        if arrays is None or (sky is not None and not all(map(is_known, mi.traverse(sky).hierarchy))):
            return None
        return [arrays, sky, self.sensor]

    def shift(self, time: mi.Float) -> mi.Vector3f:
        """Displacement of the camera at a time."""
        if self.motion is None:
            return mi.Vector3f(0)
        return (dr.opaque(mi.Vector3f, self.motion) if is_jit() else mi.Vector3f(self.motion)) * time

    def values(self, place: mi.Point2f, time: mi.Float | None, sampler: mi.Sampler) -> RayValues:
        """Trace rays through positions in the picture, [0, 1]², for their values.

        ``time``: from 0, when the shutter opens, to 1; None: the sampler draws it, as for Mitsuba's sensors.
        Draws what Mitsuba's integrators draw, in their order.
        """
        sensor = self.sensor
        moment = time
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        if time is None:
            moment = mi.Float(sensor.shutter_open())
            if sensor.shutter_open_time() > 0:
                moment += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        ray, weight = sensor.sample_ray_differential(moment, wavelength, place, aperture)
        if self.motion is not None:
            ray.time = sampler.next_1d() if time is None else time
            ray.o += self.shift(ray.time)
        if self._data is not None:
            trace = self.integrator.trace(self.scene, sampler, ray, True, self._data)
            return RayValues(self, ray, weight, trace.radiance, trace.hit.found, trace=trace)
        differential = mi.RayDifferential3f(ray)
        if self._derivatives:
            primal = {"mode": dr.ADMode.Primal, "δL": None, "δaovs": None, "state_in": None}
            start = {"ray": differential, "depth": mi.UInt32(0), "active": mi.Bool(True)}
            sample = self.integrator.sample
            radiance, valid, aovs, _ = sample(scene=self.scene, sampler=sampler, **start, **primal)
        else:
            medium = sensor.get_medium()  # that the camera is in
            radiance, valid, aovs = self.integrator.sample(self.scene, sampler, differential, medium)
        return RayValues(self, ray, weight, mi.unpolarized_spectrum(radiance), valid, aovs=aovs)


def _depth(integrator: mi.Integrator, method: str) -> int:
    """The place of the class that defines a method among those that an integrator derives from."""
    return next(depth for depth, each in enumerate(type(integrator).__mro__) if method in vars(each))


def camera_matrices(sensor: mi.Sensor) -> dict[str, np.ndarray]:
    """The matrices of a camera, float64 [4, 4] for row vectors on their left, as EXR defines them.

    ``worldToCamera``: to a camera at the origin that looks along -z, with x to the right and y up.
    ``worldToNDC``, of pinhole cameras: to the picture, x from 0 to 1 to the right and y downwards.
    Source: OpenEXR, "Standard Attributes".
    """
    to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    if not np.isfinite(to_world).all() or np.linalg.matrix_rank(to_world) < 4:
        return {}
    from_world = np.linalg.inv(to_world)
    # Mitsuba's cameras look along +z, with x to the left
    matrices = {"worldToCamera": (np.diag([-1.0, 1.0, -1.0, 1.0]) @ from_world).T}
    numbers = mi.traverse(sensor)
    if "x_fov" in numbers:
        film = sensor.film()
        names = ("principal_point_offset_x", "principal_point_offset_y")
        shift = [np.array(numbers.get(name, 0.0)).item() for name in names]  # which Mitsuba leaves out
        projection = np.array(sensor.projection_transform().matrix, np.float64).reshape(4, 4)
        projection[:2, 2] -= np.multiply(shift, film.size()) / film.crop_size()
        matrices["worldToNDC"] = (projection @ from_world).T
    return matrices


def to_rgb(spectrum: mi.UnpolarizedSpectrum, ray: mi.Ray3f) -> mi.Color3f:
    """The linear sRGB of a spectrum in the current variant."""
    if mi.is_spectral:
        xyz = sum(
            mi.cie1931_xyz(wavelength) * value
            for wavelength, value in zip(ray.wavelengths, spectrum, strict=True)
        )
        return mi.xyz_to_srgb(xyz * (mi.MI_CIE_Y_NORMALIZATION / len(spectrum)))
    if mi.is_monochromatic:
        return mi.Color3f(spectrum[0])
    return mi.Color3f(spectrum)
