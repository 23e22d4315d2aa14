"""``render``: a scene in, a picture out.

scene → plan → rays → integrator → filters → result: each step is a module, this one orders them.
"""

from __future__ import annotations

import dataclasses
import io
import logging
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from inspect import Parameter, Signature
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, cast

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from mrt_mitsuba import runtime
from mrt_mitsuba.interrupts import held
from mrt_mitsuba.machine import Budget, Workspace
from mrt_mitsuba.output import files
from mrt_mitsuba.output.layers import AVERAGED
from mrt_mitsuba.output.layers import TABLE as LAYER_TABLE
from mrt_mitsuba.rendering.passes import Passes
from mrt_mitsuba.rendering.plan import Plan, make_plan
from mrt_mitsuba.rendering.progress import Job, Progress, TerminalProgress
from mrt_mitsuba.rendering.settings import TABLE, RenderSettings
from mrt_mitsuba.rendering.shading import Shader, camera_matrices
from mrt_mitsuba.scene.open import Source, open_scene, sized

if TYPE_CHECKING:
    from mrt_mitsuba.output.error import ErrorEstimate, Round

log = logging.getLogger(__name__)
Image = NDArray[np.float32]
Options = ParamSpec("Options")

# The options that a result names: those that shape a picture
_IN_FORCE = (*(name for name in TABLE if name != "memory"), "params", "region", "integrator")


@dataclass(frozen=True)
class Timings:
    """Seconds of one render; ``load`` and ``passes`` add up to about ``total``."""

    total: float  #: all of the render
    load: float  #: scene and plan
    compile: float  #: kernels that were not in the cache
    kernels: float  #: kernels running
    passes: Mapping[str, float]  #: by the name of the pass


@dataclass(frozen=True)
class Result:
    """A finished picture, its layers, and how it was made."""

    image: Image  #: float32 [H, W, 3], linear, top row first
    layers: Mapping[str, Image]  #: float32 [H, W] by EXR channel name, such as "depth.Z"
    plan: Plan  #: what ran, what was left out and why
    timings: Timings  #: seconds
    rays: Mapping[str, int]  #: number by kind; "mirror" and "shadow" only where they were counted
    kernel_launches: int  #: how many kernels ran
    options: Mapping[str, Any]  #: the values in force
    versions: Mapping[str, str]  #: of what decides about pixels
    camera: Mapping[str, np.ndarray]  #: float64 [4, 4], see ``shading.camera_matrices``
    inputs: frozenset[str] = frozenset()  #: paths of the files that the scene was read from
    error: ErrorEstimate | None = None  #: to the converged picture; None where nothing was estimated
    rounds: tuple[Round, ...] = ()  #: what was known after each: the error over the time of this render

    def save(self, *paths: str | os.PathLike[str], tonemap: str = "report") -> None:
        """Write .png and .exr files, all or none; raise ``OutputError``, also for a file that the scene was
        read from.

        ``tonemap`` ("report" or "srgb") concerns a PNG only.
        """
        header = self.header()
        files.save(paths, self.image, layers=self.layers, header=header, tonemap=tonemap, inputs=self.inputs)

    def header(self) -> dict[str, Any]:
        """Return the header attributes of an EXR: how the picture was made, and nothing such as seconds that
        changes when it is made again.
        """
        version = self.versions["mrt-mitsuba"]
        error = self.error and {name: getattr(self.error, name) for name in ("rmse", "low", "high", "tail")}
        if error and error["high"] == np.inf:
            error["high"] = None  # JSON has no infinity
        rounds = [{"spp": each.spp, "rmse": each.rmse} for each in self.rounds]
        return {
            "software": f"mrt-mitsuba {version}",
            "mrt:version": version,
            "mrt:scene": self.plan.scene,
            "mrt:options": dict(self.options),
            "mrt:variant": self.plan.variant,
            **{f"mrt:{name}": self.versions[name] for name in ("mitsuba", "drjit", "llvm")},
            **({"mrt:error": error, "mrt:rounds": rounds} if error else {}),
            **{f"mrt:{name}": matrix.tolist() for name, matrix in self.camera.items()},
        }

    def _repr_png_(self) -> bytes:
        """Show the picture in a notebook, in sRGB as screens expect it."""
        from PIL import Image as PilImage

        buffer = io.BytesIO()
        PilImage.fromarray(files.to_8bit(self.image, "srgb")).save(buffer, format="PNG")
        return buffer.getvalue()


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
    shader = Shader(source, settings.motion)
    plan, settings = make_plan(source, shader, settings)
    workspace = Workspace.next_to(
        plan.seen.width,
        plan.seen.height,
        plan.channels,
        pictures=min(plan.frames, 2),  # the frames' sum, and one of them
        rays_per_pixel=max(step.places.size for step in plan.passes),
        budget=budget,
    )
    in_notebook = settings.progress is None and "ipykernel" in sys.modules
    job = Job(TerminalProgress() if in_notebook else settings.progress or Progress(), workspace)
    job.progress.plan(plan)
    load = time.perf_counter() - start
    log.info("scene %s loaded in %.3f s for %s", source.name, load, plan.variant)
    total = dict[str, np.ndarray]()
    for frame in range(plan.frames):
        passes = Passes(job, shader, plan, settings, frame)
        found = passes.run()
        total = total or found
        for name in found if plan.frames > 1 else ():
            if name in LAYER_TABLE and LAYER_TABLE[name].source != AVERAGED:
                continue  # those of the first frame stay
            if frame:
                total[name] += found[name]
            if frame == plan.frames - 1:
                total[name] /= np.float32(plan.frames)
    inside = plan.region.inside(plan.seen)
    # views of the region [H, W] by EXR channel, first those of the film and the integrator
    channels = {name: values[inside][..., 0] for name, values in total.items() if name not in LAYER_TABLE}
    for name in sorted(total.keys() & plan.layers):
        for index, letter in enumerate(LAYER_TABLE[name].letters):
            channels[f"{name}.{letter}"] = total[name][inside][..., index]
    job.collect()
    log.info("%d kernels: compiled in %.3f s, ran for %.3f s", job.launches, job.compiling, job.running)
    seconds = time.perf_counter() - start
    return Result(
        total["image"][inside],
        channels,
        plan,
        Timings(seconds, load, job.compiling, job.running, job.passes),
        job.rays,
        job.launches,
        {name: value for name in _IN_FORCE if (value := getattr(settings, name)) is not None},
        runtime.versions(),
        camera_matrices(source.sensor),
        frozenset(map(os.path.abspath, budget.inputs)),
        passes.error,
        tuple(passes.rounds),
    )
