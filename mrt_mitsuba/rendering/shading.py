"""Values of integrators along camera rays, from which the layers are made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.output.layers import FIRST_HIT, named
from mrt_mitsuba.plugins.kernel_plan import KernelPlan, SceneFacts
from mrt_mitsuba.plugins.parameters import ParameterError


@dataclass(frozen=True)
class View:
    """A sensor, the size of its picture in pixels, and the camera's way from time 0 to 1."""

    sensor: Any
    width: int
    height: int
    motion: Sequence[float] | None = None

    def rays(self, place: Any, time: Any, sampler: Any) -> tuple[Any, Any]:
        """Return the rays through places in the picture, [0, 1]², and their weights.

        ``time``: from 0, when the shutter opens, to 1; None: the sampler draws it, as for Mitsuba's sensors.
        Draws what Mitsuba's integrators draw, in their order.
        """
        sensor, moment = self.sensor, time
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        if time is None:
            moment = mi.Float(sensor.shutter_open())
            if sensor.shutter_open_time() > 0:
                moment += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        ray, weight = sensor.sample_ray_differential(moment, wavelength, place, aperture)
        if self.motion is not None:
            ray.time = sampler.next_1d() if time is None else time
            ray.o += self._shift(ray.time)
        return ray, weight

    def distance(self, si: Any) -> Any:
        """Return the distance of a hit from the eye; along the ray where the sensor has no single eye."""
        if self.sensor.class_name() not in ("PerspectiveCamera", "ThinLensCamera"):
            return si.t
        # not si.t: rays start at the near plane
        eye = mi.Point3f(self.sensor.world_transform().translation())
        if self.motion is not None:
            eye += self._shift(si.time)
        return dr.norm(si.p - eye)

    def _shift(self, time: Any) -> Any:
        if mi.variant().startswith("scalar"):
            return mi.Vector3f(self.motion) * time
        return dr.opaque(mi.Vector3f, self.motion) * time

    def matrices(self) -> dict[str, np.ndarray]:
        """Return the camera's matrices, float64 [4, 4] for row vectors on their left, as EXR defines them.

        ``worldToCamera``: to a camera at the origin that looks along -z, with x to the right and y up.
        ``worldToNDC``, of pinhole cameras: to the picture, x from 0 to 1 to the right and y downwards.
        Source: OpenEXR, "Standard Attributes".
        """
        to_world = np.array(self.sensor.world_transform().matrix, np.float64).reshape(4, 4)
        if not np.isfinite(to_world).all() or np.linalg.matrix_rank(to_world) < 4:
            return {}
        # Mitsuba's cameras look along +z, with x to the left
        found = {"worldToCamera": np.diag([-1.0, 1.0, -1.0, 1.0]) @ np.linalg.inv(to_world)}
        numbers, film = mi.traverse(self.sensor), self.sensor.film()
        names = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
        fov, *shift = (np.array(numbers.get(name, 0.0)).item() for name in names)
        if fov:
            size, crop = np.array(film.size(), float), np.array(film.crop_size(), float)
            pixels = size[0] / (2 * np.tan(np.deg2rad(fov) / 2))  # at a distance of one
            centre = (0.5 - np.array(shift)) * size - np.array(film.crop_offset(), float)
            rows = [
                [pixels / crop[0], 0, -centre[0] / crop[0], 0],
                [0, -pixels / crop[1], -centre[1] / crop[1], 0],
            ]
            projection = np.array([*rows, [0, 0, 1, 0], [0, 0, -1, 0]])
            found["worldToNDC"] = projection @ found["worldToCamera"]
        return {name: matrix.T for name, matrix in found.items()}


