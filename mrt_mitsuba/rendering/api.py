"""``render``: a scene in, a picture out.

scene → plan → rays → integrator → filters → result; each step is a module, this one puts them in order.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.output.files import LAYERS
from mrt_mitsuba.output.result import Result, Timings
from mrt_mitsuba.plugins.protocols import LayeredIntegrator
from mrt_mitsuba.rays.bundle import Lattice
from mrt_mitsuba.rays.exposure import Exposure, exposures
from mrt_mitsuba.rendering import options
from mrt_mitsuba.rendering.job import Job, counting_kernels
from mrt_mitsuba.rendering.memory import Workspace
from mrt_mitsuba.rendering.passes import Focus, Frame
from mrt_mitsuba.rendering.plan import Features, Plan, make_plan, stock_features, whitted_features
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.rendering.trace import AVERAGED, Camera, Tracer, WhittedTracer
from mrt_mitsuba.scene.open import Source, open_scene

log = logging.getLogger(__name__)


def render(
    scene: Any = 0,
    *,
    width: int | None = None,
    height: int | None = None,
    aa: int = 4,
    aamode: str = "sobel",
    lattice: str = "report",
    fresnel: str | None = None,
    focaldist: float | None = None,
    focalrange: float | None = None,
    dof: str = "report",
    layers: Sequence[str] = (),
    motion: Sequence[float] | None = None,
    motionsamples: int = 16,
    motionmode: str = "frames",
    convention: str = "report",
    variant: str | None = None,
    memory: int | str | None = None,
    seed: int = 0,
    integrator: Any = None,
    spp: int = 1,
    count_rays: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Render a scene.

    Args:
        scene: number of a scene of the report, a ``Scene``, a Mitsuba dict, a Mitsuba scene, or the path of
            an .xml or .obj file.
        width, height: pixels; 800 and 600, or the film's own where the scene brings a film.
        aa: aa × aa samples in a pixel.
        aamode: "none", "luma", "sobel" or "geometry": which pixels get more than one sample.
        lattice: "report" or "centered", see ``rays.Lattice``.
        fresnel: "schlick" (default) or "dielectric", for the report's scenes.
        focaldist, focalrange: scene units; by default the scene's own; a distance of 0 turns the blur off.
        dof: "report" or "corrected", see ``filters.dof``.
        layers: names from ``output.LAYERS`` to return beside those that are free.
        motion, motionsamples: the camera's way while the shutter is open, and the number of moments at which
            it is seen.
        motionmode: "frames" averages so many whole renders, as the report does; "stratified" is one render
            whose rays are spread over the time the shutter is open: at least so many to a pixel, and no more
            than that where the lattice has as many samples.
        convention: meaning of MTL files, "report" or "standard".
        variant: Mitsuba variant; by default the current one, else ``llvm_ad_rgb``.
        memory: bytes (or text such as "4G") to stay within.
        seed: for whatever is random.
        integrator: name, dict or instance of a sampling integrator; by default the scene's own.
        spp: rays for each sample, for integrators that draw random numbers. From 2 on, "luma" and "sobel"
            know the variance of every pixel and take only for an edge what noise does not explain; with one
            random ray they take noise for edges, and refine it ("geometry" does not).
        count_rays: count mirror and shadow rays.
        progress: told of plan, stages and progress.

    Raises:
        UsageError: for an argument of the wrong type or range.
        SceneError: for a scene that cannot be read.
        VariantError: for a variant that cannot run here.
    """
    start = time.perf_counter()
    arguments = {name: value for name, value in locals().items() if name in options.TABLE and name != "scene"}
    given = {name: options.check(name, value) for name, value in arguments.items()}
    progress = Progress() if progress is None else progress
    with counting_kernels() as kernels:
        variant = runtime.use(variant)
        runtime.warn_if_slow()
        source = open_scene(
            scene,
            width=given["width"],
            height=given["height"],
            fresnel=given["fresnel"],
            convention=given["convention"],
            integrator=integrator,
        )
        tracer, features = _tracer(source)
        focus = _focus(source, given["focaldist"], given["focalrange"])
        plan = make_plan(
            scene=source.name,
            variant=variant,
            integrator=_name(source.integrator),
            width=source.width,
            height=source.height,
            lattice=Lattice(given["lattice"], given["aa"]),
            aamode=given["aamode"],
            focal_distance=focus.distance,
            dof=given["dof"],
            layers=frozenset(given["layers"]),
            count_rays=count_rays,
            repeats=given["spp"],
            motion=given["motionmode"] if given["motion"] else None,
            motion_samples=given["motionsamples"],
            random=tracer.random,
            features=features,
        )
        takes = exposures(plan, given["seed"])
        job = Job(progress, _workspace(plan, takes, given["memory"]))
        progress.plan(plan)
        load = time.perf_counter() - start
        log.info("scene %s loaded in %.3f s for %s", source.name, load, variant)
        camera = Camera(source.sensor, source.width, source.height, given["motion"])
        frames = _Frames()
        for exposure in takes:
            frames.add(Frame(job, tracer, camera, plan, focus, exposure).render())
    log.info("%d kernels: compiled in %.3f s, ran for %.3f s", kernels.launches, kernels.compile, kernels.run)
    timings = Timings(time.perf_counter() - start, load, kernels.compile, kernels.run, job.passes)
    shown = {
        name: value for name, value in given.items() if value is not None and name not in ("memory", "quiet")
    }
    image, planes = frames.mean(plan)
    return Result(image, planes, plan, timings, job.rays, kernels.launches, shown)


