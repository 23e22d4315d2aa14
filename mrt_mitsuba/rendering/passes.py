"""One picture, pass by pass: its rays, its edges, further samples there, depth of field.

Whatever a pass does, it does in parts that fit into memory beside the picture, and the picture does not show
them: rays know nothing of each other, and a filter sees as many rows around a band as it looks at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrt_mitsuba.rays.exposure import Exposure
from mrt_mitsuba.rendering.job import Job
from mrt_mitsuba.rendering.plan import Plan
from mrt_mitsuba.rendering.trace import AVERAGED, CHANNELS, FIRST_HIT, Camera, Planes, Tracer


@dataclass(frozen=True)
class Focus:
    """The distance in focus, None for no blur, and half the width of the sharp zone, in scene units."""

    distance: float | None
    range: float


class Frame:
    """A picture in the making. ``layers``: by name, [pixels, channels] float32, row by row from the top."""

    def __init__(
        self, job: Job, tracer: Tracer, camera: Camera, plan: Plan, focus: Focus, exposure: Exposure
    ) -> None:
        self._job, self._tracer, self._camera = job, tracer, camera
        self._plan, self._focus, self._exposure = plan, focus, exposure
        self._shape = plan.height, plan.width
        self._pixels = range(plan.width * plan.height)
        self.layers: dict[str, np.ndarray] = {}

    def render(self) -> dict[str, np.ndarray]:
        """Run the passes; return the layers."""
        wanted = self._plan.traced_layers | {"image"}
        if self._plan.detector is None:
            self._all_samples(wanted)
        else:
            self._trace("Rendering", self._exposure.centre(self._pixels), wanted)
            edges = self._detect()
            if self._plan.lattice.count > 1:
                self._refine(edges)
        if self._plan.blur:
            self._blur()
        return self.layers

    # --------------------------------------------- Rays ---------------------------------------------

    def _all_samples(self, wanted: frozenset[str]) -> None:
        """Every sample of every pixel; layers of the first hit belong to the pixel's centre."""
        lattice, at_centre = self._plan.lattice, wanted & FIRST_HIT.keys()
        if at_centre and not lattice.holds_centre:
            self._trace("First hits", self._exposure.first_hit(self._pixels), at_centre)
            wanted -= at_centre
        self._trace("Rendering", self._exposure.lattice(self._pixels), wanted)
        if "samples" in self._plan.returned_layers:
            self._add("samples", 1)[:] = lattice.count

    def _trace(self, title: str, bundle: Any, wanted: frozenset[str]) -> None:
        """Trace all pixels; their layers are new."""
        for name in wanted:
            self._add(name, CHANNELS[name])
        with self._job.stage(title, len(bundle.pixels)) as advance:
            parts = self._job.trace(self._tracer, self._camera, bundle, wanted, seed=self._exposure.seed)
            for pixels, planes in parts:
                rows = slice(pixels.start, pixels.stop)
                for name, channel, plane in _channels(planes):
                    self.layers[name][rows, channel] = plane
                advance(len(pixels))

    def _refine(self, count: int) -> None:
        """Add the lattice's other samples in the pixels at edges, so many; the first sample is not traced
        again."""
        lattice = self._plan.lattice
        first = 1 if lattice.holds_centre else 0
        wanted = frozenset(self.layers.keys() & AVERAGED.keys())
        with self._job.stage("Anti-aliasing", count, "Computing Anti aliasing..") as advance:
            for before, edges in self._edges():
                bundle = self._exposure.lattice(edges, first=first)
                seed = self._exposure.seed + 1
                parts = self._job.trace(self._tracer, self._camera, bundle, wanted, seed=seed, before=before)
                for pixels, planes in parts:
                    for name, channel, plane in _channels(planes):
                        total = first * self.layers[name][pixels, channel] + bundle.count * plane
                        self.layers[name][pixels, channel] = total / np.float32(lattice.count)
                    advance(len(pixels))

    def _edges(self) -> Iterator[tuple[int, np.ndarray]]:
        """Some rows of the picture at a time: how many edge pixels came before, and the indices of these."""
        samples, step = self.layers["samples"][:, 0], self._rows_at_once * self._plan.width
        before = 0
        for start in range(0, len(samples), step):
            edges = np.flatnonzero(samples[start : start + step] > 1)
            if len(edges):
                yield before, edges.astype(np.uint32) + np.uint32(start)
            before += len(edges)

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self) -> int:
        """Look for edges, note how many samples each pixel is due, and return the number of edge pixels."""
        from mrt_mitsuba.filters.edges import REACH

        count = 0
        edges, samples = (self._add(name, 1).reshape(self._shape) for name in ("edges", "samples"))
        with self._job.stage("Edges", len(self._pixels)) as advance:
            for band in self._bands(REACH):
                found = self._find_edges(band.seen)
                mask = found.mask[band.inner]
                edges[band.rows] = found.value[band.inner]
                samples[band.rows] = np.where(mask, np.float32(self._plan.lattice.count), np.float32(1))
                count += int(np.count_nonzero(mask))
                advance(mask.size)
        self.layers.pop("square", None)
        return count

    def _find_edges(self, rows: slice) -> Any:
        from mrt_mitsuba import filters

        if self._plan.detector == "geometry":
            return filters.geometry_edges(self._picture("normal")[rows], self._picture("depth")[rows, :, 0])
        image, variance = self._picture("image")[rows], None
        if "square" in self.layers:
            rays = self._exposure.centre(self._pixels).rays_per_pixel
            variance = np.maximum(self._picture("square")[rows] - image**2, 0) / (rays - 1)
        detect = filters.luma_edges if self._plan.detector == "luma" else filters.sobel_edges
        return detect(image, variance=variance)

    def _blur(self) -> None:
        """Blur the picture in place; what the next band sees of this one is kept as it was."""
        from mrt_mitsuba import filters
        from mrt_mitsuba.filters.dof import REACH

        focus: dict[str, Any] = {"focal_distance": self._focus.distance, "focal_range": self._focus.range}
        image, depth = self._picture("image"), self._picture("depth")[:, :, 0]
        amount = self._add("blur", 1).reshape(self._shape) if "blur" in self._plan.layers else None
        above = image[:0]
        with self._job.stage("Depth of field", len(self._pixels), "Computing depth of field..") as advance:
            for band in self._bands(REACH):
                sharp = image[band.start : band.bottom]
                if len(above):
                    sharp = np.concatenate([above, sharp])
                blurred = filters.gaussian_dof(sharp, depth[band.seen], **focus, mode=str(self._plan.blur))
                above = sharp[: band.stop - band.top][-REACH:].copy()
                image[band.rows] = blurred[band.inner]
                if amount is not None:
                    amount[band.rows] = filters.blur_amount(depth[band.rows], **focus)
                advance((band.stop - band.start) * self._plan.width)

    def _bands(self, halo: int) -> Iterator[Any]:
        from mrt_mitsuba.filters.bands import bands

        rows = self._rows_at_once
        yield from bands(self._plan.height, rows, halo)
        self._job.workspace.after_filter(min(rows, self._plan.height) * self._plan.width)

    @property
    def _rows_at_once(self) -> int:
        return self._job.workspace.rows_at_once(self._plan.width)

    # -------------------------------------------- Layers --------------------------------------------

    def _add(self, name: str, channels: int) -> np.ndarray:
        """A new layer, 0 everywhere. All but the picture channel by channel, as an EXR wants them."""
        size = len(self._pixels), channels
        self.layers[name] = np.zeros(size, np.float32, order="C" if name == "image" else "F")
        return self.layers[name]

    def _picture(self, name: str) -> np.ndarray:
        """A view of a layer, [H, W, channels]."""
        return self.layers[name].reshape(*self._shape, -1)


def _channels(planes: Planes) -> Iterator[tuple[str, int, np.ndarray]]:
    for name, channels in planes.items():
        for channel, plane in enumerate(channels):
            yield name, channel, plane