class RayValues:
    """Values along camera rays, for the rows of the table of layers; what no row reads costs nothing.

    ``trace``: what one with a ``kernel_plan`` found; None of any other, where Mitsuba finds the first hit.
    """

    def __init__(
        self, scene: Any, view: View, ray: Any, weight: Any, radiance: Any, trace: Any = None
    ) -> None:
        self.scene, self.view, self.ray, self.trace = scene, view, ray, trace
        self.weight = mi.unpolarized_spectrum(weight)
        self.spectrum = radiance * self.weight  #: radiance with the sensor's weight
        self.image = to_rgb(self.spectrum, ray)
        self.valid = trace.hit.found if trace else None  #: did the integrator find anything; Mitsuba's alpha
        self.aovs: Sequence[Any] = ()  #: channels of the integrator's own

    @cached_property
    def si(self) -> Any:
        """Interaction at the first hit."""
        return self.trace.hit.si if self.trace else self.scene.ray_intersect(mi.Ray3f(self.ray))

    @property
    def found(self) -> Any:
        """Is there a first hit."""
        return self.trace.hit.found if self.trace else self.si.is_valid()

    def at_hit(self, kind: str, value: Any, miss: float = 0) -> Any:
        """Return a value, of a type of Mitsuba's, where something is hit, and another elsewhere."""
        return dr.select(self.found, getattr(mi, kind)(value), miss)

    def rgb(self, spectrum: Any) -> Any:
        """Return the linear sRGB of a radiance along the rays, with the sensor's weight."""
        return to_rgb(spectrum * self.weight, self.ray)

    @property
    def shape(self) -> Any:
        """Number of the scene's shape that is hit first, from 1; 0 for a miss."""
        hit, shapes = mi.SurfaceInteraction3f(self.si), self.scene.shapes()
        if mi.variant().startswith("scalar"):
            hit.shape = hit.instance or hit.shape
        else:
            hit.shape = dr.select(hit.instance != None, hit.instance, hit.shape)  # noqa: E711 - lane by lane
        return self._row_of_shape(hit, range(1, len(shapes) + 1))

    @property
    def material(self) -> Any:
        """Number of the material that is hit first, from 1 in the order of the shapes; 0 for a miss, and in
        an instance."""
        numbers = dict[int, int]()
        materials = [shape.bsdf() for shape in self.scene.shapes()]  # kept, so that each has an id of its own
        rows = [numbers.setdefault(id(material), len(numbers) + 1) for material in materials]
        return self._row_of_shape(self.si, rows)

    def _row_of_shape(self, hit: Any, rows: Sequence[int]) -> Any:
        from mrt_mitsuba.plugins.lookup import ByShape

        return ByShape(mi.Float, self.scene.shapes(), rows, 0.0)(hit, self.found)

    @property
    def albedo(self) -> Any:
        """Diffuse reflectance at the first hit; 0 for a miss."""
        albedo = mi.UnpolarizedSpectrum(0)
        if not mi.variant().startswith("scalar") or self.found:
            bsdf = self.si.bsdf(mi.RayDifferential3f(self.ray))
            albedo = bsdf.eval_diffuse_reflectance(self.si, self.found)
        return to_rgb(self.at_hit("UnpolarizedSpectrum", albedo), self.ray)


class Shader:
    """An integrator on a scene.

    One with a ``kernel_plan`` knows layers of its own; any other that follows camera rays gives the picture,
    and Mitsuba the first hit; the rest give whole pictures only, and no layers.
    """

    facts: SceneFacts | None = None  #: what its kernels depend on; None where it does not say
    kernel: KernelPlan | None = None  #: what its kernels hold
    random = True  #: does it draw random numbers
    layers = named(FIRST_HIT)  #: names of those that can be traced, but for internal ones

    def __init__(self, scene: Any, integrator: Any) -> None:
        self.scene, self.integrator, self.name = scene, integrator, integrator.class_name()
        self.layered = hasattr(integrator, "kernel_plan")
        self._derivatives = isinstance(integrator, mi.CppADIntegrator)  # such as prb
        if self.layered:
            try:
                self._reading = integrator.read(scene)
            except ParameterError as error:
                raise SceneError(str(error)) from None
            self.name, self.facts = integrator.plugin_name, self._reading.facts
            self.kernel = integrator.kernel_plan(self.facts)
            self.random = self.kernel.random
            self.layers |= integrator.provided_layers()
        elif self._derivatives:
            self.name = type(integrator).__name__
        elif not isinstance(integrator, mi.SamplingIntegrator) or "StokesIntegrator" in repr(integrator):
            # Mitsuba would crash in a sample of stokes, also inside another
            self.layers = frozenset()
        self.aovs = tuple(integrator.aov_names())  #: names of the integrator's own channels

    def prepare(self, kernel: KernelPlan | None) -> None:
        """Get ready to trace by a plan of the kernels."""
        if self.layered:
            self._data = self.integrator.prepare(self.scene, kernel, self._reading)

    def values(self, view: View, ray: Any, weight: Any, sampler: Any) -> RayValues:
        """Return what is known along rays with these weights."""
        if self.layered:
            trace = self.integrator.trace(self.scene, sampler, ray, True, self._data)
            return RayValues(self.scene, view, ray, weight, trace.radiance, trace)
        differential = mi.RayDifferential3f(ray)
        if self._derivatives:
            nothing = {"δL": None, "δaovs": None, "state_in": None}
            radiance, valid, aovs, _ = self.integrator.sample(
                mode=dr.ADMode.Primal, scene=self.scene, sampler=sampler, ray=differential,
                depth=mi.UInt32(0), active=mi.Bool(True), **nothing,
            )  # fmt: skip
        else:
            medium = view.sensor.get_medium()  # that the camera is in
            radiance, valid, aovs = self.integrator.sample(self.scene, sampler, differential, medium)
        values = RayValues(self.scene, view, ray, weight, mi.unpolarized_spectrum(radiance))
        values.valid, values.aovs = valid, aovs
        return values


def to_rgb(spectrum: Any, ray: Any) -> Any:
    """Return the linear sRGB of a spectrum in the current variant."""
    if mi.is_spectral:
        xyz = sum(
            mi.cie1931_xyz(wavelength) * value
            for wavelength, value in zip(ray.wavelengths, spectrum, strict=True)
        )
        return mi.xyz_to_srgb(xyz * (mi.MI_CIE_Y_NORMALIZATION / len(spectrum)))
    if mi.is_monochromatic:
        return mi.Color3f(spectrum[0])
    return mi.Color3f(spectrum)
