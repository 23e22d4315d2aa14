"""``render``: a scene in, a picture out.

scene → plan → rays → integrator → filters → result: each step is a module, this one orders them.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from inspect import Parameter, Signature
from typing import Any, ParamSpec, Protocol, cast

import drjit as dr
import numpy as np

from mrt_mitsuba import runtime
from mrt_mitsuba.interrupts import held
from mrt_mitsuba.memory import Budget, Workspace
from mrt_mitsuba.output.layers import AVERAGED, TABLE
from mrt_mitsuba.rendering import settings as table
from mrt_mitsuba.rendering.passes import Passes
from mrt_mitsuba.rendering.plan import Plan, make_plan
from mrt_mitsuba.rendering.progress import Job, Progress, TerminalProgress
from mrt_mitsuba.rendering.result import Result, Timings
from mrt_mitsuba.rendering.rounds import Goal
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.rendering.shading import Shader, View
from mrt_mitsuba.scene.open import Source, open_scene, sized

log = logging.getLogger(__name__)
Options = ParamSpec("Options")


class Render(Protocol[Options]):
    """A function of a scene and the options of a render."""

    def __call__(self, scene: Any = 0, *args: Options.args, **options: Options.kwargs) -> Result: ...


def _with_options(settings: Callable[Options, RenderSettings]) -> Callable[[Any], Render[Options]]:
    """Let a function of a scene and ``**options`` show them in its signature and docstring."""
    fields = dataclasses.fields(cast(Any, settings))
    lines = "\n".join(
        f"        {f.name}: {f.metadata['help']} (default: {f.metadata['shown'] or f.default})."
        for f in fields
    )
    scene = Parameter("scene", Parameter.POSITIONAL_OR_KEYWORD, default=0, annotation="Any")
    named = [Parameter(f.name, Parameter.KEYWORD_ONLY, default=f.default, annotation=f.type) for f in fields]

    def decorate(function: Any) -> Render[Options]:
        function.__signature__ = Signature([scene, *named], return_annotation="Result")
        function.__doc__ = function.__doc__.replace("        OPTIONS", lines)
        return cast(Render[Options], function)

    return decorate


@_with_options(RenderSettings)
def render(scene: Any = 0, **options: Any) -> Result:
    """Render a scene.

    Args:
        scene: number of a scene of the report, a ``Scene``, a Mitsuba dict, a Mitsuba scene, or the path of
            an .xml or .obj file.
        OPTIONS

    A scene of one's own is rendered as Mitsuba renders it: by the rules of its film, and of its sampler where
    ``aa``, ``aamode`` and ``spp`` are left out. From ``spp=2`` on, "luma" and "sobel" know the variance of
    every pixel and ignore what noise explains; with one random ray they take noise for edges ("geometry"
    never does). With ``target``, rays go in rounds to where they are needed.

    ``motionmode="frames"`` averages ``motionsamples`` whole renders, as the report does; "stratified" is one
    render whose rays are spread over the time while the shutter is open, that many or more in a pixel.

    Raises:
        UsageError: for an argument of the wrong type or range.
        SceneError: for a scene that cannot be read.
        VariantError: for a variant that cannot run here.
    """
    with runtime.one_at_a_time, held():
        return render_with(scene, RenderSettings.of(**options))


def render_with(
    scene: Any, settings: RenderSettings, *, opener: Callable[..., Source] = open_scene
) -> Result:
    """Render a scene as ``render`` does; ``opener`` takes the place of ``open_scene``."""
    start = time.perf_counter()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        runtime.use(settings.variant)
        runtime.warn_if_slow()
        budget = Budget.of(cast("int | None", settings.memory))
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
            return _render(source, settings, budget, start)


def _render(source: Source, settings: RenderSettings, budget: Budget, start: float) -> Result:
    """Render an open scene."""
    shader = Shader(source.scene, source.integrator)
    plan, settings = make_plan(source, shader, settings)
    workspace = Workspace.next_to(
        plan.seen.width,
        plan.seen.height,
        plan.channels,
        pictures=min(plan.frames, 2),  # the frames' sum, and one of them
        rays_per_pixel=plan.places(0).size,
        budget=budget,
    )
    in_notebook = settings.progress is None and "ipykernel" in sys.modules
    job = Job(TerminalProgress() if in_notebook else settings.progress or Progress(), workspace)
    job.progress.plan(plan)
    shader.prepare(plan.kernel)
    load = time.perf_counter() - start
    log.info("scene %s loaded in %.3f s for %s", source.name, load, plan.variant)
    view = View(source.sensor, source.width, source.height, settings.motion)
    most = plan.repeats if settings.maxspp is None else settings.maxspp
    goal = Goal(settings.rmse, most, settings.maxseconds, settings.on_round)
    frames, total = plan.frames, dict[str, np.ndarray]()
    for frame in range(frames):
        # two passes in a frame, each with random numbers of its own
        seed, moment = settings.seed + 2 * frame, frame if frames > 1 else None
        passes = Passes(job, shader, view, plan, seed, moment)
        for name, values in passes.run(goal).items():
            if name not in total:
                total[name] = values
            elif (
                name not in TABLE or TABLE[name].source == AVERAGED
            ):  # of others, those of the first frame stay
                total[name] += values
            if frames > 1 and frame == frames - 1 and (name not in TABLE or TABLE[name].source == AVERAGED):
                total[name] /= np.float32(frames)
    image, layers = _cut(total, plan)
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


def _cut(total: dict[str, np.ndarray], plan: Plan) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the region of the picture [H, W, 3], and of its layers by EXR channel, [H, W] each: views.

    First come the channels of the film and the integrator, in Mitsuba's order.
    """
    inside = plan.region.inside(plan.seen)
    channels = {name: values[inside][..., 0] for name, values in total.items() if name not in TABLE}
    for name in sorted(total.keys() & plan.layers):
        letters = enumerate(TABLE[name].letters)
        channels |= {f"{name}.{letter}": total[name][inside][..., index] for index, letter in letters}
    return total["image"][inside], channels


def _in_force(settings: RenderSettings, plan: Plan, source: Source) -> dict[str, Any]:
    """Return the options that shaped the picture, with what was decided about them."""
    names = (*(name for name in table.TABLE if name != "memory"), "params", "region")
    values = {name: getattr(settings, name) for name in names} | {
        "width": plan.width,
        "height": plan.height,
        "fresnel": source.fresnel,
        "focaldist": plan.focus.distance or 0.0,
        "focalrange": plan.focus.range,
        "variant": plan.variant,
        "integrator": plan.integrator,
        "layers": tuple(name for name in settings.layers if name in plan.layers),
    }
    return {name: value for name, value in values.items() if value is not None}
