"""``render``: a scene in, a picture out.

scene → plan → rays → integrator → filters → result: each step is a module, this one orders them.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import UsageError, printable
from mrt_mitsuba.files import images
from mrt_mitsuba.files.layers import AVERAGED
from mrt_mitsuba.files.layers import TABLE as LAYER_TABLE
from mrt_mitsuba.interrupts import defer_signals
from mrt_mitsuba.machine import budget, workspace
from mrt_mitsuba.options import Values
from mrt_mitsuba.rendering.exposing import FILM_PREFIX
from mrt_mitsuba.rendering.passes import Passes
from mrt_mitsuba.rendering.plan import Plan, make_plan
from mrt_mitsuba.rendering.progress import Job, Progress, Timings, default_progress
from mrt_mitsuba.rendering.settings import Convention, Lattice, RenderSettings
from mrt_mitsuba.rendering.shading import Shader, camera_matrices
from mrt_mitsuba.scene.open import Source, open_scene, sized

Image = NDArray[np.float32]
LONGEST_ARRAY = 64  # entries of an array that the header of an EXR holds; larger ones are named only

if TYPE_CHECKING:
    from mrt_mitsuba.adaptive.error import ErrorEstimate, Round, RoundPicture
    from mrt_mitsuba.adaptive.target import Target


@dataclass(frozen=True, repr=False)
class Result:
    """A finished picture, its layers, and how it was made."""

    image: Image  #: float32 [H, W, 3], linear, top row first
    layers: Mapping[str, Image]  #: float32 [H, W] by EXR channel name, such as "depth.Z"
    plan: Plan  #: what ran, what was left out and why
    timings: Timings  #: seconds
    rays: Mapping[str, int]  #: number by kind; "mirror" and "shadow" only where they were counted
    kernel_launches: int  #: how many kernels ran
    options: Values  #: the values in force
    versions: Mapping[str, str]  #: of what decides about pixels
    camera: Mapping[str, np.ndarray]  #: float64 [4, 4], see ``shading.camera_matrices``
    inputs: frozenset[str] = frozenset()  #: paths of the files that the scene was read from
    error: ErrorEstimate | None = None  #: to the converged picture; None where nothing was estimated
    rounds: tuple[Round, ...] = ()  #: what was known after each: the error over the time of this render

    def save(self, *paths: str | os.PathLike[str], tonemap: str = "report", compression: str = "zip") -> None:
        """Write .png and .exr files, all or none; raise ``OutputError``, also for a file that the scene was
        read from.

        ``tonemap`` ("report" or "srgb") is for PNG files, ``compression`` ("zip" or "none") for EXR.
        """
        images.save(
            paths,
            self.image,
            layers=self.layers,
            header=self.header(),
            tonemap=tonemap,
            compression=compression,
            inputs=self.inputs,
        )

    def header(self) -> dict[str, Any]:
        """Return the header attributes of an EXR: how the picture was made, and nothing such as seconds that
        changes when it is made again.
        """
        version = self.versions["mrt-mitsuba"]
        estimated: dict[str, Any] = {}
        if self.error is not None:
            error = dataclasses.asdict(self.error)
            if error["high"] == np.inf:
                error["high"] = None  # JSON has no infinity
            rounds = [{"spp": each.spp, "rmse": each.rmse} for each in self.rounds]
            estimated = {"mrt:error": error, "mrt:rounds": rounds}
        return {
            "software": f"mrt-mitsuba {version}",
            "mrt:version": version,
            "mrt:scene": self.plan.scene,
            "mrt:options": json.loads(json.dumps(self.options, default=_plain)),
            "mrt:variant": self.plan.variant,
            **{f"mrt:{name}": self.versions[name] for name in ("mitsuba", "drjit", "llvm")},
            **estimated,
            **{f"mrt:{name}": matrix.tolist() for name, matrix in self.camera.items()},
        }

    def __repr__(self) -> str:
        height, width = self.image.shape[:2]
        layers = f", layers {', '.join(self.layers)}" if self.layers else ""
        error = "" if self.error is None else f", error {self.error}"
        name = printable(self.plan.scene)
        return f"<Result of scene {name}: {width}x{height}{layers}{error}, {self.timings.total:.3g} s>"

    def _repr_png_(self) -> bytes:
        """Return the picture as a notebook shows it, in sRGB as screens expect it."""
        return images.png(self.image)


def _plain(value: Any) -> Any:
    """Return an array, or a transform, as numbers, where they are few; else the name of a value's type."""
    if not dr.is_array_v(value):  # else attributes are swizzles
        value = getattr(value, "matrix", value)
    array = np.asarray(value).squeeze()
    few = array.size <= LONGEST_ARRAY and array.dtype.kind in "biuf"
    return array.tolist() if few else f"<{type(value).__name__}>"


