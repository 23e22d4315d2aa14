"""A scene as seen by a sensor: camera rays, and distances from the eye."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.rays.bundle import Samples


@dataclass(frozen=True)
class View:
    """A sensor, the size of its picture in pixels, and the camera's way from time 0 to 1."""

    sensor: Any
    width: int
    height: int
    motion: tuple[float, float, float] | None = None

    def rays(self, samples: Samples, sampler: Any) -> tuple[Any, Any]:
        """Return the rays through some places on the film, and their weights."""
        import mitsuba as mi

        aperture = sampler.next_2d() if self.sensor.needs_aperture_sample() else mi.Point2f(0.5)
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        ray, weight = self.sensor.sample_ray(mi.Float(samples.time), wavelength, samples.place, aperture)
        return self.moved(mi.Ray3f(ray), samples.time), weight

    def moved(self, ray: Any, time: Any) -> Any:
        """Return a ray as the camera sees it on its way, at a time from 0 to 1."""
        if self.motion is not None:
            ray.o += self._shift(time)
            ray.time = time
        return ray

    def distance(self, si: Any) -> Any:
        """Return the distance of a hit from the eye; along the ray where the sensor has no single eye."""
        import drjit as dr
        import mitsuba as mi

        if self.sensor.class_name() not in ("PerspectiveCamera", "ThinLensCamera"):
            return si.t
        # not si.t: rays start at the near plane
        eye = mi.Point3f(self.sensor.world_transform().translation())
        if self.motion is not None:
            eye += self._shift(si.time)
        return dr.norm(si.p - eye)

    def _shift(self, time: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        scalar = mi.variant().startswith("scalar")
        way = mi.Vector3f(self.motion) if scalar else dr.opaque(mi.Vector3f, self.motion)
        return mi.Vector3f(way) * time
