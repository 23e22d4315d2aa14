"""One picture, pass by pass: its rays, its edges, further samples there, depth of field.

Every pass works in parts that fit into memory next to the picture, and the result does not depend on them:
rays are independent of each other, and a filter sees as many rows around a band as it reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mrt_mitsuba.output.error import ErrorEstimate, Round
from mrt_mitsuba.output.layers import TABLE
from mrt_mitsuba.rays.bundle import Bundle
from mrt_mitsuba.rays.exposure import Exposure
from mrt_mitsuba.rendering.detectors import DETECTORS
from mrt_mitsuba.rendering.job import Job
from mrt_mitsuba.rendering.plan import BLUR, EDGES, FIRST_HITS, REFINEMENT, RENDERING, ROUNDS, Pass, Plan
from mrt_mitsuba.rendering.rounds import Goal, run_rounds
from mrt_mitsuba.rendering.trace import Channels, Tracer


class Passes:
    """A picture in the making. ``layers``: by name, [pixels, channels] float32, row by row from the top;
    ``error`` and ``rounds``: where they were estimated."""

    def __init__(self, job: Job, tracer: Tracer, plan: Plan, exposure: Exposure, goal: Goal) -> None:
        self._job, self._tracer = job, tracer
        self._plan, self._exposure, self._goal = plan, exposure, goal
        self._shape = plan.seen.height, plan.seen.width
        self._pixels = plan.seen.pixels(plan.width)
        self.layers: dict[str, np.ndarray] = {}
        self.channels: dict[str, np.ndarray] = {}  # [pixels], of the film's and the integrator's own
        self.error: ErrorEstimate | None = None
        self.rounds: Sequence[Round] = ()

    def run(self) -> dict[str, np.ndarray]:
        """Run the passes of the plan; return the layers."""
        run = {
            FIRST_HITS: self._first_hits,
            RENDERING: self._render,
            EDGES: self._detect,
            REFINEMENT: self._refine,
            BLUR: self._blur,
            ROUNDS: self._rounds,
        }
        for step in self._plan.passes:
            run[step.name](step)
        if "samples" in self._plan.layers and "samples" not in self.layers:
            self._add("samples")[:] = self._plan.lattice.count
        return self.layers | self.channels

    # --------------------------------------------- Rays ---------------------------------------------

    def _first_hits(self, step: Pass) -> None:
        self._trace_all(step, self._exposure.first_hit(self._pixels))

    def _render(self, step: Pass) -> None:
        source = self._exposure.centre if self._plan.detector else self._exposure.lattice
        self._trace_all(step, source(self._pixels))

    def _trace_all(self, step: Pass, bundle: Bundle) -> None:
        """Trace all pixels; their layers are new."""
        for name in step.layers:
            self._add(name)
        with self._job.stage(step.name, len(bundle.pixels)) as advance:
            for part, values in self._tracer.trace(bundle, step.layers, seed=self._exposure.seed):
                for name, channel, plane in _channels(values):
                    self.layers[name][part, channel] = plane
                advance(part.stop - part.start)

    def _refine(self, step: Pass) -> None:
        """Add the lattice's other samples in the pixels at edges."""
        count, seed = np.count_nonzero(self.layers["samples"] > 1), self._exposure.seed + 1
        with self._job.stage(step.name, int(count), "Computing Anti aliasing..") as advance:
            for edges in self._edges():
                bundle = self._exposure.lattice(self._indices(edges), first=step.first)
                for part, values in self._tracer.trace(bundle, step.layers, seed=seed):
                    pixels = edges[part]
                    for name, channel, plane in _channels(values):
                        total = step.first * self.layers[name][pixels, channel] + bundle.count * plane
                        self.layers[name][pixels, channel] = total / np.float32(self._plan.lattice.count)
                    advance(len(pixels))

    def _rounds(self, step: Pass) -> None:
        """Double the lattice where that changes pixels, until the error is as small as was asked for."""
        from mrt_mitsuba.rendering.levels import Levels

        for name in step.layers:
            self._add(name)

        def trace(aa: int, pixels: np.ndarray) -> np.ndarray:
            """Set pixels to the mean of a lattice; return their colours, [pixels, 3]."""
            exposure = replace(self._exposure, samples=replace(self._plan.lattice, aa=aa))
            bundle = exposure.lattice(np.asarray(self._pixels, np.uint32)[pixels])
            for part, values in self._tracer.trace(bundle, step.layers, seed=exposure.seed + aa):
                for name, channel, plane in _channels(values):
                    self.layers[name][pixels[part], channel] = plane
            return self.layers["image"][pixels]

        levels = Levels(self._shape, self._plan.lattice.kind, trace, self._finished)
        self.rounds = run_rounds(levels, len(self._pixels), self._goal, self._job.stage)
        self.error = levels.error()
        _, errors, samples = levels.maps()
        self._add("error")[:, 0], self._add("samples")[:, 0] = errors.ravel(), samples.ravel()

    def _edges(self) -> Iterator[np.ndarray]:
        """Yield edge pixels by their place in the layers, some rows at a time."""
        samples, step = self.layers["samples"][:, 0], self._rows_at_once * self._shape[1]
        for start in range(0, len(samples), step):
            edges = np.flatnonzero(samples[start : start + step] > 1)
            if len(edges):
                yield edges.astype(np.uint32) + np.uint32(start)

    def _indices(self, places: np.ndarray) -> np.ndarray:
        """Return where in the picture these pixels of the layers are."""
        if isinstance(self._pixels, range):
            return places + np.uint32(self._pixels.start)
        return np.asarray(self._pixels[places])

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self, step: Pass) -> None:
        """Look for edges, and note how many samples each pixel is due."""
        from mrt_mitsuba.filters.edges import REACH

        edges, samples = (self._add(name).reshape(self._shape) for name in ("edges", "samples"))
        with self._job.stage(step.name, len(self._pixels)) as advance:
            for band in self._bands(REACH):
                found = self._find_edges(step.mode, band.seen)
                mask = found.mask[band.inner]
                edges[band.rows] = found.value[band.inner]
                samples[band.rows] = np.where(mask, np.float32(self._plan.lattice.count), np.float32(1))
                advance(mask.size)
        self.layers.pop("square", None)

    def _find_edges(self, detector: str, rows: slice) -> Any:
        from mrt_mitsuba import filters

        read = [self._picture(name)[rows] for name in DETECTORS[detector].reads]
        options = {"variance": self._variance(rows)} if "square" in self.layers else {}
        return getattr(filters, f"{detector}_edges")(*read, **options)

    def _variance(self, rows: slice) -> np.ndarray:
        """Return the variance of pixels, estimated from their rays, [rows, W, 3]."""
        rays = self._exposure.centre(self._pixels).rays_per_pixel
        square = self._picture("square")[rows] - self._picture("image")[rows] ** 2
        return np.asarray(np.maximum(square, 0) / (rays - 1))

    def _blur(self, step: Pass) -> None:
        """Blur the picture, and note by how much."""
        from mrt_mitsuba import filters

        amount = self._add("blur").reshape(self._shape) if "blur" in self._plan.layers else None
        with self._job.stage(step.name, len(self._pixels), "Computing depth of field..") as advance:
            for band in self._blurring(self._picture("image")):
                if amount is not None:
                    depth = self._picture("depth")[band.rows]
                    amount[band.rows] = filters.blur_amount(depth, **self._focus)
                advance((band.stop - band.start) * self._shape[1])

    def _blurring(self, image: np.ndarray) -> Iterator[Any]:
        """Blur a picture in place, band by band; what the next band sees of this one is kept as it was."""
        from mrt_mitsuba import filters
        from mrt_mitsuba.filters.dof import REACH

        depth, above = self._picture("depth"), image[:0]
        for band in self._bands(REACH):
            sharp = image[band.start : band.bottom]
            if len(above):
                sharp = np.concatenate([above, sharp])
            blurred = filters.gaussian_dof(sharp, depth[band.seen], **self._focus, mode=str(self._plan.blur))
            above = sharp[: band.stop - band.top][-REACH:].copy()
            image[band.rows] = blurred[band.inner]
            yield band

    def _finished(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture [H, W, 3] as the passes after the rounds show it."""
        if self._plan.blur is None:
            return picture
        picture = picture.astype(np.float32)
        for _ in self._blurring(picture):
            pass
        return picture

    @property
    def _focus(self) -> dict[str, Any]:
        focus = self._plan.focus
        return {"focal_distance": focus.distance, "focal_range": focus.range}

    def _bands(self, halo: int) -> Iterator[Any]:
        from mrt_mitsuba.filters.bands import bands

        rows = self._rows_at_once
        yield from bands(self._shape[0], rows, halo)
        self._job.workspace.after_filter(min(rows, self._shape[0]) * self._shape[1])

    @property
    def _rows_at_once(self) -> int:
        return self._job.workspace.rows_at_once(self._shape[1])

    # -------------------------------------------- Layers --------------------------------------------

    def _add(self, name: str) -> np.ndarray:
        """Return a new layer, 0 everywhere; all but the picture channel by channel, as an EXR wants them."""
        size = len(self._pixels), TABLE[name].channels
        self.layers[name] = np.zeros(size, np.float32, order="C" if name == "image" else "F")
        return self.layers[name]

    def _picture(self, name: str) -> np.ndarray:
        """Return a view of a layer, [H, W, channels], or [H, W] of a single channel."""
        return self.layers[name].reshape(*self._shape, -1).squeeze(-1 if TABLE[name].channels == 1 else ())


def _channels(values: Channels) -> Iterator[tuple[str, int, np.ndarray]]:
    for name, channels in values.items():
        for channel, plane in enumerate(channels):
            yield name, channel, plane
