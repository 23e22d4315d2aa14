"""``render``: a scene in, a picture out.

scene → facts → plan → rays → integrator → filters → result: each step is a module, this one orders them.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.interrupts import surfacing
from mrt_mitsuba.memory import Budget, Workspace
from mrt_mitsuba.output.layers import AVERAGED, TABLE
from mrt_mitsuba.rays.exposure import Exposure
from mrt_mitsuba.rays.film import pixel_format, spectral_bands
from mrt_mitsuba.rays.lattice import FILM
from mrt_mitsuba.rendering.defaults import decided
from mrt_mitsuba.rendering.job import Job, Kernels, counting_kernels
from mrt_mitsuba.rendering.passes import Passes
from mrt_mitsuba.rendering.plan import FilmFacts, Plan, RenderFacts, make_plan
from mrt_mitsuba.rendering.progress import Progress, default
from mrt_mitsuba.rendering.result import Result, Timings
from mrt_mitsuba.rendering.rounds import Goal, OnRound
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.rendering.shading import Shader, shader_for
from mrt_mitsuba.rendering.trace import Tracer
from mrt_mitsuba.rendering.view import View
from mrt_mitsuba.scene.open import Source, reopen_scene, sized

log = logging.getLogger(__name__)


def render(
    scene: Any = 0,
    *,
    width: int | None = None,
    height: int | None = None,
    aa: int | None = None,
    aamode: str | None = None,
    target: float | Sequence[float] | None = None,
    maxspp: int | None = None,
    maxseconds: float | None = None,
    on_round: OnRound | None = None,
    lattice: str | None = None,
    fresnel: str | None = None,
    focaldist: float | None = None,
    focalrange: float | None = None,
    dof: str = "report",
    layers: Sequence[str] = (),
    motion: Sequence[float] | None = None,
    motionsamples: int = 16,
    motionmode: str = "frames",
    convention: str = "report",
    texturing: str | None = None,
    camera: Sequence[float] | None = None,
    up: Sequence[float] | None = None,
    fov: float | None = None,
    light: Sequence[float] | None = None,
    sensor: int = 0,
    variant: str | None = None,
    memory: int | str | None = None,
    seed: int = 0,
    integrator: Any = None,
    spp: int | None = None,
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
        aa: aa × aa samples in a pixel; 4, or 1 in a scene of one's own with a random integrator.
        aamode: which pixels get more than one sample: all ("none"), edges ("luma", "sobel", "geometry"), or
            where noise is ("noise"). "sobel", or "none" in a scene of one's own with a random integrator.
        target: error to render to, the RMSE to the converged picture in linear values. Rays go in rounds to
            where they are needed. Three numbers: what the camera of an OBJ file looks at.
        maxspp, maxseconds: where to stop short of the target: mean rays of a pixel, 4096 if not given, and
            seconds.
        on_round: called after each round with a ``RoundPicture``; stops the render by returning False.
        lattice: "report" or "centered", see ``rays.lattice.Lattice``, or "film": as Mitsuba places samples
            and filters them, which is the default for a scene of one's own.
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
        texturing, camera, up, fov, light: of an OBJ file, see ``scene.placement.model_scene``.
        sensor: number of the sensor in a scene that has several.
        variant: Mitsuba variant; by default the current one, else ``llvm_ad_rgb``.
        memory: bytes (or text such as "4G") to stay within.
        seed: of all random numbers.
        integrator: name, dict or instance of a sampling integrator; by default the scene's own.
        spp: rays for each sample, for integrators that draw random numbers: 1, or as its sampler says in a
            scene of one's own where ``aa`` and ``aamode`` are left out, too; the mean of a pixel's rays for
            aamode="noise". From 2 on, "luma" and "sobel" know the variance of every pixel and ignore what
            noise explains; with one random ray they take noise for edges ("geometry" never does).
        count_rays: count mirror and shadow rays.
        params: values for the ``$names`` that an XML file declares, and, by keys of ``mi.traverse`` (which
            have a dot), of a scene that is loaded here.
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
        target=target,
        maxspp=maxspp,
        maxseconds=maxseconds,
        on_round=on_round,
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
        texturing=texturing,
        camera=camera,
        up=up,
        fov=fov,
        light=light,
        sensor=sensor,
        variant=variant,
        memory=memory,
        seed=seed,
        integrator=integrator,
        spp=spp,
        count_rays=count_rays,
        params=params,
        region=region,
    )
    if progress is not None and not isinstance(progress, Progress):
        raise UsageError(f"progress={progress!r}: must be a rendering.progress.Progress")
    with surfacing(), runtime.one_at_a_time:
        return render_with(scene, settings, default() if progress is None else progress)


def render_with(
    scene: Any, settings: RenderSettings, progress: Progress, *, opener: Callable[..., Source] = reopen_scene
) -> Result:
    """Render a scene as ``render`` does; ``opener`` takes the place of ``reopen_scene``."""
    start = time.perf_counter()
    with counting_kernels(progress) as kernels:
        runtime.use(settings.variant)
        runtime.warn_if_slow()
        budget = Budget.of(settings.memory)
        source = opener(
            scene,
            size=(settings.width, settings.height),
            fresnel=settings.fresnel,
            integrator=settings.integrator,
            budget=budget,
            sensor=settings.sensor,
            params=settings.params,
            model=settings.model(),
        )
        with sized(source):
            result = _render(source, settings, budget, kernels, start)
    log.info("%d kernels: compiled in %.3f s, ran for %.3f s", kernels.launches, kernels.compile, kernels.run)
    return result


def _render(
    source: Source, settings: RenderSettings, budget: Budget, kernels: Kernels, start: float
) -> Result:
    """Render an open scene."""
    shader = shader_for(source.scene, source.integrator)
    facts = _facts(source, shader, settings)
    settings = decided(settings, facts)
    plan = _planned(facts, settings.but(integrator=None, params=None, on_round=None))
    exposures = _exposures(plan, settings.seed)
    job = Job(kernels.progress, _workspace(plan, exposures, budget), kernels)
    job.progress.plan(plan)
    shader.prepare(plan.kernel)
    load = time.perf_counter() - start
    log.info("scene %s loaded in %.3f s for %s", source.name, load, plan.variant)
    view = View(source.sensor, source.width, source.height, settings.motion)
    tracer = Tracer(shader, view, job.workspace)
    total: dict[str, np.ndarray] = {}
    for passes in _each_picture(job, tracer, plan, exposures, settings):
        _add(total, passes.run())
    image, layers = _mean(total, plan)
    kernels.collect()
    seconds = time.perf_counter() - start
    return Result(
        image,
        layers,
        plan,
        Timings(seconds, load, kernels.compile, kernels.run, job.passes),
        tracer.rays,
        kernels.launches,
        _in_force(settings, plan, source),
        runtime.versions(),
        view.matrices(),
        frozenset(map(os.path.abspath, budget.inputs)),
        passes.error,
        tuple(passes.rounds),
    )


_planned = lru_cache(maxsize=16)(make_plan)  # most renders are like one before


def _in_force(settings: RenderSettings, plan: Plan, source: Source) -> dict[str, Any]:
    """Return the options that shaped the picture, with what was decided about them."""
    return settings.in_force(
        width=plan.width,
        height=plan.height,
        fresnel=source.fresnel,
        focaldist=plan.focus.distance or 0.0,
        focalrange=plan.focus.range,
        variant=plan.variant,
        integrator=plan.integrator,
        layers=tuple(name for name in settings.layers if name in plan.layers),
    )


def _facts(source: Source, shader: Shader, settings: RenderSettings) -> RenderFacts:
    import mitsuba as mi

    return RenderFacts(
        scene=source.name,
        variant=str(mi.variant()),
        integrator=shader.name,
        width=source.width,
        height=source.height,
        focus=settings.focus(source.focal_distance, source.focal_range),
        traceable=shader.layers,
        random=shader.random,
        film=_film_facts(source, shader) if source.own else None,
        kernel=shader.kernel,
        parts=shader.facts,
    )


def _film_facts(source: Source, shader: Shader) -> FilmFacts:
    film, sampler = source.sensor.film(), source.sensor.sampler()
    return FilmFacts(
        int(sampler.sample_count()),
        sampler.class_name(),
        film.rfilter().class_name(),
        pixel_format(film),
        spectral_bands(film),
        shader.aovs,
    )


def _each_picture(
    job: Job, tracer: Tracer, plan: Plan, exposures: Sequence[Exposure], settings: RenderSettings
) -> Iterator[Passes]:
    kind = Passes
    if plan.lattice.kind == FILM:  # a seventh of all that is imported
        from mrt_mitsuba.rendering.film_passes import FilmPasses as kind
    rays = plan.repeats if settings.maxspp is None else settings.maxspp
    on_round: Any = settings.on_round
    goal = Goal(settings.rmse, rays, settings.maxseconds, on_round)
    for exposure in exposures:
        yield kind(job, tracer, plan, exposure, goal)


def _exposures(plan: Plan, seed: int) -> list[Exposure]:
    """Return what to average: one picture, or the frames of a camera's way if each needs its own filters."""
    whole = Exposure(plan.lattice, plan.repeats, plan.motion, plan.motion_samples, seed)
    if plan.frames == 1:
        return [whole]
    # two passes in a frame, each with random numbers of its own
    return [replace(whole, seed=seed + 2 * frame, frame=frame) for frame in range(plan.frames)]


def _workspace(plan: Plan, exposures: Sequence[Exposure], budget: Budget) -> Workspace:
    return Workspace.next_to(
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
        elif name not in TABLE or TABLE[name].source == AVERAGED:
            total[name] += values


def _mean(total: dict[str, np.ndarray], plan: Plan) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the mean picture [H, W, 3] and its layers by EXR channel, [H, W] each; all are views.

    First come the channels of the film and the integrator, in Mitsuba's order.
    """
    shape, inside = (plan.seen.height, plan.seen.width), plan.region.inside(plan.seen)
    channels, layers = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name, values in total.items():
        own = name not in TABLE  # a channel of the film's or the integrator's
        if plan.frames > 1 and (own or TABLE[name].source == AVERAGED):
            values /= np.float32(plan.frames)
        if own:
            channels[name] = values.reshape(shape)[inside]
        elif name in plan.layers:
            for index, letter in enumerate(TABLE[name].letters):
                layers[f"{name}.{letter}"] = values[:, index].reshape(shape)[inside]
    return total["image"].reshape(*shape, 3)[inside], channels | dict(sorted(layers.items()))
