"""``render``: a scene in, a picture out.

scene → plan → rays → integrator → filters → result; each step is a module, this one puts them in order.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mrt_mitsuba import options, runtime
from mrt_mitsuba.memory import MOST_RAYS, rays_at_once
from mrt_mitsuba.plan import Features, Plan, make_plan, stock_features, whitted_features
from mrt_mitsuba.progress import Progress
from mrt_mitsuba.rays import Bundle, Lattice, Shutter
from mrt_mitsuba.result import Result, Timings
from mrt_mitsuba.source import Source, open_scene
from mrt_mitsuba.trace import AVERAGED, FIRST_HIT, Camera, Tracer, WhittedTracer, trace_bundle

CENTRE = Lattice("report", 1)

# Layers that count rays, by the kind of ray
SECONDARY_RAYS = {"mirror": "bounces", "shadow": "shadow_rays"}


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
    job = _Job(Progress() if progress is None else progress)
    with job.counting_kernels():
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
        focus = _Focus.of(source, given["focaldist"], given["focalrange"])
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
        job.rays_at_once = rays_at_once(plan.width * plan.height, plan.channels, given["memory"])
        job.progress.plan(plan)
        load = time.perf_counter() - start
        camera = Camera(source.sensor, source.width, source.height, given["motion"])
        frames = _Frames()
        for exposure in _exposures(plan, given["seed"]):
            frames.add(_frame(job, tracer, camera, plan, focus, exposure))
    timings = Timings(time.perf_counter() - start, load, job.compile, job.kernels, job.passes)
    shown = {
        name: value for name, value in given.items() if value is not None and name not in ("memory", "quiet")
    }
    return frames.result(plan, timings, job, shown)


@dataclass(frozen=True)
class _Focus:
    distance: float | None
    range: float

    @classmethod
    def of(cls, source: Source, distance: float | None, reach: float | None) -> _Focus:
        distance = source.focal_distance if distance is None else distance
        return cls(distance or None, source.focal_range if reach is None else reach)


def _tracer(source: Source) -> tuple[Tracer, Features]:
    if hasattr(source.integrator, "trace"):
        tracer = WhittedTracer(source.scene, source.integrator)
        return tracer, whitted_features(source.integrator, tracer.prepared)
    return Tracer(source.scene, source.integrator), stock_features(source.integrator)


def _name(integrator: Any) -> str:
    """Mitsuba does not tell a plugin's name, and calls every integrator from Python a SamplingIntegrator."""
    return "mrt_whitted" if hasattr(integrator, "trace") else integrator.class_name()


# ----------------------------------------------- Motion blur -----------------------------------------------


@dataclass(frozen=True)
class _Exposure:
    """One picture while the shutter is open. ``frame``: which of the plan's frames, or None for all of the
    time."""

    plan: Plan
    seed: int
    frame: int | None = None

    def lattice(self, pixels: Any, *, first: int = 0) -> Bundle:
        """The lattice's samples from ``first`` on."""
        plan, count = self.plan, self.plan.lattice.count - first
        if plan.motion == "stratified":
            # every ray of a pixel in a part of its own
            repeats = plan.repeats * math.ceil(plan.motion_samples / (count * plan.repeats))
            return Bundle(
                pixels, plan.lattice, first, count, repeats, Shutter(count * repeats, seed=self.seed)
            )
        return Bundle(pixels, plan.lattice, first, count, plan.repeats * self._moments, self._shutter)

    def centre(self, pixels: Any) -> Bundle:
        """The pixel's centre alone, at the same times in every pixel: a detector must see no noise."""
        return Bundle(pixels, CENTRE, repeats=self.plan.repeats * self._moments, shutter=self._shutter)

    def first_hit(self, pixels: Any) -> Bundle:
        """The pixel's centre when the shutter opens, or at the moment of the frame."""
        still = self.plan.motion is None
        return Bundle(
            pixels,
            CENTRE,
            shutter=None if still else Shutter(1, (self.frame or 0) / self.plan.motion_samples),
        )

    @property
    def _moments(self) -> int:
        return self.plan.motion_samples if self.frame is None else 1

    @property
    def _shutter(self) -> Shutter | None:
        if self.plan.motion is None:
            return None
        if self.frame is not None:
            return Shutter(1, self.frame / self.plan.motion_samples)
        return Shutter(self._moments, 0.0 if self.plan.motion == "frames" else 0.5)


