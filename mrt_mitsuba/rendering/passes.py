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
from mrt_mitsuba.machine import BYTES_PER_PIXEL_OF_FILTER, band_rows, flush_cache
from mrt_mitsuba.plugins.signals import left_to_other_threads
from mrt_mitsuba.rendering.exposing import FILM_PREFIX, Exposer, FilmAccumulator, RayBatch, widened
from mrt_mitsuba.rendering.film import derived_seed
from mrt_mitsuba.rendering.plan import Blur, Edges, Pass, Plan, Refinement, Rounds
from mrt_mitsuba.rendering.progress import Advance, Job
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
        self._edge = np.zeros((plan.height, plan.width), bool)
        self.layers: dict[str, np.ndarray] = {}
        self.error: ErrorEstimate | None = None
        self.rounds: Sequence[Round] = ()
        self.left_out: tuple[tuple[str, str], ...] = ()  # what the rounds did not need, and why

    def run(self) -> None:
        """Run the passes of the plan."""
        exposed: FilmAccumulator | None = None
        for step in self._plan.passes:
            if isinstance(step, Edges | Blur):
                pixels = self._plan.width * self._plan.height
                with self._job.stage(step.name, pixels, step.message) as advance:
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
            elif self._shader.whole:
                self._expose_whole(step, exposer)
            else:
                exposed = self._expose(step, exposer, exposed)

    # ------------------------------------------ Rays of a pass --------------------------------------

    def _seed_of(self, step: Pass) -> int:
        """Return the seed of a pass in this frame."""
        refinement = int(isinstance(step, Refinement))
        return int(derived_seed(self._plan.seed, frame=self._frame, refinement=refinement))

    def _count(self, samples: int, edge: Any, *, anew: bool = False) -> None:
        """Add to the layer of sample counts, in pixels at an ``edge`` or in all; or begin ``anew``."""
        if "samples" in self._plan.layers:
            layer = self._layer("samples")[..., 0]
            layer[edge] = samples + (0 if anew else layer[edge])

    def _trace(self, step: Pass, exposer: Exposer) -> None:
        """Trace samples of a lattice: their means are new layers or, at edges, are averaged with these."""
        plan = self._plan
        phase = self._frame / plan.time_strata if plan.frames > 1 else step.pattern.phase
        pattern = replace(step.pattern, phase=phase)
        count = plan.width * plan.height
        edge = np.flatnonzero(self._edge).astype(np.uint32) if isinstance(step, Refinement) else None
        pixels = range(count) if edge is None else edge
        layers = {name: self._layer(name).reshape(count, -1) for name in exposer.planes}
        with self._job.stage(step.name, len(pixels), step.message) as advance:
            exposer.average(pattern, self._seed_of(step), pixels, layers, edge, advance)
        if "image" in step.layers:
            self._count(pattern.size, ... if edge is None else self._edge, anew=pattern.first == 0)
        if "square" in step.layers:
            square = self.layers.pop("square")
            self.layers["variance"] = _variance_of_mean(square, self.layers["image"], pattern.size)

    def _expose(self, step: Pass, exposer: Exposer, before: FilmAccumulator | None) -> FilmAccumulator:
        """Expose a film or, after an exposure, the pixels at edges in addition."""
        film = exposer.film
        rays = film.rays_near(step.pattern.size)
        edge: Any = ... if before is None else self._edge
        marked = np.zeros_like(self._edge)
        marked[edge] = True
        chosen = np.pad(marked, film.border).reshape(1, -1)
        pixels = np.flatnonzero(widened(film, chosen)[0])
        samples = exposer.samples(step.pattern, self._seed_of(step))
        moments = "square" in step.layers
        with self._job.stage(step.name, len(pixels) * rays, step.message) as advance:
            exposed = exposer.expose(
                RayBatch(rays, pixels), samples, moments=moments, timed=film.independent, advance=advance
            )
            before = before or FilmAccumulator.blank(film, 1, len(exposer.names))
            accumulated = before.accumulate(exposed, chosen)
        self._count(rays, edge)
        if moments:
            variance = _variance_of_mean(exposed.square[:, 0] / rays, exposed.total[:, 0] / rays, rays)
            variance *= film.filter_variance_ratio
            self._layer("variance")[:] = film.picture(np.moveaxis(variance, 0, -1))
        self._develop(exposer, accumulated.mean())
        return accumulated

    def _expose_whole(self, step: Pass, exposer: Exposer) -> None:
        """Expose the film by an integrator that renders whole pictures only."""
        from mrt_mitsuba.rendering.whole import whole_picture

        film = exposer.film
        rays = film.rays_near(step.pattern.size)
        with self._job.stage(step.name, rays * film.pixels) as advance:
            count, picture = whole_picture(exposer, self._seed_of(step), rays, advance)
        self._count(count, ...)
        self._develop(exposer, picture)

    def _run_rounds(self, step: Rounds, exposer: Exposer) -> None:
        """Sample adaptively until the goal is reached."""
        from mrt_mitsuba.adaptive.denoise import Denoiser
        from mrt_mitsuba.adaptive.estimate import pixel_error, pixel_variance
        from mrt_mitsuba.adaptive.rounds import Tracer, run_rounds

        # glibc keeps freed blocks up to the size of the largest that was freed, in place of clearing fresh
        # pages (mallopt(3), M_MMAP_THRESHOLD); this one is never written to, and takes no memory
        np.empty(2**25 - 2**16, np.uint8)
        blurred = self._blurred if self._plan.blur else None
        tracer = Tracer(exposer, self._seed_of(step))
        denoiser = Denoiser(self._features) if step.goal.denoise else None
        finished = run_rounds(tracer, self._job.stage, step.goal, blurred, self._job.on_round, denoiser)
        self.rounds = finished.rounds
        self.error = finished.error
        stats = finished.stats
        self._develop(exposer, stats.image())
        variance = pixel_variance(stats, blurred)
        error = pixel_error(stats, variance, blurred)
        with np.errstate(over="ignore"):  # errors beyond float32
            self._layer("variance")[:] = variance
            self._layer("error")[..., 0] = error
        self._layer("samples")[..., 0] = stats.samples()
        if denoiser and denoiser.left_out and finished.denoised is None:
            self.left_out = (("denoising", denoiser.left_out),)
        if step.goal.denoise:
            denoised = finished.denoised
            weight = self._layer("denoised")
            self._layer("noisy")[:] = self._layer("image")
            if denoised is not None:
                weight[..., 0] = denoised.weight
                self._layer("image")[:] = denoised.image
                self._layer("error")[..., 0] = denoised.error

    def _features(self) -> tuple[np.ndarray, np.ndarray]:
        """Albedo and shading normals of first hits, averaged over a few rays by the film, [H, W, 3] each."""
        aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        seed = derived_seed(self._plan.seed, features=1)
        with left_to_other_threads():
            picture = aov.render(self._shader.scene, self._shader.sensor, seed=seed, spp=FEATURE_SPP)
        albedo, normal = np.split(np.array(picture, np.float32)[..., -6:], 2, axis=-1)
        return albedo, normal

    def _develop(self, exposer: Exposer, picture: np.ndarray) -> None:
        """Write an exposed picture [H, W, channels] into layers."""
        self._layer("image")[:] = picture[..., :3]
        for number, name in enumerate(exposer.film_channels[3:], 3):
            self.layers[FILM_PREFIX + name] = picture[..., number, None].astype(np.float32)
        for name, planes in exposer.planes.items():
            self._layer(name)[:] = picture[..., planes]

    # -------------------------------------------- Filters --------------------------------------------

    def _detect(self, mode: str, advance: Advance) -> None:
        """Find the pixels at edges."""
        strength = self._layer("edges")[..., 0]
        variance = self.layers.pop("variance", None)
        detect = getattr(filters, f"{mode}_edges")
        for rows, wide, inner in self._bands(edges.REACH):
            read = [self.layers[name][wide] for name in DETECTORS[mode]]
            read = [layer if layer.shape[-1] > 1 else layer[..., 0] for layer in read]
            noise = {} if variance is None else {"variance": variance[wide]}
            edge = detect(*read, **noise)
            strength[rows] = edge.value[inner]
            self._edge[rows] = edge.mask[inner]
            advance(strength[rows].size)

    def _blur(self, image: np.ndarray, step: Blur, advance: Advance, noted: bool) -> None:
        """Blur a picture [H, W, 3] in place, band by band; ``noted``: keep the amount of blur in a layer.

        The rows that the next band reads of this one are kept sharp until then.
        """
        depth = self.layers["depth"][..., 0]
        above = image[:0]
        focus = {"focal_distance": step.focal_distance, "focal_range": step.focal_range}
        amount = self._layer("blur")[..., 0] if noted else None
        for rows, wide, inner in self._bands(dof.REACH):
            sharp = image[rows.start : wide.stop]
            sharp = np.concatenate([above, sharp]) if len(above) else sharp
            blurred = filters.gaussian_dof(sharp, depth[wide], mode=step.mode, **focus)
            above = sharp[: inner.stop][-dof.REACH :].copy()
            image[rows] = blurred[inner]
            if amount is not None:
                amount[rows] = filters.blur_amount(depth[rows], **focus)
            advance(depth[rows].size)

    def _blurred(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture [H, W, 3] with depth of field."""
        picture = picture.astype(np.float32)
        self._blur(picture, cast(Blur, self._plan.blur), lambda pixels: None, False)
        return picture

    def _bands(self, halo: int) -> Iterator[tuple[slice, slice, slice]]:
        """Yield the rows of each band from top to bottom, the rows to read, and the former among the latter.

        A filter that reads only some rows above and below a pixel, its halo, gives the same bits for a band
        with its halo as for the whole picture.
        """
        height, width = self._edge.shape
        most = band_rows(self._job.workspace, width)
        step = height if height <= most else max(most - 2 * halo, halo, 1)
        for start in range(0, height, step):
            stop = min(start + step, height)
            top = max(start - halo, 0)
            yield slice(start, stop), slice(top, min(stop + halo, height)), slice(start - top, stop - top)
        flush_cache(self._job.workspace, min(most, height) * width * BYTES_PER_PIXEL_OF_FILTER)

    def _layer(self, name: str) -> np.ndarray:
        """Return a layer, of zeros if it is new; all but the picture in planes, as an EXR has them."""
        if name not in self.layers:
            shape = self._edge.shape
            channels = len(TABLE[name].letters)
            planes = np.zeros((*shape, channels) if name == "image" else (channels, *shape), np.float32)
            self.layers[name] = planes if name == "image" else np.moveaxis(planes, 0, -1)
        return self.layers[name]


@np.errstate(over="ignore", invalid="ignore")  # of values that are not finite, or whose squares are not
def _variance_of_mean(square: np.ndarray, mean: np.ndarray, count: int) -> np.ndarray:
    """Return the variance of means of ``count`` values each, given the means of the values' squares."""
    return np.asarray(np.maximum(square - mean**2, 0) / (count - 1))