def render(  # noqa: PLR0913 - each option has a name that editors show
    scene: Any = 0,
    *,
    width: int | None = None,
    height: int | None = None,
    aa: int | None = None,
    aamode: Literal["none", "luma", "sobel", "geometry", "noise"] | None = None,
    target: Target | float | str | Sequence[float] | None = None,
    metric: Literal["linear", "relative", "display"] | None = None,
    denoise: bool = False,
    maxspp: int | None = None,
    maxseconds: float | None = None,
    lattice: Lattice | None = None,
    fresnel: Literal["schlick", "dielectric"] | None = None,
    focaldist: float | None = None,
    focalrange: float | None = None,
    dof: Literal["report", "corrected"] = "report",
    layers: Sequence[str] | str = (),
    motion: Sequence[float] | None = None,
    motionsamples: int = 16,
    convention: Convention = "report",
    camera: Sequence[float] | None = None,
    up: Sequence[float] | None = None,
    fov: float | None = None,
    variant: str | None = None,
    memory: int | str | None = None,
    seed: int = 0,
    integrator: Any = None,
    sensor: int = 0,
    on_round: Callable[[RoundPicture], object] | None = None,
    spp: int | None = None,
    count_rays: bool = False,
    params: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Result:
    """Render a scene.

    Args:
        scene: number of a scene of the report, a ``Scene``, a Mitsuba dict, a Mitsuba scene, or the path of
            an .xml or .obj file.

    A scene of one's own is rendered as Mitsuba renders it: by the rules of its film, and of its sampler where
    ``aa``, ``aamode`` and ``spp`` are left out. From ``spp=2`` on, "luma" and "sobel" know the variance of
    every pixel and ignore what noise explains; with one random sample they take noise for edges ("geometry"
    never does). With ``target``, samples are allocated adaptively until the estimated error reaches it.

    Motion blur averages ``motionsamples`` whole renders, as the report does; by the rules of a film, each
    sample has a time of its own.

    Raises:
        UsageError: for an argument of the wrong type or range.
        SceneError: for a scene that cannot be read.
        VariantError: for a variant that cannot run here.

    Options:"""
    options = locals()  # first, so that it holds the arguments alone
    scene = options.pop("scene")
    settings = RenderSettings(**options)
    with session(settings) as job:
        return render_source(open_with(scene, settings), settings, job)


if render.__doc__:  # None under ``python -OO``
    render.__doc__ += "\n" + "".join(
        f"\n    - ``{f.name}``: {f.metadata['help']} (default: {f.metadata['shown'] or f.default})."
        for f in dataclasses.fields(RenderSettings)
    )


def refuse_freezing() -> None:
    """Raise ``UsageError`` inside a function that ``dr.freeze`` records."""
    if dr.flag(dr.JitFlag.FreezingScope):
        raise UsageError(
            "a render cannot be recorded by dr.freeze: it decides by what it has traced. Call it outside of "
            "the frozen function; what mrt.prepare(scene) returns has recorded kernels of its own"
        )


@contextmanager
def session(settings: RenderSettings) -> Iterator[Job]:
    """Let one render run alone, in the variant that the settings name, and measure what it costs."""
    refuse_freezing()
    with runtime.render_lock, defer_signals(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        job = Job(settings.progress or default_progress(), budget(settings.memory), settings.on_round)
        variant = runtime.use(settings.variant)
        try:
            yield job
        except Exception:
            if mi.variant() != variant:
                raise UsageError(
                    f"Mitsuba's variant was changed from {variant} to {mi.variant()} during a render, by "
                    "on_round or another callback: change it after the render, or back before it returns"
                ) from None
            raise


def open_with(scene: Any, settings: RenderSettings) -> Source:
    """Load a scene as the options of a render say; see ``render`` for what it may be."""
    given = {
        field.name: value
        for field in dataclasses.fields(settings)
        if (value := getattr(settings, field.name)) is not field.default
    }
    return open_scene(scene, **given)


def render_source(source: Source, settings: RenderSettings, job: Job) -> Result:
    """Plan and render an open scene: what ``render``, ``prepare`` and ``mrt_adaptive`` have in common."""
    with sized(source):  # before the shader, whose film has this size
        shader = Shader(source, settings.motion)
        plan = make_plan(source, shader, settings)
        space = workspace(
            job.budget,
            plan.width,
            plan.height,
            plan.channels,
            pictures=min(plan.frames, 2),  # the frames' sum, and one of them
            rays_per_pixel=max(step.pattern.size for step in plan.passes),
        )
        job.start(plan, space)
        picture = _frames(shader, plan, job)
        layers = picture.layers
        job.collect()
        return Result(
            image=layers["image"],
            layers=_channels(layers, plan),
            plan=dataclasses.replace(plan, left_out=plan.left_out + picture.left_out),
            timings=job.timings,
            rays=job.rays,
            kernel_launches=job.launches,
            options=plan.options,
            versions=runtime.versions(),
            camera=camera_matrices(source.sensor),
            inputs=frozenset(os.path.abspath(path) for path in source.inputs),
            error=picture.error,
            rounds=tuple(picture.rounds),
        )


def _frames(shader: Shader, plan: Plan, job: Job) -> Passes:
    """Trace the plan's frames: the picture of the first one, with the mean of all in its layers,
    [H, W, channels] each.

    Layers that are no averages are those of the first frame.
    """
    picture = Passes(job, shader, plan, 0)
    picture.run()
    layers = picture.layers
    averaged = [name for name in layers if name not in LAYER_TABLE or LAYER_TABLE[name].source == AVERAGED]
    for frame in range(1, plan.frames):
        following = Passes(job, shader, plan, frame)
        following.run()
        for name in [*averaged, *({"samples"} & layers.keys())]:
            layers[name] += following.layers[name]
    for name in averaged if plan.frames > 1 else ():
        layers[name] /= np.float32(plan.frames)
    return picture


def _channels(layers: Mapping[str, np.ndarray], plan: Plan) -> dict[str, Image]:
    """Views [H, W] by EXR channel: first those of the film and the integrator, then our layers.

    A layer of ours is left out where the integrator has a channel of the same name.
    """
    own = {
        name.removeprefix(FILM_PREFIX): layer[..., 0]
        for name, layer in layers.items()
        if name.startswith(FILM_PREFIX)
    }
    channels = dict(own)
    for name in sorted(layers.keys() & plan.layers):
        letters = LAYER_TABLE[name].letters
        names = [f"{name}.{letter}" for letter in letters]
        if own.keys().isdisjoint(names):
            channels |= {channel: layers[name][..., index] for index, channel in enumerate(names)}
    return channels
