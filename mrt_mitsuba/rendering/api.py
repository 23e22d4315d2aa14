"""``render``: a scene in, a picture out.

scene → facts → plan → rays → integrator → filters → result: each step is a module, this one orders them.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.interrupts import surfacing
from mrt_mitsuba.memory import Budget, Workspace
from mrt_mitsuba.output.layers import AVERAGED, TABLE
from mrt_mitsuba.output.result import Result, Timings
from mrt_mitsuba.rays.exposure import Exposure
from mrt_mitsuba.rendering.job import Job, counting_kernels
from mrt_mitsuba.rendering.passes import Passes
from mrt_mitsuba.rendering.plan import Plan, RenderFacts, make_plan
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.rendering.shading import Shader, shader_for
from mrt_mitsuba.rendering.trace import Tracer
from mrt_mitsuba.rendering.view import View
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
    params: Mapping[str, Any] | None = None,
    region: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> Result:
    """Render a scene.

    Args:
        scene: number of a scene of the report, a ``Scene``, a Mitsuba dict, a Mitsuba scene, or the path of
            an .xml or .obj file.
        width, height: pixels; 800 and 600, or the film's own where the scene brings a film.
        aa: aa × aa samples in a pixel.
        aamode: "none", "luma", "sobel" or "geometry": which pixels get more than one sample.
        lattice: "report" or "centered", see ``rays.lattice.Lattice``.
        fresnel: "schlick" (default) or "dielectric", for the report's scenes.
        focaldist, focalrange: scene units; by default the scene's own; a distance of 0 turns the blur off.
        dof: "report" or "corrected", see ``filters.dof``.
        layers: names from ``output.LAYERS`` to return; those that cost nothing are returned anyway.
        motion, motionsamples: the camera's way while the shutter is open, and the number of moments at which
            it is seen.
        motionmode: "frames" averages that many whole renders, as the report does; "stratified" is one render
            whose rays are spread over the time while the shutter is open, ``motionsamples`` or more in a
            pixel.
        convention: meaning of MTL files, "report" or "standard".
        variant: Mitsuba variant; by default the current one, else ``llvm_ad_rgb``.
        memory: bytes (or text such as "4G") to stay within.
        seed: of all random numbers.
        integrator: name, dict or instance of a sampling integrator; by default the scene's own.
        spp: rays for each sample, for integrators that draw random numbers. From 2 on, "luma" and "sobel"
            know the variance of every pixel and ignore what noise explains; with one random ray they take
            noise for edges ("geometry" never does).
        count_rays: count mirror and shadow rays.
        params: values of the scene's parameters by their ``mi.traverse`` key, set once it is loaded.
        region: column, row, width and height of the pixels to return, in place of all; they are the same as
            in the whole picture.
        progress: receives the plan, the stages and their progress.

    Raises:
        UsageError: for an argument of the wrong type or range.
        SceneError: for a scene that cannot be read.
        VariantError: for a variant that cannot run here.
    """
    settings = RenderSettings.of(
        width=width,
        height=height,
        aa=aa,
        aamode=aamode,
        lattice=lattice,
        fresnel=fresnel,
        focaldist=focaldist,
        focalrange=focalrange,
        dof=dof,
        layers=layers,
        motion=motion,
        motionsamples=motionsamples,
        motionmode=motionmode,
        convention=convention,
        variant=variant,
        memory=memory,
        seed=seed,
        integrator=integrator,
        spp=spp,
        count_rays=count_rays,
        params=params,
        region=region,
    )
    with surfacing(), runtime.one_at_a_time:
        return render_with(scene, settings, Progress() if progress is None else progress)


def render_with(scene: Any, settings: RenderSettings, progress: Progress) -> Result:
    """Render a scene as ``render`` does."""
    start = time.perf_counter()
    with counting_kernels(progress) as kernels:
        variant = runtime.use(settings.variant)
        runtime.warn_if_slow()
        budget = Budget.of(settings.memory)
        source = open_scene(
            scene,
            width=settings.width,
            height=settings.height,
            fresnel=settings.fresnel,
            convention=settings.convention,
            integrator=settings.integrator,
            budget=budget,
            params=settings.params,
        )
        shader = shader_for(source.scene, source.integrator)
        plan = make_plan(_facts(source, shader, variant, settings), settings)
        exposures = _exposures(plan, settings.seed)
        job = Job(progress, _workspace(plan, exposures, budget), kernels)
        progress.plan(plan)
        shader.prepare(plan.kernel)
        load = time.perf_counter() - start
        log.info("scene %s loaded in %.3f s for %s", source.name, load, variant)
        view = View(source.sensor, source.width, source.height, settings.motion)
        tracer = Tracer(shader, view, job.workspace)
        total: dict[str, np.ndarray] = {}
        for exposure in exposures:
            _add(total, Passes(job, tracer, plan, exposure).run())
    log.info("%d kernels: compiled in %.3f s, ran for %.3f s", kernels.launches, kernels.compile, kernels.run)
    timings = Timings(time.perf_counter() - start, load, kernels.compile, kernels.run, job.passes)
    options = settings.in_force(
        width=plan.width,
        height=plan.height,
        fresnel=source.fresnel,
        focaldist=plan.focus.distance or 0.0,
        focalrange=plan.focus.range,
        variant=variant,
        integrator=plan.integrator,
    )
    image, layers = _mean(total, plan)
    return Result(
        image,
        layers,
        plan,
        timings,
        tracer.rays,
        kernels.launches,
        options,
        runtime.versions(),
        view.matrices(),
        frozenset(budget.pictures),
    )


def _facts(source: Source, shader: Shader, variant: str, settings: RenderSettings) -> RenderFacts:
    return RenderFacts(
        scene=source.name,
        variant=variant,
        integrator=shader.name,
        width=source.width,
        height=source.height,
        focus=settings.focus(source.focal_distance, source.focal_range),
        traceable=shader.layers,
        random=shader.random,
        kernel=shader.kernel,
        parts=shader.facts,
    )


def _exposures(plan: Plan, seed: int) -> list[Exposure]:
    """Return what to average: one picture, or the frames of a camera's way if each needs its own filters."""
    whole = Exposure(plan.lattice, plan.repeats, plan.motion, plan.motion_samples, seed)
    if plan.frames == 1:
        return [whole]
    # two passes in a frame, each with random numbers of its own
    return [replace(whole, seed=seed + 2 * frame, frame=frame) for frame in range(plan.frames)]


