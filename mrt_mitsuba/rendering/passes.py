"""One picture, pass by pass: its rays, its edges, further samples there, depth of field.

Every pass works in parts that fit into memory next to the picture, and the result does not depend on them:
rays are independent of each other, and a filter sees as many rows around a band as it reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    layers. ``frame``: number of the only moment that is seen; None where rays are spread over the time.
    """

    error: ErrorEstimate | None = None
    rounds: Sequence[Round] = ()

    def __init__(self, job: Job, shader: Shader, plan: Plan, settings: RenderSettings, frame: int) -> None:
        self._job, self._shader, self._plan, self._settings = job, shader, plan, settings
        self._phase: dict[str, Any] = {"phase": frame / plan.moments} if plan.frames > 1 else {}
        self._seed = settings.seed + 2 * frame  # two passes in a frame, each with random numbers of its own
        self._shape = plan.seen.height, plan.seen.width
        self._pixels = plan.seen.pixels(plan.width)
        self._rows_at_once = job.workspace.rows_at_once(plan.seen.width)
        self.layers: dict[str, np.ndarray] = {}
        self._picture = Region(0, 0, plan.width, plan.height)
        self._seen = plan.seen.inside(self._picture)

    def run(self) -> dict[str, np.ndarray]:
        """Run the passes of the plan; return the layers."""
        for step in self._plan.passes:
            if step.name == EDGES:
                self._detect(step)
            elif step.name == BLUR:
                self._blur(step)
            elif step.name == ROUNDS:
                self._run_rounds(step)
            elif step.places.lattice == FILM:
                self._expose(step)
            else:
                self._trace(step)
        if "samples" in self._plan.layers and "samples" not in self.layers:
            self._add("samples")[:] = self._plan.samples
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
        else:
            for name in step.layers:
                self._add(name)
        flat = {name: self.layers[name].reshape(len(self._pixels), -1) for name in step.layers}
        exposer = Exposer(self._job, self._shader, None, [name for name in TABLE if name in step.layers])
        with self._job.stage(step.name, len(pixels)) as advance:
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
        exposer, plan, seed = self._film_exposer(step), self._plan, self._seed
        film, moments = self._shader.film, "square" in step.layers
        rays = film.rays_near(step.places.size)
        if not self._shader.layers:
            from mrt_mitsuba.rendering.whole import whole_pictures

            with self._job.stage(step.name, rays * film.pixels) as advance:
                counts, pictures = zip(*whole_pictures(exposer, seed, rays, advance), strict=True)
            self._develop(exposer, np.average(pictures, axis=0, weights=counts))
            return
        marked = np.zeros((plan.height, plan.width), bool)
        if step.name == RENDERING:
            self._stack, chosen = Stack(film, 1, len(exposer.names)), np.ones((1, film.pixels), bool)
            # pixels whose rays reach what is seen
            marked[plan.seen.grown(film.reach, plan.width, plan.height).inside(self._picture)] = True
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
            self._set("square", film.picture(variance))
        self._develop(exposer, self._stack.mean())

    def _run_rounds(self, step: Pass) -> None:
        """Expose pixels until the noise is as low as was asked for."""
        from mrt_mitsuba.rendering.noise import Halves
        from mrt_mitsuba.rendering.rounds import run_rounds
        from mrt_mitsuba.rendering.whole import Wholes

        # glibc keeps freed blocks up to the size of the largest that was freed, in place of clearing fresh
        # pages (mallopt(3), M_MMAP_THRESHOLD); this one is never written to, and takes no memory
        np.empty(2**25 - 2**16, np.uint8)
        exposer, settings = self._film_exposer(step), self._settings
        blurred = self._blurred if self._plan.blur else None
        whole = not self._shader.layers
        halves: Any = Wholes(exposer, self._seed) if whole else Halves(exposer, self._seed, blurred)
        self.rounds, self.error = run_rounds(
            halves,
            self._job.stage,
            rays=int(settings.maxspp or settings.spp or 1),
            target=settings.rmse,
            seconds=settings.maxseconds,
            on_round=settings.on_round,
        )
        self._develop(exposer, halves.mean())
        variance = halves.variance()
        self._set("variance", variance)
        self._set("error", np.sqrt(variance.mean(-1, keepdims=True)))
        self._set("samples", halves.samples()[..., None])

    def _film_exposer(self, step: Pass) -> Exposer:
        layers = step.layers - {"image", "square"}  # the film has its own
        return Exposer(self._job, self._shader, self._shader.film, [name for name in TABLE if name in layers])

    def _develop(self, exposer: Exposer, picture: np.ndarray) -> None:
        """Turn what is exposed, [H, W, channels], into layers."""
        self._set("image", picture[..., :3])
        picture = picture[self._seen]
        for number, channel in enumerate(exposer.names[3:], 3):
            name, _, letter = channel.partition(".")
            if name not in exposer.layers:
                self.layers[channel] = picture[..., number, None].astype(np.float32)
                continue
            layer = self.layers[name] if name in self.layers else self._add(name)
            layer[..., TABLE[name].letters.index(letter)] = picture[..., number]

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self, step: Pass) -> None:
        """Look for edges, and note how many samples each pixel is due."""
        found, samples = self._add("edges")[..., 0], self._add("samples")[..., 0]
        square, detect = self.layers.pop("square", None), getattr(filters, f"{step.mode}_edges")
        first = next(each for each in self._plan.passes if each.name == RENDERING)
        if square is not None and not self._plan.film:  # the mean square of the rays of each pixel
            square = np.maximum(square - self.layers["image"] ** 2, 0) / (first.places.size - 1)
        with self._job.stage(step.name, len(self._pixels)) as advance:
            for rows, seen, inner in self._bands(edges.REACH):
                read = [self.layers[name][seen] for name in DETECTORS[step.mode]]
                read = [layer if layer.shape[-1] > 1 else layer[..., 0] for layer in read]
                edge = detect(*read, **({} if square is None else {"variance": square[seen]}))
                found[rows] = edge.value[inner]
                samples[rows] = np.where(edge.mask[inner], np.float32(self._plan.samples), np.float32(1))
                advance(samples[rows].size)

    def _blur(self, step: Pass) -> None:
        """Blur the picture, and note by how much."""
        distance, reach = self._plan.focus
        amount = self._add("blur") if "blur" in self._plan.layers else None
        with self._job.stage(step.name, len(self._pixels)) as advance:
            for rows in self._blurring(self.layers["image"]):
                if amount is not None:
                    depth = self.layers["depth"][rows, :, 0]
                    amount[rows, :, 0] = filters.blur_amount(
                        depth, focal_distance=distance, focal_range=reach
                    )
                advance((rows.stop - rows.start) * self._shape[1])

    def _blurring(self, image: np.ndarray) -> Iterator[slice]:
        """Blur a picture in place, band by band, and yield their rows.

        What the next band sees of this one is kept as it was.
        """
        depth, above, (distance, reach) = self.layers["depth"][..., 0], image[:0], self._plan.focus
        for rows, seen, inner in self._bands(dof.REACH):
            sharp = image[rows.start : seen.stop]
            if len(above):
                sharp = np.concatenate([above, sharp])
            blurred = filters.gaussian_dof(
                sharp, depth[seen], focal_distance=distance, focal_range=reach, mode=str(self._plan.blur)
            )
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
        """Yield the rows of each band from top to bottom, those to read, and where the first are among these.

        A filter that reads only some rows above and below a pixel, its halo, gives the same bits for a band
        with its halo as for the whole picture.
        """
        (height, width), most = self._shape, self._rows_at_once
        step = height if height <= most else max(most - 2 * halo, halo, 1)
        for start in range(0, height, step):
            stop, top = min(start + step, height), max(start - halo, 0)
            yield slice(start, stop), slice(top, min(stop + halo, height)), slice(start - top, stop - top)
        self._job.workspace.give_back(min(most, height) * width * BYTES_PER_PIXEL_OF_FILTER)

    # -------------------------------------------- Layers --------------------------------------------

    def _add(self, name: str) -> np.ndarray:
        """Return a new layer, 0 everywhere; all but the picture channel by channel, as an EXR wants them."""
        shape, channels = self._shape, len(TABLE[name].letters)
        planes = np.zeros((*shape, channels) if name == "image" else (channels, *shape), np.float32)
        self.layers[name] = planes if name == "image" else np.moveaxis(planes, 0, -1)
        return self.layers[name]

    def _set(self, name: str, picture: np.ndarray) -> None:
        """Make a layer of what is seen of a picture [H, W, channels]."""
        self._add(name)[:] = picture[self._seen]
