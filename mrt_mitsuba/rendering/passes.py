"""One picture, pass by pass: its rays, its edges, further samples there, depth of field.

Every pass works in parts that fit into memory next to the picture, and the result does not depend on them:
rays are independent of each other, and a filter sees as many rows around a band as it reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mrt_mitsuba import filters
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.filters.grid import bands
from mrt_mitsuba.memory import BYTES_PER_PIXEL_OF_FILTER, keep_freed_blocks
from mrt_mitsuba.output.error import ErrorEstimate, Round
from mrt_mitsuba.output.layers import TABLE
from mrt_mitsuba.rays.film import Film, Region
from mrt_mitsuba.rays.lattice import Places
from mrt_mitsuba.rendering.exposing import Exposer, Groups, Stack
from mrt_mitsuba.rendering.plan import BLUR, EDGES, FIRST_HITS, REFINEMENT, RENDERING, ROUNDS, Pass, Plan
from mrt_mitsuba.rendering.progress import Job
from mrt_mitsuba.rendering.rounds import Goal, run_rounds
from mrt_mitsuba.rendering.settings import DETECTORS
from mrt_mitsuba.rendering.shading import Shader, View
from mrt_mitsuba.rendering.whole import Wholes


class Passes:
    """A picture in the making. ``layers``: by name, [H, W, channels] float32, with the film's and the
    integrator's own channels, [H, W, 1]; ``error`` and ``rounds``: where they were estimated.

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
        self._rows_at_once = job.workspace.rows_at_once(plan.seen.width)
        self.layers: dict[str, np.ndarray] = {}
        self.error: ErrorEstimate | None = None
        self.rounds: Sequence[Round] = ()
        if plan.on_film:
            self._film = Film.of(view.sensor)
            picture = Region(0, 0, plan.width, plan.height)
            self._seen = plan.seen.inside(picture)
            # pixels whose rays reach what is seen, as the film numbers them
            near = np.zeros((plan.height, plan.width), bool)
            near[plan.seen.grown(self._film.reach, plan.width, plan.height).inside(picture)] = True
            self._near = np.flatnonzero(np.pad(near, self._film.border, constant_values=True))

    def run(self, goal: Goal) -> dict[str, np.ndarray]:
        """Run the passes of the plan, rounds until they reach a goal; return the layers."""
        plan = self._plan
        for step in plan.passes:
            if step.name == FIRST_HITS:
                self._trace(step, plan.first_hit(self._frame))
            elif step.name in (RENDERING, REFINEMENT) and plan.on_film:
                self._expose(step)
            elif step.name == RENDERING:
                # a detector must see no noise: it looks at the centre of each pixel, at the same times
                alike = plan.centre(self._frame) if plan.detector else plan.places(self._seed, self._frame)
                self._trace(step, alike)
            elif step.name == EDGES:
                self._detect(step)
            elif step.name == REFINEMENT:
                self._trace(step, plan.places(self._seed, self._frame, step.first))
            elif step.name == BLUR:
                self._blur(step)
            elif step.name == ROUNDS:
                self._run_rounds(step, goal)
        if "samples" in plan.layers and "samples" not in self.layers:
            self._add("samples")[:] = plan.lattice.count
        return self.layers

    # ------------------------------------------- Lattices -------------------------------------------

    def _trace(self, step: Pass, places: Places) -> None:
        """Trace all pixels, whose layers are new; or of those at edges the lattice's other samples."""
        seed, pixels, edge = self._seed, self._pixels, np.zeros(0)
        if step.name == REFINEMENT:
            edge = np.flatnonzero(self.layers["samples"] > 1).astype(np.uint32)
            whole = isinstance(pixels, range)
            seed, pixels = seed + 1, edge + np.uint32(pixels.start) if whole else pixels[edge]
        else:
            for name in step.layers:
                self._add(name)
        flat = {name: self.layers[name].reshape(len(self._pixels), -1) for name in step.layers}
        message = "Computing Anti aliasing.." if step.name == REFINEMENT else ""
        with self._job.stage(step.name, len(pixels), message) as advance:
            for part, planes in self._exposer(step).means(pixels, places, seed):
                for name, channel, plane in planes:
                    if step.name == REFINEMENT:
                        before = step.first * flat[name][edge[part], channel]
                        total = before + places.count * plane
                        flat[name][edge[part], channel] = total / np.float32(self._plan.lattice.count)
                    else:
                        flat[name][part, channel] = plane
                advance(part.stop - part.start)

    # --------------------------------------------- Films --------------------------------------------

    def _expose(self, step: Pass) -> None:
        """Expose every pixel alike, or those at edges further."""
        exposer, film, message = self._exposer(step), self._film, ""
        rays, moments = film.rays_near(step.samples * step.repeats), "square" in step.layers
        if self._plan.whole:
            wholes = Wholes(exposer, self._seed)
            with self._job.stage(step.name, wholes.cost([rays])) as advance:
                wholes.trace([rays], advance)
            self._develop(exposer, wholes)
            return
        if step.name == RENDERING:
            self._stack = Stack(film, 1, len(exposer.names))
            seed, pixels, chosen = self._seed, self._near, np.ones((1, film.pixels), bool)
        else:
            seed, message = self._seed + 1, "Computing Anti aliasing.."
            found = np.zeros((self._plan.height, self._plan.width), bool)
            found[self._seen] = self.layers["samples"][..., 0] > 1
            chosen = np.pad(found, film.border).reshape(1, -1)
            pixels = np.flatnonzero(self._stack.widened(chosen)[0])
        with self._job.stage(step.name, len(pixels) * rays, message) as advance:
            exposed = exposer.expose(Groups(rays, pixels), seed, moments=moments, advance=advance)
            self._stack.add(exposed, chosen)
        if moments:
            mean, square = exposed.total[0] / rays, exposed.square[0] / rays
            variance = np.maximum(square - mean**2, 0) / (rays - 1) * film.averaging
            self._set("square", film.picture(variance))
        self._develop(exposer, self._stack)

    def _run_rounds(self, step: Pass, goal: Goal) -> None:
        """Expose pixels until the noise is as low as was asked for."""
        from mrt_mitsuba.rendering.noise import Halves

        keep_freed_blocks()
        exposer = self._exposer(step)
        blurred = self._blurred if self._plan.blur else None
        whole = self._plan.whole
        halves: Any = Wholes(exposer, self._seed) if whole else Halves(exposer, self._seed, blurred)
        self.rounds, self.error = run_rounds(halves, self._film.pixels, goal, self._job.stage)
        self._develop(exposer, halves)
        variance = halves.variance()
        self._set("variance", variance)
        self._set("error", np.sqrt(variance.mean(-1, keepdims=True)))
        self._set("samples", halves.samples()[..., None])

    def _develop(self, exposer: Exposer, stack: Stack | Wholes) -> None:
        """Turn what is exposed into layers."""
        picture = stack.mean()
        self._set("image", picture[..., :3])
        picture = picture[self._seen]
        for number, channel in enumerate(exposer.names[3:], 3):
            name, _, letter = channel.partition(".")
            if name not in exposer.layers:
                self.layers[channel] = picture[..., number, None].astype(np.float32)
                continue
            layer = self.layers[name] if name in self.layers else self._add(name)
            layer[..., TABLE[name].letters.index(letter)] = picture[..., number]

    def _exposer(self, step: Pass) -> Exposer:
        on_film = self._plan.on_film and step.name != FIRST_HITS
        without = {"image", "square"} if on_film else set()  # the film has its own
        layers = [name for name in TABLE if name in step.layers - without]
        return Exposer(self._job, self._shader, self._view, self._film if on_film else None, layers)

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self, step: Pass) -> None:
        """Look for edges, and note how many samples each pixel is due."""
        found, samples = self._add("edges")[..., 0], self._add("samples")[..., 0]
        square, detect = self.layers.pop("square", None), getattr(filters, f"{step.mode}_edges")
        if square is not None and not self._plan.on_film:  # the mean square of the rays of each pixel
            rays = self._plan.centre(self._frame).size
            square = np.maximum(square - self.layers["image"] ** 2, 0) / (rays - 1)
        with self._job.stage(step.name, len(self._pixels)) as advance:
            for rows, seen, inner in self._bands(edges.REACH):
                read = [self.layers[name][seen] for name in DETECTORS[step.mode]]
                read = [layer if layer.shape[-1] > 1 else layer[..., 0] for layer in read]
                edge = detect(*read, **({} if square is None else {"variance": square[seen]}))
                found[rows] = edge.value[inner]
                samples[rows] = np.where(
                    edge.mask[inner], np.float32(self._plan.lattice.count), np.float32(1)
                )
                advance(samples[rows].size)

    def _blur(self, step: Pass) -> None:
        """Blur the picture, and note by how much."""
        focus: Any = {"focal_distance": self._plan.focus.distance, "focal_range": self._plan.focus.range}
        amount = self._add("blur") if "blur" in self._plan.layers else None
        with self._job.stage(step.name, len(self._pixels), "Computing depth of field..") as advance:
            for rows in self._blurring(self.layers["image"]):
                if amount is not None:
                    amount[rows, :, 0] = filters.blur_amount(self.layers["depth"][rows, :, 0], **focus)
                advance((rows.stop - rows.start) * self._shape[1])

    def _blurring(self, image: np.ndarray) -> Iterator[slice]:
        """Blur a picture in place, band by band, and yield their rows.

        What the next band sees of this one is kept as it was.
        """
        depth, above, focus = self.layers["depth"][..., 0], image[:0], self._plan.focus
        options: Any = {
            "focal_distance": focus.distance,
            "focal_range": focus.range,
            "mode": str(self._plan.blur),
        }
        for rows, seen, inner in self._bands(dof.REACH):
            sharp = image[rows.start : seen.stop]
            if len(above):
                sharp = np.concatenate([above, sharp])
            blurred = filters.gaussian_dof(sharp, depth[seen], **options)
            above = sharp[: inner.stop][-dof.REACH :].copy()
            image[rows] = blurred[inner]
            yield rows

    def _blurred(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture [H, W, 3] with depth of field."""
        picture = picture.astype(np.float32)
        for _ in self._blurring(picture):
            pass
        return picture

    def _bands(self, halo: int) -> Iterator[tuple[slice, slice, slice]]:
        """Yield the rows of each band, those that a filter sees, and where the first are among these."""
        height, width = self._shape
        yield from bands(height, self._rows_at_once, halo)
        self._job.workspace.give_back(min(self._rows_at_once, height) * width * BYTES_PER_PIXEL_OF_FILTER)

    # -------------------------------------------- Layers --------------------------------------------

    def _add(self, name: str) -> np.ndarray:
        """Return a new layer, 0 everywhere; all but the picture channel by channel, as an EXR wants them."""
        channels = TABLE[name].channels
        if name == "image":
            self.layers[name] = np.zeros((*self._shape, channels), np.float32)
        else:
            self.layers[name] = np.moveaxis(np.zeros((channels, *self._shape), np.float32), 0, -1)
        return self.layers[name]

    def _set(self, name: str, picture: np.ndarray) -> None:
        """Make a layer of what is seen of a picture [H, W, channels]."""
        self._add(name)[:] = picture[self._seen]
