"""A scene as seen by a sensor: camera rays, and distances from the eye."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class View:
    """A sensor, the size of its picture in pixels, and the camera's way from time 0 to 1."""

    sensor: Any
    width: int
    height: int
    motion: tuple[float, float, float] | None = None

    def rays(self, place: Any, time: Any, sampler: Any) -> tuple[Any, Any]:
        """Return the rays through places in the picture, [0, 1]², and their weights.

        ``time``: from 0, when the shutter opens, to 1; None: the sampler draws it, as for Mitsuba's sensors.
        Draws what Mitsuba's integrators draw, in their order.
        """
        import mitsuba as mi

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
        found = {"worldToCamera": np.diag([-1.0, 1.0, -1.0, 1.0]) @ np.linalg.inv(to_world)}
        numbers, film = mi.traverse(self.sensor), self.sensor.film()
        names = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
        fov, *shift = (np.array(numbers.get(name, 0.0)).item() for name in names)
        if fov:
            size, crop = np.array(film.size(), float), np.array(film.crop_size(), float)
            pixels = size[0] / (2 * np.tan(np.deg2rad(fov) / 2))  # at a distance of one
            centre = (0.5 - np.array(shift)) * size - np.array(film.crop_offset(), float)
            projection = np.array(
                [
                    [pixels / crop[0], 0, -centre[0] / crop[0], 0],
                    [0, -pixels / crop[1], -centre[1] / crop[1], 0],
                    [0, 0, 1, 0],
                    [0, 0, -1, 0],
                ]
            )
            found["worldToNDC"] = projection @ found["worldToCamera"]
        return {name: matrix.T for name, matrix in found.items()}