def _exposures(plan: Plan, seed: int) -> list[_Exposure]:
    """What to average: one picture, or the frames of a camera's way where each needs filters of its own."""
    if plan.motion == "frames" and (plan.detector or plan.blur):
        # two passes in a frame, each with random numbers of its own
        return [_Exposure(plan, seed + 2 * frame, frame) for frame in range(plan.motion_samples)]
    return [_Exposure(plan, seed)]


# ------------------------------------------------ One frame ------------------------------------------------


def _frame(
    job: _Job, tracer: Tracer, camera: Camera, plan: Plan, focus: _Focus, exposure: _Exposure
) -> dict[str, np.ndarray]:
    """One picture and its layers: name to [H W] or [H W, channels], before they get their shape."""
    pixels = range(camera.width * camera.height)
    wanted = plan.traced_layers | {"image"}
    if plan.detector is None:
        layers = _all_samples(job, tracer, camera, exposure, pixels, wanted)
        layers["samples"] = np.full(len(pixels), plan.lattice.count, np.float32)
    else:
        bundle = exposure.centre(pixels)
        layers = job.trace("Rendering", "", tracer, camera, bundle, wanted, exposure.seed)
        edges = _detect(job, plan, layers, bundle.rays_per_pixel)
        layers["edges"] = edges.value.ravel()
        layers["samples"] = np.ones(len(pixels), np.float32)
        if plan.lattice.count > 1:
            _refine(job, tracer, camera, exposure, np.flatnonzero(edges.mask).astype(np.uint32), layers)
    if plan.blur:
        _blur(job, plan, focus, layers)
    return layers


def _all_samples(job, tracer, camera, exposure, pixels, wanted) -> dict[str, np.ndarray]:
    """Every sample of every pixel; layers of the first hit belong to the pixel's centre."""
    bundle, seed = exposure.lattice(pixels), exposure.seed
    at_centre = wanted & FIRST_HIT.keys()
    if exposure.plan.lattice.holds_centre or not at_centre:
        return job.trace("Rendering", "", tracer, camera, bundle, wanted, seed)
    layers = job.trace("First hits", "", tracer, camera, exposure.first_hit(pixels), at_centre, seed)
    return layers | job.trace("Rendering", "", tracer, camera, bundle, wanted - at_centre, seed)


def _detect(job: _Job, plan: Plan, layers: dict[str, np.ndarray], rays: int) -> Any:
    """Look for edges in a picture of so many rays a pixel."""
    pixels = plan.width * plan.height
    with job.timed("edges"), job.progress.stage("Edges", pixels) as advance:
        edges = _find_edges(plan, layers, rays)
        advance(pixels)
    return edges


def _find_edges(plan: Plan, layers: dict[str, np.ndarray], rays: int) -> Any:
    from mrt_mitsuba import filters

    shape = (plan.height, plan.width)
    if plan.detector == "geometry":
        return filters.geometry_edges(layers["normal"].reshape(*shape, 3), layers["depth"].reshape(shape))
    variance = None
    if "square" in layers:
        spread = np.maximum(layers["square"] - layers["image"] ** 2, 0) / (rays - 1)
        variance = spread.reshape(*shape, 3)
    detect = {"luma": filters.luma_edges, "sobel": filters.sobel_edges}[plan.detector]
    return detect(layers["image"].reshape(*shape, 3), variance=variance)


def _refine(job, tracer, camera, exposure, pixels, layers) -> None:
    """Add the lattice's other samples in the pixels given; the first sample is not traced again."""
    lattice = exposure.plan.lattice
    first = 1 if lattice.holds_centre else 0
    bundle = exposure.lattice(pixels, first=first)
    wanted = frozenset(name for name in layers if name in AVERAGED and name != "square")
    more = job.trace(
        "Anti-aliasing", "Computing Anti aliasing..", tracer, camera, bundle, wanted, exposure.seed + 1
    )
    for name, values in more.items():
        layers[name][pixels] = (first * layers[name][pixels] + bundle.count * values) / np.float32(
            lattice.count
        )
    layers["samples"][pixels] = lattice.count


