"""The passes of a picture that is exposed by the rules of a film."""

from __future__ import annotations

import numpy as np

from mrt_mitsuba.memory import keep_freed_blocks
from mrt_mitsuba.output.layers import TABLE
from mrt_mitsuba.rays.exposure import Exposure
from mrt_mitsuba.rays.film import Film
from mrt_mitsuba.rays.region import Region
from mrt_mitsuba.rendering.exposing import Exposer, Groups, Stack
from mrt_mitsuba.rendering.job import Job
from mrt_mitsuba.rendering.noise import Halves
from mrt_mitsuba.rendering.passes import Passes
from mrt_mitsuba.rendering.plan import Pass, Plan
from mrt_mitsuba.rendering.rounds import Goal, run_rounds
from mrt_mitsuba.rendering.trace import Tracer


class FilmPasses(Passes):
    """Passes that expose the film of the view's sensor where others trace a lattice."""

    def __init__(self, job: Job, tracer: Tracer, plan: Plan, exposure: Exposure, goal: Goal) -> None:
        super().__init__(job, tracer, plan, exposure, goal)
        self._film = Film.of(tracer.view.sensor)
        whole = Region(0, 0, plan.width, plan.height)
        self._seen = plan.seen.inside(whole)
        # pixels whose rays reach what is seen, as the film numbers them
        near = np.zeros((plan.height, plan.width), bool)
        near[plan.seen.grown(self._film.reach, plan.width, plan.height).inside(whole)] = True
        self._near = self._film.framed(near, True).ravel()

    def _render(self, step: Pass) -> None:
        """Expose every pixel alike."""
        exposer, rays = self._exposer(step), self._film.rays_near(step.samples * step.repeats)
        groups = Groups.uniform(rays, np.flatnonzero(self._near))
        moments = "square" in step.layers
        self._stack = Stack(self._film, 1, len(exposer.names))
        with self._job.stage(step.name, len(groups) * rays) as advance:
            exposed = exposer.expose(groups, self._exposure.seed, moments=moments, advance=advance)
            self._stack.add(exposed, np.ones_like(exposed.rays))
        if moments:
            mean, square = (v[0] / rays for v in (exposed.total, exposed.square))
            variance = np.maximum(square - mean**2, 0) / (rays - 1) * self._film.averaging
            self._set("square", self._film.picture(variance))
        self._develop(exposer, self._stack)

    def _refine(self, step: Pass) -> None:
        """Expose the pixels at edges further."""
        film, rays = self._film, self._film.rays_near(step.samples * step.repeats)
        edges = np.zeros((self._plan.height, self._plan.width), bool)
        edges[self._seen] = self._picture("samples") > 1
        edges = film.framed(edges, False).reshape(1, -1)
        exposer = self._exposer(step)
        groups = Groups.uniform(rays, np.flatnonzero(self._stack.widened(edges)[0]))
        with self._job.stage(step.name, len(groups) * rays, "Computing Anti aliasing..") as advance:
            self._stack.add(exposer.expose(groups, self._exposure.seed + 1, advance=advance), edges)
        self._develop(exposer, self._stack)

    def _rounds(self, step: Pass) -> None:
        """Expose pixels until the noise is as low as was asked for."""
        keep_freed_blocks()
        exposer = self._exposer(step)
        halves = Halves(exposer, self._exposure.seed, self._finished if self._plan.blur else None)
        self.rounds = run_rounds(halves, self._film.pixels, self._goal, self._job.stage)
        self.error = halves.error()
        self._develop(exposer, halves)
        variance = halves.variance()
        self._set("variance", variance)
        self._set("error", np.sqrt(variance.mean(-1, keepdims=True)))
        self._set("samples", halves.samples()[..., None])

    def _variance(self, rows: slice) -> np.ndarray:
        return self._picture("square")[rows]

    def _exposer(self, step: Pass) -> Exposer:
        layers = [name for name in TABLE if name in step.layers - {"image", "square"}]
        tracer = self._tracer
        return Exposer(tracer.shader, self._film, tracer.view, tracer.workspace, tracer.rays, layers)

    def _develop(self, exposer: Exposer, stack: Stack) -> None:
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

    def _set(self, name: str, picture: np.ndarray) -> None:
        """Make a layer of what is seen of a picture [H, W, channels]."""
        self._add(name)[:] = picture[self._seen].reshape(len(self._pixels), -1)
