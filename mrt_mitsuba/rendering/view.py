"""A scene as seen by a sensor: camera rays, and distances from the eye."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
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

    def matrices(self) -> Mapping[str, np.ndarray]:
        """Return the camera's matrices as they are now, float64 [4, 4] for row vectors on their left, as EXR
        defines them; computed when they are read.

        ``worldToCamera``: to a camera at the origin that looks along -z, with x to the right and y up.
        ``worldToNDC``, of pinhole cameras: to the picture, x from 0 to 1 to the right and y downwards.
        Source: OpenEXR, "Standard Attributes".
        """
        import mitsuba as mi

        film, found = self.sensor.film(), _collector(mi.variant())(self.sensor)
        # copies share the numbers, and stay as they are when the sensor's change
        numbers = {name: type(value)(value) for name, value in found.values.items()}
        sizes = film.size(), film.crop_size(), film.crop_offset()
        world = self.sensor.world_transform().matrix
        return Matrices(type(world)(world), numbers, sizes)


@cache
def _collector(variant: str) -> type:
    """Return the class of what collects a sensor's numbers, for a variant; ``mi.traverse`` takes ten times as
    long."""
    import mitsuba as mi

    class Collector(mi.TraversalCallback):
        def __init__(self, sensor: Any) -> None:
            super().__init__()
            self.sensor, self.values = sensor, dict[str, Any]()
            sensor.traverse(self)

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if name in _PINHOLE:
                value = value if cpptype is None else mi.get_property(value, cpptype, self.sensor)
                self.values[name] = value

    return Collector


_PINHOLE = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")


class Matrices(Mapping[str, np.ndarray]):
    """The matrices of a camera, computed when the first is read."""

    def __init__(self, world: Any, numbers: Mapping[str, Any], sizes: Sequence[np.ndarray]) -> None:
        self._given = world, numbers, sizes

    def __getitem__(self, name: str) -> np.ndarray:
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    @cached_property
    def _found(self) -> dict[str, np.ndarray]:
        world, numbers, sizes = self._given
        size, crop, start = (np.array(pair, float) for pair in sizes)
        to_world = np.array(world, np.float64).reshape(4, 4)
        if not np.isfinite(to_world).all() or np.linalg.matrix_rank(to_world) < 4:
            return {}
        # Mitsuba's cameras look along +z, with x to the left
        to_camera = np.diag([-1.0, 1.0, -1.0, 1.0]) @ np.linalg.inv(to_world)
        found = {"worldToCamera": to_camera}
        fov, *shift = (np.array(numbers.get(name, 0.0)).item() for name in _PINHOLE)
        if fov:
            pixels = size[0] / (2 * np.tan(np.deg2rad(fov) / 2))  # at a distance of one
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
