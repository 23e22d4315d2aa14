"""One picture, pass by pass: its rays, its edges, further samples there, depth of field.

Every pass works in parts that fit into memory next to the picture, and the result does not depend on them:
rays are independent of each other, and a filter sees as many rows around a band as it reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mrt_mitsuba.output.error import ErrorEstimate, Round
from mrt_mitsuba.output.layers import TABLE
from mrt_mitsuba.rays.film import Film
from mrt_mitsuba.rays.lattice import Places
from mrt_mitsuba.rays.region import Region
from mrt_mitsuba.rendering.exposing import Exposer, Groups, Planes, Stack
from mrt_mitsuba.rendering.job import Job
from mrt_mitsuba.rendering.plan import BLUR, EDGES, FIRST_HITS, REFINEMENT, RENDERING, ROUNDS, Pass, Plan
from mrt_mitsuba.rendering.rounds import Goal, run_rounds
from mrt_mitsuba.rendering.settings import DETECTORS
from mrt_mitsuba.rendering.shading import Shader
from mrt_mitsuba.rendering.view import View
from mrt_mitsuba.rendering.whole import Wholes


class Passes:
    """A picture in the making. ``layers``: by name, [pixels, channels] float32, row by row from the top;
    ``channels``: [pixels], of the film's and the integrator's own; ``error`` and ``rounds``: where they were
    estimated.

    Where the plan's lattice is a film, the film is exposed with a border, and developed into layers; else
    each pixel is the mean of its samples.
    """

    def __init__(
        self, job: Job, shader: Shader, view: View, plan: Plan, seed: int, frame: int | None
    ) -> None:
        self._job, self._shader, self._view = job, shader, view
        self._plan, self._seed, self._frame = plan, seed, frame
        self._shape = plan.seen.height, plan.seen.width
        self._pixels = plan.seen.pixels(plan.width)
        self.layers: dict[str, np.ndarray] = {}
        self.channels: dict[str, np.ndarray] = {}
        self.error: ErrorEstimate | None = None
        self.rounds: Sequence[Round] = ()
        if plan.on_film:
            self._film = Film.of(view.sensor)
            whole = Region(0, 0, plan.width, plan.height)
            self._seen = plan.seen.inside(whole)
            # pixels whose rays reach what is seen, as the film numbers them
            near = np.zeros((plan.height, plan.width), bool)
            near[plan.seen.grown(self._film.reach, plan.width, plan.height).inside(whole)] = True
            self._near = np.flatnonzero(self._film.framed(near, True))

    def run(self, goal: Goal) -> dict[str, np.ndarray]:
        """Run the passes of the plan, rounds until they reach a goal; return the layers."""
        plan = self._plan
        for step in plan.passes:
            if step.name == FIRST_HITS:
                self._trace(step, plan.first_hit(self._frame))
            elif step.name == RENDERING and plan.on_film:
                self._expose(step)
            elif step.name == RENDERING:
                # a detector must see no noise: it looks at the centre of each pixel, at the same times
                alike = plan.centre(self._frame) if plan.detector else plan.places(self._seed, self._frame)
                self._trace(step, alike)
            elif step.name == EDGES:
                self._detect(step)
            elif step.name == REFINEMENT:
                (self._expose_edges if plan.on_film else self._refine)(step)
            elif step.name == BLUR:
                self._blur(step)
            elif step.name == ROUNDS:
                self._run_rounds(step, goal)
        if "samples" in plan.layers and "samples" not in self.layers:
            self._add("samples")[:] = plan.lattice.count
        return self.layers | self.channels

    # ------------------------------------------- Lattices -------------------------------------------

    def _trace(self, step: Pass, places: Places) -> None:
        """Trace all pixels; their layers are new."""
        for name in step.layers:
            self._add(name)
        with self._job.stage(step.name, len(self._pixels)) as advance:
            for part, values in self._exposer(step).means(self._pixels, places, self._seed):
                for name, channel, plane in _channels(values):
                    self.layers[name][part, channel] = plane
                advance(part.stop - part.start)

    def _refine(self, step: Pass) -> None:
        """Add the lattice's other samples in the pixels at edges, some rows at a time."""
        samples, at_once = self.layers["samples"][:, 0], self._rows_at_once * self._shape[1]
        places, count = self._plan.places(self._seed, self._frame, step.first), self._plan.lattice.count
        with self._job.stage(
            step.name, int(np.count_nonzero(samples > 1)), "Computing Anti aliasing.."
        ) as advance:
            for start in range(0, len(samples), at_once):
                edges = np.flatnonzero(samples[start : start + at_once] > 1)
                edges = edges.astype(np.uint32) + np.uint32(start)
                if not len(edges):
                    continue
                whole = isinstance(self._pixels, range)
                pixels = edges + np.uint32(self._pixels.start) if whole else np.asarray(self._pixels[edges])
                for part, values in self._exposer(step).means(pixels, places, self._seed + 1):
                    for name, channel, plane in _channels(values):
                        layer, chosen = self.layers[name], (edges[part], channel)
                        total = step.first * layer[chosen] + places.count * plane
                        layer[chosen] = total / np.float32(count)
                    advance(part.stop - part.start)

    # --------------------------------------------- Films --------------------------------------------

    def _expose(self, step: Pass) -> None:
        """Expose every pixel alike."""
        exposer, rays = self._exposer(step), self._film.rays_near(step.samples * step.repeats)
        if self._plan.whole:
            wholes = Wholes(exposer, self._seed)
            with self._job.stage(step.name, wholes.cost([rays])) as advance:
                wholes.trace([rays], advance)
            self._develop(exposer, wholes)
            return
        moments = "square" in step.layers
        self._stack = Stack(self._film, 1, len(exposer.names))
        with self._job.stage(step.name, len(self._near) * rays) as advance:
            exposed = exposer.expose(Groups(rays, self._near), self._seed, moments=moments, advance=advance)
            self._stack.add(exposed, np.ones_like(exposed.rays))
        if moments:
            mean, square = (v[0] / rays for v in (exposed.total, exposed.square))
            variance = np.maximum(square - mean**2, 0) / (rays - 1) * self._film.averaging
            self._set("square", self._film.picture(variance))
        self._develop(exposer, self._stack)

    def _expose_edges(self, step: Pass) -> None:
        """Expose the pixels at edges further."""
        film, rays = self._film, self._film.rays_near(step.samples * step.repeats)
        edges = np.zeros((self._plan.height, self._plan.width), bool)
        edges[self._seen] = self._picture("samples") > 1
        edges = film.framed(edges, False).reshape(1, -1)
        exposer, pixels = self._exposer(step), np.flatnonzero(self._stack.widened(edges)[0])
        with self._job.stage(step.name, len(pixels) * rays, "Computing Anti aliasing..") as advance:
            exposed = exposer.expose(Groups(rays, pixels), self._seed + 1, advance=advance)
            self._stack.add(exposed, edges)
        self._develop(exposer, self._stack)

    def _run_rounds(self, step: Pass, goal: Goal) -> None:
        """Expose pixels until the noise is as low as was asked for."""
        from mrt_mitsuba.memory import keep_freed_blocks
        from mrt_mitsuba.rendering.noise import Halves

        keep_freed_blocks()
        exposer = self._exposer(step)
        blurred = self._blurred if self._plan.blur else None
        whole = self._plan.whole
        halves: Any = Wholes(exposer, self._seed) if whole else Halves(exposer, self._seed, blurred)
        self.rounds = run_rounds(halves, self._film.pixels, goal, self._job.stage)
        self.error = halves.error()
        self._develop(exposer, halves)
        variance = halves.variance()
        self._set("variance", variance)
        self._set("error", np.sqrt(variance.mean(-1, keepdims=True)))
        self._set("samples", halves.samples()[..., None])

    def _develop(self, exposer: Exposer, stack: Stack | Wholes) -> None:
        """Turn what is exposed into layers."""
        picture = stack.mean()
        self._set("image", picture[..., :3])
        picture = picture[self._seen].reshape(len(self._pixels), -1)
        for name, channel in zip(exposer.names[3:], picture[:, 3:].T, strict=True):
            own, _, letter = name.partition(".")
            if own in exposer.layers:
                if own not in self.layers:
                    self._add(own)
                self.layers[own][:, TABLE[own].letters.index(letter)] = channel
            else:
                self.channels[name] = channel.astype(np.float32)

    def _exposer(self, step: Pass) -> Exposer:
        on_film = self._plan.on_film and step.name != FIRST_HITS
        without = {"image", "square"} if on_film else set()  # the film has its own
        layers = [name for name in TABLE if name in step.layers - without]
        return Exposer(self._job, self._shader, self._view, self._film if on_film else None, layers)

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self, step: Pass) -> None:
        """Look for edges, and note how many samples each pixel is due."""
        from mrt_mitsuba import filters
        from mrt_mitsuba.filters.edges import REACH

        edges, samples = (self._add(name).reshape(self._shape) for name in ("edges", "samples"))
        with self._job.stage(step.name, len(self._pixels)) as advance:
            for rows, seen, inner in self._bands(REACH):
                read = [self._picture(name)[seen] for name in DETECTORS[step.mode]]
                options = {"variance": self._variance(seen)} if "square" in self.layers else {}
                found = getattr(filters, f"{step.mode}_edges")(*read, **options)
                mask = found.mask[inner]
                edges[rows] = found.value[inner]
                samples[rows] = np.where(mask, np.float32(self._plan.lattice.count), np.float32(1))
                advance(mask.size)
        self.layers.pop("square", None)

    def _variance(self, rows: slice) -> np.ndarray:
        """Return the variance of pixels, estimated from their rays, [rows, W, 3]."""
        if self._plan.on_film:
            return self._picture("square")[rows]
        rays = self._plan.centre(self._frame).size
        square = self._picture("square")[rows] - self._picture("image")[rows] ** 2
        return np.asarray(np.maximum(square, 0) / (rays - 1))

    def _blur(self, step: Pass) -> None:
        """Blur the picture, and note by how much."""
        from mrt_mitsuba import filters

        amount = self._add("blur").reshape(self._shape) if "blur" in self._plan.layers else None
        with self._job.stage(step.name, len(self._pixels), "Computing depth of field..") as advance:
            for rows in self._blurring(self._picture("image")):
                if amount is not None:
                    amount[rows] = filters.blur_amount(self._picture("depth")[rows], **self._focus)
                advance((rows.stop - rows.start) * self._shape[1])

    def _blurring(self, image: np.ndarray) -> Iterator[slice]:
        """Blur a picture in place, band by band, and yield their rows.

        What the next band sees of this one is kept as it was.
        """
        from mrt_mitsuba import filters
        from mrt_mitsuba.filters.dof import REACH

        depth, above = self._picture("depth"), image[:0]
        for rows, seen, inner in self._bands(REACH):
            sharp = image[rows.start : seen.stop]
            if len(above):
                sharp = np.concatenate([above, sharp])
            blurred = filters.gaussian_dof(sharp, depth[seen], **self._focus, mode=str(self._plan.blur))
            above = sharp[: inner.stop][-REACH:].copy()
            image[rows] = blurred[inner]
            yield rows

    def _blurred(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture [H, W, 3] with depth of field."""
        picture = picture.astype(np.float32)
        for _ in self._blurring(picture):
            pass
        return picture

    @property
    def _focus(self) -> dict[str, Any]:
        focus = self._plan.focus
        return {"focal_distance": focus.distance, "focal_range": focus.range}

    def _bands(self, halo: int) -> Iterator[tuple[slice, slice, slice]]:
        from mrt_mitsuba.filters.grid import bands

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

    def _set(self, name: str, picture: np.ndarray) -> None:
        """Make a layer of what is seen of a picture [H, W, channels]."""
        self._add(name)[:] = picture[self._seen].reshape(len(self._pixels), -1)


def _channels(values: Planes) -> Iterator[tuple[str, int, np.ndarray]]:
    for name, channels in values.items():
        for channel, plane in enumerate(channels):
            yield name, channel, plane
