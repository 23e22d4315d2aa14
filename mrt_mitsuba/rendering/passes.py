"""One picture, pass by pass: its rays, its edges, further samples there, depth of field.

Every pass works in parts that fit into memory next to the picture, and the result does not depend on them:
rays are independent of each other, and a filter sees as many rows around a band as it reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import mitsuba as mi
import numpy as np

from mrt_mitsuba import filters
from mrt_mitsuba.files.layers import TABLE
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.machine import BYTES_PER_PIXEL_OF_FILTER
from mrt_mitsuba.plugins.signals import left_to_other_threads
from mrt_mitsuba.rendering.exposing import FILM_PREFIX, Exposer, FilmAccumulator, RayBatch, widened
from mrt_mitsuba.rendering.film import Region
from mrt_mitsuba.rendering.plan import Blur, Edges, Pass, Plan, Refinement, Rounds
from mrt_mitsuba.rendering.progress import Advance, Job
from mrt_mitsuba.rendering.seeds import derived_seed
from mrt_mitsuba.rendering.settings import DETECTORS
from mrt_mitsuba.rendering.shading import Shader

if TYPE_CHECKING:
    from mrt_mitsuba.adaptive.error import ErrorEstimate, Round

FEATURE_SPP = 16  # of albedo and normals, which a denoiser is given


class Passes:
    """A picture in the making. ``layers``: by name, [H, W, channels] float32; with the channels of the film
    and the integrator, whose names begin with ``FILM_PREFIX``, [H, W, 1]. ``error`` and ``rounds``: where
    they were estimated.

    A lattice gives each pixel the mean of its samples; a film is exposed with its border, and developed into
    layers. ``frame``: number of the only moment that is seen, where the plan has several frames.
    """

    def __init__(self, job: Job, shader: Shader, plan: Plan, frame: int) -> None:
        self._job = job
        self._shader = shader
        self._plan = plan
        self._frame = frame
        self._seed = derived_seed(plan.seed, frame=frame)
        self._seen = plan.padded_region.inside(Region(0, 0, plan.width, plan.height))
        self.layers: dict[str, np.ndarray] = {}
        self.error: ErrorEstimate | None = None
        self.rounds: Sequence[Round] = ()
        self.left_out: tuple[str, str] | None = None  # what the rounds did not need, and why

    def run(self) -> None:
        """Run the passes of the plan."""
        stack: FilmAccumulator | None = None  # of what a film has been exposed to
        seen = self._plan.padded_region
        for step in self._plan.passes:
            if isinstance(step, Edges | Blur):
                with self._job.stage(step.name, seen.width * seen.height) as advance:
                    if isinstance(step, Edges):
                        self._detect(step.detector, advance)
                    else:
                        self._blur(self.layers["image"], step, advance, "blur" in self._plan.layers)
                continue
            exposer = Exposer(self._job, self._shader, step)
            if isinstance(step, Rounds):
                self._run_rounds(step, exposer)
            elif exposer.film is None:
                self._trace(step, exposer)
            elif self._plan.whole:
                self._expose_whole(step, exposer)
            else:
                stack = self._expose(step, exposer, stack)
        if "samples" in self._plan.layers and "samples" not in self.layers:
            self._layer("samples")[:] = self._plan.samples

    # ------------------------------------------ Rays of a pass --------------------------------------

    def _trace(self, step: Pass, exposer: Exposer) -> None:
        """Trace samples of a lattice: their means are new layers or, at edges, are averaged with these."""
        plan = self._plan
        phase = self._frame / plan.time_strata if plan.frames > 1 else step.pattern.phase
        places = replace(step.pattern, seed=self._seed, phase=phase)
        seen = plan.padded_region
        width = plan.width
        count = seen.width * seen.height
        pixels: Any = range(seen.y * width, (seen.y + seen.height) * width)
        edge = None
        seed = self._seed
        if isinstance(step, Refinement):
            edge = np.flatnonzero(self.layers["samples"] > 1).astype(np.uint32)
            seed = derived_seed(plan.seed, frame=self._frame, refinement=1)
        if edge is not None or seen.width != width:
            inside = np.arange(count, dtype=np.uint32) if edge is None else edge
            row, column = np.divmod(inside, np.uint32(seen.width))
            pixels = (row + np.uint32(seen.y)) * np.uint32(width) + column + np.uint32(seen.x)
        layers = {name: self._layer(name).reshape(count, -1) for name in exposer.planes}
        with self._job.stage(step.name, len(pixels)) as advance:
            exposer.average(places, seed, pixels, layers, edge, advance)
        if "square" in step.layers:
            variance = np.maximum(self.layers.pop("square") - self.layers["image"] ** 2, 0)
            self.layers["variance"] = variance / (places.size - 1)  # of the means

    def _expose(self, step: Pass, exposer: Exposer, stack: FilmAccumulator | None) -> FilmAccumulator:
        """Expose the pixels of a film that reach what is seen or, on top of a ``stack``, those at edges."""
        film = exposer.film
        plan = self._plan
        rays = film.rays_near(step.pattern.size)
        seed = self._seed
        marked = np.zeros((plan.height, plan.width), bool)
        if stack is None:
            stack = FilmAccumulator.blank(film, 1, len(exposer.names))
            marked[self._seen] = True
        else:
            marked[self._seen] = self.layers["samples"][..., 0] > 1
            seed = derived_seed(plan.seed, frame=self._frame, refinement=1)
        chosen = np.pad(marked, film.border).reshape(1, -1)
        pixels = np.flatnonzero(widened(film, chosen)[0])
        samples = exposer.samples(step.pattern, seed)
        moments = "square" in step.layers
        with self._job.stage(step.name, len(pixels) * rays) as advance:
            exposed = exposer.expose(RayBatch(rays, pixels), samples, moments=moments, advance=advance)
            stack = stack.accumulate(exposed, chosen)
        if moments:
            square = exposed.square[:, 0] / rays - (exposed.total[:, 0] / rays) ** 2
            variance = np.maximum(square, 0) / (rays - 1) * film.filter_variance_ratio
            self._layer("variance")[:] = film.picture(np.moveaxis(variance, 0, -1))[self._seen]
        self._develop(exposer, stack.mean())
        return stack

    def _expose_whole(self, step: Pass, exposer: Exposer) -> None:
        """Let an integrator that follows no camera rays expose the film."""
        from mrt_mitsuba.rendering.whole import whole_pictures

        film = exposer.film
        rays = film.rays_near(step.pattern.size)
        with self._job.stage(step.name, rays * film.pixels) as advance:
            counts, pictures = zip(*whole_pictures(exposer, self._seed, rays, advance), strict=True)
        self._develop(exposer, np.average(pictures, axis=0, weights=counts))

    def _run_rounds(self, step: Rounds, exposer: Exposer) -> None:
        """Expose pixels until the noise is as low as was asked for."""
        from mrt_mitsuba.adaptive.denoise import Denoiser
        from mrt_mitsuba.adaptive.estimate import pixel_error, pixel_variance
        from mrt_mitsuba.adaptive.rounds import Tracer, run_rounds

        # glibc keeps freed blocks up to the size of the largest that was freed, in place of clearing fresh
        # pages (mallopt(3), M_MMAP_THRESHOLD); this one is never written to, and takes no memory
        np.empty(2**25 - 2**16, np.uint8)
        blurred = self._blurred if self._plan.blur else None
        tracer = Tracer(exposer, self._seed)
        denoiser = Denoiser(self._features) if step.goal.denoise else None
        finished = run_rounds(tracer, self._job.stage, step.goal, blurred, self._job.on_round, denoiser)
        self.rounds = finished.rounds
        self.error = finished.error
        stats = finished.stats
        self._develop(exposer, stats.image())
        variance = pixel_variance(stats, blurred)
        error = pixel_error(stats, variance, blurred)
        with np.errstate(over="ignore"):  # errors beyond float32
            self._layer("variance")[:] = variance[self._seen]
            self._layer("error")[..., 0] = error[self._seen]
        self._layer("samples")[..., 0] = stats.samples()[self._seen]
        if denoiser and denoiser.left_out:
            self.left_out = ("denoising", denoiser.left_out)
        if step.goal.denoise:
            denoised = finished.denoised
            self._layer("noisy")[:] = self._layer("image")
            if denoised is not None:
                self._layer("image")[:] = denoised.image[self._seen]
                self._layer("denoised")[..., 0] = denoised.weight[self._seen]
                self._layer("error")[..., 0] = denoised.error[self._seen]
            else:
                self._layer("denoised")[:] = 0

    def _features(self) -> tuple[np.ndarray, np.ndarray]:
        """Albedo and shading normals of first hits, averaged over a few rays by the film, [H, W, 3] each."""
        aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        seed = derived_seed(self._plan.seed, features=0)
        with left_to_other_threads():
            picture = aov.render(self._shader.scene, self._shader.sensor, seed=seed, spp=FEATURE_SPP)
        return tuple(np.split(np.array(picture, np.float32)[..., -6:], 2, axis=-1))

    def _develop(self, exposer: Exposer, picture: np.ndarray) -> None:
        """Turn what is exposed, [H, W, channels], into layers."""
        picture = picture[self._seen]
        self._layer("image")[:] = picture[..., :3]
        for number, name in enumerate(exposer.film_channels[3:], 3):
            self.layers[FILM_PREFIX + name] = picture[..., number, None].astype(np.float32)
        for name, planes in exposer.planes.items():
            self._layer(name)[:] = picture[..., planes]

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self, mode: str, advance: Advance) -> None:
        """Look for edges, and note how many samples each pixel is due."""
        strength = self._layer("edges")[..., 0]
        samples = self._layer("samples")[..., 0]
        variance = self.layers.pop("variance", None)
        detect = getattr(filters, f"{mode}_edges")
        for rows, seen, inner in self._bands(edges.REACH):
            read = [self.layers[name][seen] for name in DETECTORS[mode]]
            read = [layer if layer.shape[-1] > 1 else layer[..., 0] for layer in read]
            noise = {} if variance is None else {"variance": variance[seen]}
            edge = detect(*read, **noise)
            strength[rows] = edge.value[inner]
            samples[rows] = np.where(edge.mask[inner], np.float32(self._plan.samples), np.float32(1))
            advance(samples[rows].size)

    def _blur(self, image: np.ndarray, step: Blur, advance: Advance, noted: bool) -> None:
        """Blur a picture [H, W, 3] in place, band by band; ``noted``: in a layer, by how much.

        What the next band sees of this one is kept as it was.
        """
        depth = self.layers["depth"][..., 0]
        above = image[:0]
        focus = {"focal_distance": step.focal_distance, "focal_range": step.focal_range}
        amount = self._layer("blur")[..., 0] if noted else None
        for rows, seen, inner in self._bands(dof.REACH):
            sharp = image[rows.start : seen.stop]
            sharp = np.concatenate([above, sharp]) if len(above) else sharp
            blurred = filters.gaussian_dof(sharp, depth[seen], mode=step.mode, **focus)
            above = sharp[: inner.stop][-dof.REACH :].copy()
            image[rows] = blurred[inner]
            if amount is not None:
                amount[rows] = filters.blur_amount(depth[rows], **focus)
            advance(depth[rows].size)

    def _blurred(self, picture: np.ndarray) -> np.ndarray:
        """A picture [H, W, 3] with depth of field."""
        picture = picture.astype(np.float32)
        self._blur(picture, cast(Blur, self._plan.blur), lambda pixels: None, False)
        return picture

    def _bands(self, halo: int) -> Iterator[tuple[slice, slice, slice]]:
        """Yield the rows of each band from top to bottom, those to read, and where the first are among these.

        A filter that reads only some rows above and below a pixel, its halo, gives the same bits for a band
        with its halo as for the whole picture.
        """
        height = self._plan.padded_region.height
        width = self._plan.padded_region.width
        most = self._job.workspace.rows_at_once(width)
        step = height if height <= most else max(most - 2 * halo, halo, 1)
        for start in range(0, height, step):
            stop = min(start + step, height)
            top = max(start - halo, 0)
            yield slice(start, stop), slice(top, min(stop + halo, height)), slice(start - top, stop - top)
        self._job.workspace.give_back(min(most, height) * width * BYTES_PER_PIXEL_OF_FILTER)

    def _layer(self, name: str) -> np.ndarray:
        """A layer, of zeros where it is new; all but the picture channel by channel, as an EXR wants them."""
        if name not in self.layers:
            shape = self._plan.padded_region.height, self._plan.padded_region.width
            channels = len(TABLE[name].letters)
            planes = np.zeros((*shape, channels) if name == "image" else (channels, *shape), np.float32)
            self.layers[name] = planes if name == "image" else np.moveaxis(planes, 0, -1)
        return self.layers[name]