def _workspace(plan: Plan, exposures: Sequence[Exposure], budget: Budget) -> Workspace:
    return Workspace.beside(
        plan.seen.width,
        plan.seen.height,
        plan.channels,
        pictures=min(len(exposures), 2),  # the frames' sum, and one of them
        rays_per_pixel=exposures[0].rays_per_pixel,
        budget=budget,
    )


def _add(total: dict[str, np.ndarray], picture: dict[str, np.ndarray]) -> None:
    """Add a picture's averaged layers to the total; of others, those of the first picture stay."""
    for name, values in picture.items():
        if name not in total:
            total[name] = values
        elif TABLE[name].source == AVERAGED:
            total[name] += values


def _mean(total: dict[str, np.ndarray], plan: Plan) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the mean picture [H, W, 3] and its layers by EXR channel, [H, W] each; all are views."""
    shape, inside, layers = (plan.seen.height, plan.seen.width), plan.region.inside(plan.seen), {}
    for name, values in total.items():
        if TABLE[name].source == AVERAGED and plan.frames > 1:
            values /= np.float32(plan.frames)
        if name in plan.layers:
            for index, letter in enumerate(TABLE[name].letters):
                layers[f"{name}.{letter}"] = values[:, index].reshape(shape)[inside]
    return total["image"].reshape(*shape, 3)[inside], dict(sorted(layers.items()))