def _blur(job: _Job, plan: Plan, focus: _Focus, layers: dict[str, np.ndarray]) -> None:
    from mrt_mitsuba import filters

    shape = (plan.height, plan.width)
    depth, image = layers["depth"].reshape(shape), layers["image"].reshape(*shape, 3)
    message = "Computing depth of field.."
    with (
        job.timed("depth of field"),
        job.progress.stage("Depth of field", len(layers["depth"]), message) as advance,
    ):
        blurred = filters.gaussian_dof(
            image, depth, focal_distance=focus.distance, focal_range=focus.range, mode=plan.blur
        )
        layers["image"] = blurred.reshape(-1, 3)
        if "blur" in plan.layers:
            amount = filters.blur_amount(depth, focal_distance=focus.distance, focal_range=focus.range)
            layers["blur"] = amount.ravel()
        advance(len(layers["depth"]))


# ----------------------------------------------- Bookkeeping ------------------------------------------------


@dataclass
class _Job:
    """A render under way: where to report, and what it has cost so far."""

    progress: Progress
    rays_at_once: int = MOST_RAYS
    passes: dict[str, float] = field(default_factory=dict)
    rays: dict[str, int] = field(default_factory=lambda: {"primary": 0})
    launches: int = 0
    compile: float = 0.0
    kernels: float = 0.0

    def trace(
        self, title: str, message: str, tracer: Tracer, camera: Camera, bundle: Bundle, wanted: Any, seed: int
    ) -> dict[str, np.ndarray]:
        with self.timed(title.lower()), self.progress.stage(title, len(bundle.pixels), message) as advance:
            layers = trace_bundle(
                tracer, camera, bundle, wanted, seed=seed, advance=advance, rays_at_once=self.rays_at_once
            )
        self.rays["primary"] += bundle.ray_count
        for kind, name in SECONDARY_RAYS.items():
            if name in layers:
                # means over the pixel's rays, counted in float32 ones: exact to 2^24 for each pixel
                count = round(bundle.rays_per_pixel * float(np.sum(layers[name], dtype=np.float64)))
                self.rays[kind] = self.rays.get(kind, 0) + count
        return layers

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.passes[name] = self.passes.get(name, 0.0) + time.perf_counter() - start

    @contextmanager
    def counting_kernels(self) -> Iterator[None]:
        """Let Dr.Jit keep a record of its kernels meanwhile, and add it up."""
        import drjit as dr

        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            yield
            history = dr.kernel_history([dr.KernelType.JIT])
        self.launches = len(history)
        self.compile = sum(entry["codegen_time"] + entry["backend_time"] for entry in history) / 1000
        self.kernels = sum(entry["execution_time"] for entry in history) / 1000


class _Frames:
    """The mean of the frames of a motion-blurred render, or the only frame."""

    def __init__(self) -> None:
        self.sum: dict[str, np.ndarray] = {}
        self.count = 0

    def add(self, frame: dict[str, np.ndarray]) -> None:
        """Add a frame; of layers that name a point, the first frame's stay."""
        for name, values in frame.items():
            if self.count == 0:
                self.sum[name] = values
            elif name in AVERAGED:
                self.sum[name] += values
        self.count += 1

    def result(self, plan: Plan, timings: Timings, job: _Job, given: Mapping[str, Any]) -> Result:
        layers = {
            name: values / np.float32(self.count) if name in AVERAGED and self.count > 1 else values
            for name, values in self.sum.items()
        }
        image = layers.pop("image").reshape(plan.height, plan.width, 3)
        return Result(image, _channels(plan, layers), plan, timings, job.rays, job.launches, given)


def _channels(plan: Plan, layers: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Layers [H W] or [H W, channels] by EXR channel name, [H, W] each; those that nobody asked for only if
    free."""
    from mrt_mitsuba.output import LAYERS

    result = {}
    for name in plan.returned_layers & layers.keys():
        for index, letter in enumerate(LAYERS[name]):
            values = layers[name] if layers[name].ndim == 1 else layers[name][:, index]
            result[f"{name}.{letter}"] = np.ascontiguousarray(values.reshape(plan.height, plan.width))
    return dict(sorted(result.items()))
