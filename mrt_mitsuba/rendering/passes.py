"""One picture, pass by pass: its rays, its edges, further samples there, depth of field.

Every pass works in parts that fit into memory next to the picture, and the result does not depend on them:
rays are independent of each other, and a filter sees as many rows around a band as it reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mrt_mitsuba import filters
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.machine import BYTES_PER_PIXEL_OF_FILTER
from mrt_mitsuba.output.layers import TABLE
from mrt_mitsuba.rays.film import Region
from mrt_mitsuba.rendering.exposing import Exposer, Groups, Stack
from mrt_mitsuba.rendering.plan import BLUR, EDGES, REFINEMENT, RENDERING, ROUNDS, Pass, Plan
from mrt_mitsuba.rendering.progress import Job
from mrt_mitsuba.rendering.settings import DETECTORS, FILM, RenderSettings
from mrt_mitsuba.rendering.shading import Shader

if TYPE_CHECKING:
    from mrt_mitsuba.output.error import ErrorEstimate, Round


class Passes:
    """A picture in the making. ``layers``: by name, [H, W, channels] float32, with the film's and the
    integrator's own channels, [H, W, 1]; ``error`` and ``rounds``: where they were estimated.

    A lattice gives each pixel the mean of its samples; a film is exposed with its border, and developed into
    layers. ``frame``: number of the only moment that is seen, where the plan has several frames.
    """

    error: ErrorEstimate | None = None
    rounds: Sequence[Round] = ()

    def __init__(self, job: Job, shader: Shader, plan: Plan, settings: RenderSettings, frame: int) -> None:
        self._job, self._shader, self._plan, self._settings = job, shader, plan, settings
        self._phase: dict[str, Any] = {"phase": frame / plan.moments} if plan.frames > 1 else {}
        self._seed = settings.seed + 2 * frame  # two passes in a frame, each with random numbers of its own
        # numbers of what is seen in the whole picture, as a range where that is possible
        (x, y, width, height), whole = plan.seen, plan.width
        rows, columns = np.arange(height)[:, None] + y, np.arange(x, x + width)
        self._pixels: Any = range(y * whole, (y + height) * whole)
        if width < whole:
            self._pixels = (rows * whole + columns).ravel().astype(np.uint32)
        self._seen = plan.seen.inside(Region(0, 0, plan.width, plan.height))
        self.layers: dict[str, np.ndarray] = {}

    def run(self) -> dict[str, np.ndarray]:
        """Run the passes of the plan; return the layers."""
        for step in self._plan.passes:
            if step.name in (EDGES, BLUR):
                with self._job.stage(step.name, len(self._pixels)) as advance:
                    if step.name == EDGES:
                        self._detect(step.mode, advance)
                    else:
                        self._blur(self.layers["image"], advance, "blur" in self._plan.layers)
            elif step.name == ROUNDS:
                self._run_rounds(step)
            elif step.places.lattice == FILM:
                self._expose(step)
            else:
                self._trace(step)
        if "samples" in self._plan.layers and "samples" not in self.layers:
            self._layer("samples")[:] = self._plan.samples
        return self.layers

    # ------------------------------------------- Lattices -------------------------------------------

    def _trace(self, step: Pass) -> None:
        """Trace all pixels, whose layers are new; or of those at edges the lattice's other samples."""
        refined, seed, pixels, edge = step.name == REFINEMENT, self._seed, self._pixels, np.zeros(0)
        places = replace(step.places, seed=seed, **self._phase)
        if refined:
            edge = np.flatnonzero(self.layers["samples"] > 1).astype(np.uint32)
            whole = isinstance(pixels, range)
            seed, pixels = seed + 1, edge + np.uint32(pixels.start) if whole else pixels[edge]
        flat = {
            name: (self.layers[name] if refined else self._layer(name)).reshape(len(self._pixels), -1)
            for name in step.layers
        }
        with self._job.stage(step.name, len(pixels)) as advance:
            exposer = Exposer(self._job, self._shader, None, step.layers)
            for part, means in exposer.means(pixels, places, seed):
                for name, values in means.items():
                    if refined:
                        total = places.first * flat[name][edge[part]] + places.count * values
                        flat[name][edge[part]] = total / np.float32(self._plan.samples)
                    else:
                        flat[name][part] = values
                advance(part.stop - part.start)

    # --------------------------------------------- Films --------------------------------------------

    def _expose(self, step: Pass) -> None:
        """Expose every pixel alike, or those at edges further."""
        film, plan, seed = self._shader.film, self._plan, self._seed
        exposer, moments = Exposer(self._job, self._shader, film, step.layers), "square" in step.layers
        rays = film.rays_near(step.places.size)
        if not self._shader.layers:
            from mrt_mitsuba.rendering.whole import whole_pictures

            with self._job.stage(step.name, rays * film.pixels) as advance:
                counts, pictures = zip(*whole_pictures(exposer, seed, rays, advance), strict=True)
            self._develop(exposer, np.average(pictures, axis=0, weights=counts))
            return
        marked, whole = np.zeros((plan.height, plan.width), bool), Region(0, 0, plan.width, plan.height)
        if step.name == RENDERING:
            self._stack, chosen = Stack(film, 1, len(exposer.names)), np.ones((1, film.pixels), bool)
            # pixels whose rays reach what is seen
            marked[plan.seen.grown(film.reach, plan.width, plan.height).inside(whole)] = True
            pixels = np.flatnonzero(np.pad(marked, film.border, constant_values=True))
        else:
            seed, marked[self._seen] = seed + 1, self.layers["samples"][..., 0] > 1
            chosen = np.pad(marked, film.border).reshape(1, -1)
            pixels = np.flatnonzero(self._stack.widened(chosen)[0])
        with self._job.stage(step.name, len(pixels) * rays) as advance:
            exposed = exposer.expose(Groups(rays, pixels), seed, moments=moments, advance=advance)
            self._stack.add(exposed, chosen)
        if moments:
            mean, square = exposed.total[0] / rays, exposed.square[0] / rays
            variance = np.maximum(square - mean**2, 0) / (rays - 1) * film.averaging
            self._layer("square")[:] = film.picture(variance)[self._seen]
        self._develop(exposer, self._stack.mean())

    def _run_rounds(self, step: Pass) -> None:
        """Expose pixels until the noise is as low as was asked for."""
        from mrt_mitsuba.rendering.noise import Halves
        from mrt_mitsuba.rendering.rounds import run_rounds
        from mrt_mitsuba.rendering.whole import Wholes

        # glibc keeps freed blocks up to the size of the largest that was freed, in place of clearing fresh
        # pages (mallopt(3), M_MMAP_THRESHOLD); this one is never written to, and takes no memory
        np.empty(2**25 - 2**16, np.uint8)
        exposer = Exposer(self._job, self._shader, self._shader.film, step.layers)
        settings, halves = self._settings, Halves if self._shader.layers else Wholes
        picture = halves(exposer, self._seed, self._blurred if self._plan.blur else None)
        self.rounds, self.error = run_rounds(
            picture,
            self._job.stage,
            rays=int(settings.maxspp or settings.spp or 1),
            target=settings.rmse,
            seconds=settings.maxseconds,
            on_round=settings.on_round,
        )
        self._develop(exposer, picture.mean())
        variance = picture.variance()[self._seen]
        self._layer("variance")[:] = variance
        self._layer("error")[:] = np.sqrt(variance.mean(-1, keepdims=True))
        self._layer("samples")[..., 0] = picture.samples()[self._seen]

    def _develop(self, exposer: Exposer, picture: np.ndarray) -> None:
        """Turn what is exposed, [H, W, channels], into layers."""
        picture = picture[self._seen]
        self._layer("image")[:] = picture[..., :3]
        for number, channel in enumerate(exposer.names[3:], 3):
            name, _, letter = channel.partition(".")
            if name not in exposer.layers:
                self.layers[channel] = picture[..., number, None].astype(np.float32)
                continue
            layer = self.layers[name] if name in self.layers else self._layer(name)
            layer[..., TABLE[name].letters.index(letter)] = picture[..., number]

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self, mode: str, advance: Callable[[int], object]) -> None:
        """Look for edges, and note how many samples each pixel is due."""
        found, samples = self._layer("edges")[..., 0], self._layer("samples")[..., 0]
        square, detect = self.layers.pop("square", None), getattr(filters, f"{mode}_edges")
        first = next(each for each in self._plan.passes if each.name == RENDERING)
        if square is not None and not self._plan.film:  # the mean square of the rays of each pixel
            square = np.maximum(square - self.layers["image"] ** 2, 0) / (first.places.size - 1)
        for rows, seen, inner in self._bands(edges.REACH):
            read = [self.layers[name][seen] for name in DETECTORS[mode]]
            read = [layer if layer.shape[-1] > 1 else layer[..., 0] for layer in read]
            edge = detect(*read, **({} if square is None else {"variance": square[seen]}))
            found[rows] = edge.value[inner]
            samples[rows] = np.where(edge.mask[inner], np.float32(self._plan.samples), np.float32(1))
            advance(samples[rows].size)

    def _blur(self, image: np.ndarray, advance: Callable[[int], object], noted: bool) -> None:
        """Blur a picture [H, W, 3] in place, band by band; ``noted``: in a layer, by how much.

        What the next band sees of this one is kept as it was.
        """
        depth, above = self.layers["depth"][..., 0], image[:0]
        focus: dict[str, Any] = dict(zip(("focal_distance", "focal_range"), self._plan.focus, strict=True))
        amount = self._layer("blur")[..., 0] if noted else None
        for rows, seen, inner in self._bands(dof.REACH):
            sharp = image[rows.start : seen.stop]
            sharp = np.concatenate([above, sharp]) if len(above) else sharp
            blurred = filters.gaussian_dof(sharp, depth[seen], mode=str(self._plan.blur), **focus)
            above = sharp[: inner.stop][-dof.REACH :].copy()
            image[rows] = blurred[inner]
            if amount is not None:
                amount[rows] = filters.blur_amount(depth[rows], **focus)
            advance(depth[rows].size)

    def _blurred(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture [H, W, 3] with depth of field."""
        picture = picture.astype(np.float32)
        self._blur(picture, lambda pixels: None, False)
        return picture

    def _bands(self, halo: int) -> Iterator[tuple[slice, slice, slice]]:
        """Yield the rows of each band from top to bottom, those to read, and where the first are among these.

        A filter that reads only some rows above and below a pixel, its halo, gives the same bits for a band
        with its halo as for the whole picture.
        """
        height, width = self._plan.seen.height, self._plan.seen.width
        most = self._job.workspace.rows_at_once(width)
        step = height if height <= most else max(most - 2 * halo, halo, 1)
        for start in range(0, height, step):
            stop, top = min(start + step, height), max(start - halo, 0)
            yield slice(start, stop), slice(top, min(stop + halo, height)), slice(start - top, stop - top)
        self._job.workspace.give_back(min(most, height) * width * BYTES_PER_PIXEL_OF_FILTER)

    def _layer(self, name: str) -> np.ndarray:
        """Return a new layer, 0 everywhere; all but the picture channel by channel, as an EXR wants them."""
        shape, channels = (self._plan.seen.height, self._plan.seen.width), len(TABLE[name].letters)
        planes = np.zeros((*shape, channels) if name == "image" else (channels, *shape), np.float32)
        self.layers[name] = planes if name == "image" else np.moveaxis(planes, 0, -1)
        return self.layers[name]
