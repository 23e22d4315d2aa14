"""``render``: a scene in, a picture out.

scene → facts → plan → rays → integrator → filters → result: each step is a module, this one orders them.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.interrupts import held
from mrt_mitsuba.memory import Budget, Workspace
from mrt_mitsuba.output.layers import AVERAGED, TABLE
from mrt_mitsuba.rays.film import pixel_format, spectral_bands
from mrt_mitsuba.rendering.defaults import decided
from mrt_mitsuba.rendering.job import Job
from mrt_mitsuba.rendering.passes import Passes
from mrt_mitsuba.rendering.plan import FilmFacts, Plan, RenderFacts, make_plan
from mrt_mitsuba.rendering.progress import Progress, default
from mrt_mitsuba.rendering.result import Result, Timings
from mrt_mitsuba.rendering.rounds import Goal, OnRound
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.rendering.shading import Shader, shader_for
from mrt_mitsuba.rendering.view import View
from mrt_mitsuba.scene.open import Source, open_scene, sized

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
        texturing, camera, up, fov, light: of an OBJ file, see ``scene.obj.model_scene``.
        sensor: number of the sensor in a scene that has several.
        variant: Mitsuba variant; by default the current one, else ``llvm_ad_rgb``.
        memory: bytes (or text such as "4G") to stay within.
        seed: of all random numbers.
        integrator: name, dict or instance of an integrator; by default the scene's own. One that gives whole
            pictures only, such as ``ptracer``, knows no layers, edges, motion or depth of field.
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
    given = dict(locals())  # first of all: the arguments, by name
    settings = RenderSettings.of(**{name: given[name] for name in given.keys() - {"scene", "progress"}})
    if progress is not None and not isinstance(progress, Progress):
        raise UsageError(f"progress={progress!r}: must be a rendering.progress.Progress")
    with runtime.one_at_a_time, held():
        return render_with(scene, settings, default() if progress is None else progress)


def render_with(
    scene: Any, settings: RenderSettings, progress: Progress, *, opener: Callable[..., Source] = open_scene
) -> Result:
    """Render a scene as ``render`` does; ``opener`` takes the place of ``open_scene``."""
    import drjit as dr

    start = time.perf_counter()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
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
        if getattr(source.integrator, "plugin_name", "") == "mrt_adaptive":  # it says where to stop
            if settings.rmse is None and settings.aamode is None and settings.spp is None:
                given = {k: v for k, v in source.integrator.options().items() if getattr(settings, k) is None}
                settings = settings.but(**given)
            source = replace(source, integrator=source.integrator.nested)
        with sized(source):
            return _render(source, settings, budget, Job(progress), start)


def _render(source: Source, settings: RenderSettings, budget: Budget, job: Job, start: float) -> Result:
    """Render an open scene."""
    shader = shader_for(source.scene, source.integrator)
    facts = _facts(source, shader, settings)
    settings = decided(settings, facts)
    plan = make_plan(facts, settings)
    job.workspace = Workspace.next_to(
        plan.seen.width,
        plan.seen.height,
        plan.channels,
        pictures=min(plan.frames, 2),  # the frames' sum, and one of them
        rays_per_pixel=plan.places(0).size,
        budget=budget,
    )
    job.progress.plan(plan)
    shader.prepare(plan.kernel)
    load = time.perf_counter() - start
    log.info("scene %s loaded in %.3f s for %s", source.name, load, plan.variant)
    view = View(source.sensor, source.width, source.height, settings.motion)
    most = plan.repeats if settings.maxspp is None else settings.maxspp
    on_round: Any = settings.on_round
    goal = Goal(settings.rmse, most, settings.maxseconds, on_round)
    total: dict[str, np.ndarray] = {}
    for frame in range(plan.frames):
        # two passes in a frame, each with random numbers of its own
        passes = Passes(
            job, shader, view, plan, settings.seed + 2 * frame, frame if plan.frames > 1 else None
        )
        for name, values in passes.run(goal).items():
            if name not in total:
                total[name] = values
            elif _averaged(name):  # of others, those of the first frame stay
                total[name] += values
    image, layers = _mean(total, plan)
    job.collect()
    log.info("%d kernels: compiled in %.3f s, ran for %.3f s", job.launches, job.compiling, job.running)
    seconds = time.perf_counter() - start
    return Result(
        image,
        layers,
        plan,
        Timings(seconds, load, job.compiling, job.running, job.passes),
        job.rays,
        job.launches,
        _in_force(settings, plan, source),
        runtime.versions(),
        view.matrices(),
        frozenset(map(os.path.abspath, budget.inputs)),
        passes.error,
        tuple(passes.rounds),
    )


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

    own, film = None, source.sensor.film()
    if source.own:
        sampler, rfilter = source.sensor.sampler(), film.rfilter()
        kinds = sampler.class_name(), rfilter.class_name()
        own = FilmFacts(
            int(sampler.sample_count()), *kinds, pixel_format(film), spectral_bands(film), shader.aovs
        )
    return RenderFacts(
        scene=source.name,
        variant=str(mi.variant()),
        integrator=shader.name,
        width=source.width,
        height=source.height,
        focus=settings.focus(source.focal_distance, source.focal_range),
        traceable=shader.layers,
        random=shader.random,
        film=own,
        kernel=shader.kernel,
        parts=shader.facts,
    )


def _averaged(name: str) -> bool:
    """Is a layer a mean over rays, as are the channels of the film and the integrator."""
    return name not in TABLE or TABLE[name].source == AVERAGED


def _mean(total: dict[str, np.ndarray], plan: Plan) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the mean picture [H, W, 3] and its layers by EXR channel, [H, W] each; all are views.

    First come the channels of the film and the integrator, in Mitsuba's order.
    """
    shape, inside = (plan.seen.height, plan.seen.width), plan.region.inside(plan.seen)
    channels, layers = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name, values in total.items():
        if plan.frames > 1 and _averaged(name):
            values /= np.float32(plan.frames)
        if name not in TABLE:
            channels[name] = values.reshape(shape)[inside]
        elif name in plan.layers:
            for index, letter in enumerate(TABLE[name].letters):
                layers[f"{name}.{letter}"] = values[:, index].reshape(shape)[inside]
    return total["image"].reshape(*shape, 3)[inside], channels | dict(sorted(layers.items()))