def _focus(source: Source, distance: float | None, reach: float | None) -> Focus:
    distance = source.focal_distance if distance is None else distance
    return Focus(distance or None, source.focal_range if reach is None else reach)


def _workspace(plan: Plan, takes: Sequence[Exposure], memory: int | None) -> Workspace:
    return Workspace.beside(
        plan.width,
        plan.height,
        plan.channels,
        pictures=min(len(takes), 2),  # the frames' sum, and one of them
        rays_per_pixel=takes[0].rays_per_pixel,
        memory=memory,
    )


def _tracer(source: Source) -> tuple[Tracer, Features]:
    if isinstance(source.integrator, LayeredIntegrator):
        tracer = WhittedTracer(source.scene, source.integrator)
        features = whitted_features(source.integrator, tracer.prepared.facts, tracer.prepared.plan)
        return tracer, features
    return Tracer(source.scene, source.integrator), stock_features(source.integrator)


def _name(integrator: Any) -> str:
    """Mitsuba does not tell a plugin's name, and calls every integrator from Python a SamplingIntegrator."""
    return "mrt_whitted" if isinstance(integrator, LayeredIntegrator) else integrator.class_name()


class _Frames:
    """The mean of the frames of a motion-blurred render, or the only frame."""

    def __init__(self) -> None:
        self._sum: dict[str, np.ndarray] = {}
        self._count = 0

    def add(self, frame: dict[str, np.ndarray]) -> None:
        """Add a frame; of layers that name a point, the first frame's stay."""
        for name, values in frame.items():
            if self._count == 0:
                self._sum[name] = values
            elif name in AVERAGED:
                self._sum[name] += values
        self._count += 1

    def mean(self, plan: Plan) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """The picture [H, W, 3], and its layers by EXR channel name, [H, W] each; those that nobody asked for
        only if free. All are views."""
        shape, layers = (plan.height, plan.width), {}
        for name, values in self._sum.items():
            if name in AVERAGED and self._count > 1:
                values /= np.float32(self._count)
            if name in plan.returned_layers:
                for index, letter in enumerate(LAYERS[name]):
                    layers[f"{name}.{letter}"] = values[:, index].reshape(shape)
        return self._sum["image"].reshape(*shape, 3), dict(sorted(layers.items()))
