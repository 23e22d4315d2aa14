"""A scene as seen by a sensor: camera rays, and distances from the eye."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

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

    def matrices(self) -> dict[str, np.ndarray]:
        """Return the camera's matrices, float64 [4, 4] for row vectors on their left, as EXR defines them.

        ``worldToCamera``: to a camera at the origin that looks along -z, with x to the right and y up.
        ``worldToNDC``, of pinhole cameras: to the picture, x from 0 to 1 to the right and y downwards.
        Source: OpenEXR, "Standard Attributes".
        """
        import mitsuba as mi

        to_world = np.array(self.sensor.world_transform().matrix, np.float64).reshape(4, 4)
        if not np.isfinite(to_world).all() or np.linalg.matrix_rank(to_world) < 4:
            return {}
        # Mitsuba's cameras look along +z, with x to the left
        to_camera = np.diag([-1.0, 1.0, -1.0, 1.0]) @ np.linalg.inv(to_world)
        found = {"worldToCamera": to_camera}
        parameters = mi.traverse(self.sensor)
        if "x_fov" in parameters:
            film = self.sensor.film()
            size, crop, start = (
                np.array(getattr(film, name)(), float) for name in ("size", "crop_size", "crop_offset")
            )
            names = [f"principal_point_offset_{axis}" for axis in "xy"]  # where the plugin has them
            shift = [np.array(parameters[name]).item() if name in parameters else 0.0 for name in names]
            half = np.tan(np.deg2rad(np.array(parameters["x_fov"]).item()) / 2)
            pixels = size[0] / (2 * half)  # at a distance of one
            centre = (0.5 - np.array(shift)) * size - start
            projection = np.array(
                [
                    [pixels / crop[0], 0, -centre[0] / crop[0], 0],
                    [0, -pixels / crop[1], -centre[1] / crop[1], 0],
                    [0, 0, 1, 0],
                    [0, 0, -1, 0],
                ]
            )
            found["worldToNDC"] = projection @ to_camera
        return {name: matrix.T for name, matrix in found.items()}
