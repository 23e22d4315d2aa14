"""``render``: a scene in, a picture out.

scene → plan → rays → integrator → filters → result; each step is a module, this one puts them in order.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mrt_mitsuba import options, runtime
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.memory import MOST_RAYS, rays_at_once
from mrt_mitsuba.plan import Features, Plan, make_plan, stock_features, whitted_features
from mrt_mitsuba.progress import Progress
from mrt_mitsuba.rays import Bundle, Lattice
from mrt_mitsuba.result import Result, Timings
from mrt_mitsuba.source import Source, open_scene
from mrt_mitsuba.trace import AVERAGED, FIRST_HIT, Camera, Tracer, WhittedTracer, trace_bundle

CENTRE = Lattice("report", 1)


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
        scene: number of a scene of the report, a ``Scene``, a Mitsuba dict, a Mitsuba scene, or the path of an .xml or
            .obj file.
        width, height: pixels; 800 and 600, or the film's own where the scene brings a film.
        aa: aa × aa samples in a pixel.
        aamode: "none", "luma", "sobel" or "geometry": which pixels get more than one sample.
        lattice: "report" or "centered", see ``rays.Lattice``.
        fresnel: "schlick" (default) or "dielectric", for the report's scenes.
        focaldist, focalrange: scene units; by default the scene's own; a distance of 0 turns the blur off.
        dof: "report" or "corrected", see ``filters.dof``.
        layers: names from ``output.LAYERS`` to return beside those that are free.
        motion, motionsamples: the camera's way while the shutter is open, and the number of renders averaged.
        convention: meaning of MTL files, "report" or "standard".
        variant: Mitsuba variant; by default the current one, else ``llvm_ad_rgb``.
        memory: bytes (or text such as "4G") to stay within.
        seed: for whatever is random.
        integrator: name, dict or instance of a sampling integrator; by default the scene's own.
        spp: rays for each sample, for integrators that draw random numbers.
        count_rays: count mirror and shadow rays.
        progress: told of plan, stages and progress.

    Raises:
        UsageError: for an argument of the wrong type or range.
        SceneError: for a scene that cannot be read.
        VariantError: for a variant that cannot run here.
    """
    start = time.perf_counter()
    arguments = {name: value for name, value in locals().items() if name in options.TABLE and name != "scene"}
    given = {name: options.check(name, value) if value is not None else None for name, value in arguments.items()}
    job = _Job(Progress() if progress is None else progress)
    with job.counting_kernels():
        variant = runtime.use(variant)
        runtime.warn_if_slow()
        source = open_scene(scene, width=given["width"], height=given["height"], fresnel=given["fresnel"],
                            convention=given["convention"], integrator=integrator)
        tracer, features = _tracer(source)
        focus = _Focus.of(source, given["focaldist"], given["focalrange"])
        plan = make_plan(
            scene=source.name, variant=variant, integrator=_name(source.integrator), width=source.width,
            height=source.height, lattice=Lattice(given["lattice"], given["aa"]), aamode=given["aamode"],
            focal_distance=focus.distance, dof=given["dof"], layers=frozenset(given["layers"]),
            count_rays=count_rays, repeats=_repeats(spp), motion_samples=given["motionsamples"] if motion else 1,
            features=features)
        job.rays_at_once = rays_at_once(plan.width * plan.height, plan.channels, given["memory"])
        job.progress.plan(plan)
        load = time.perf_counter() - start
        frames = _Frames()
        for offset in _offsets(given["motion"], plan.motion_samples):
            camera = Camera(source.sensor, source.width, source.height, offset)
            frames.add(_frame(job, tracer, camera, plan, focus, given["seed"]))
    timings = Timings(time.perf_counter() - start, load, job.compile, job.kernels, job.passes)
    shown = {name: value for name, value in given.items() if value is not None and name not in ("memory", "quiet")}
    return frames.result(plan, timings, job, shown)


@dataclass(frozen=True)
class _Focus:
    distance: float | None
    range: float

    @classmethod
    def of(cls, source: Source, distance: float | None, reach: float | None) -> _Focus:
        distance = source.focal_distance if distance is None else distance
        return cls(distance or None, source.focal_range if reach is None else reach)


def _repeats(spp: Any) -> int:
    if isinstance(spp, bool) or not isinstance(spp, int) or spp < 1:
        raise UsageError(f"spp={spp!r}: must be a whole number, 1 or more")
    return spp


def _tracer(source: Source) -> tuple[Tracer, Features]:
    if hasattr(source.integrator, "trace"):
        tracer = WhittedTracer(source.scene, source.integrator)
        return tracer, whitted_features(source.integrator, tracer.prepared)
    return Tracer(source.scene, source.integrator), stock_features(source.integrator)


def _name(integrator: Any) -> str:
    """Mitsuba does not tell a plugin's name, and calls every integrator from Python a SamplingIntegrator."""
    return "mrt_whitted" if hasattr(integrator, "trace") else integrator.class_name()


def _offsets(motion: Sequence[float] | None, count: int) -> list[tuple[float, ...]]:
    """Where the camera is in each of the renders, relative to its own place."""
    if motion is None:
        return [(0.0, 0.0, 0.0)]
    return [tuple(component * k / count for component in motion) for k in range(count)]


# ------------------------------------------------ One frame ------------------------------------------------


def _frame(job: _Job, tracer: Tracer, camera: Camera, plan: Plan, focus: _Focus, seed: int) -> dict[str, np.ndarray]:
    """One picture and its layers: name to [H W] or [H W, channels], before they get their shape."""
    pixels = range(camera.width * camera.height)
    wanted = plan.traced_layers | {"image"}
    if plan.detector is None:
        layers = _all_samples(job, tracer, camera, plan, pixels, wanted, seed)
        layers["samples"] = np.full(len(pixels), plan.lattice.count, np.float32)
    else:
        layers = job.trace("Rendering", "", tracer, camera, Bundle(pixels, CENTRE, repeats=plan.repeats), wanted, seed)
        edges = _detect(job, plan, layers)
        layers["edges"] = edges.value.ravel()
        layers["samples"] = np.ones(len(pixels), np.float32)
        if plan.lattice.count > 1:
            _refine(job, tracer, camera, plan, np.flatnonzero(edges.mask).astype(np.uint32), layers, seed)
    if plan.blur:
        _blur(job, plan, focus, layers)
    return layers


def _all_samples(job, tracer, camera, plan, pixels, wanted, seed) -> dict[str, np.ndarray]:
    """Every sample of every pixel; layers of the first hit belong to the pixel's centre."""
    bundle = Bundle(pixels, plan.lattice, count=plan.lattice.count, repeats=plan.repeats)
    at_centre = wanted & FIRST_HIT.keys()
    if plan.lattice.holds_centre or not at_centre:
        return job.trace("Rendering", "", tracer, camera, bundle, wanted, seed)
    layers = job.trace("First hits", "", tracer, camera, Bundle(pixels, CENTRE), at_centre, seed)
    return layers | job.trace("Rendering", "", tracer, camera, bundle, wanted - at_centre, seed)


def _detect(job: _Job, plan: Plan, layers: dict[str, np.ndarray]) -> Any:
    from mrt_mitsuba import filters

    shape = (plan.height, plan.width)
    with job.timed("edges"):
        if plan.detector == "geometry":
            return filters.geometry_edges(layers["normal"].reshape(*shape, 3), layers["depth"].reshape(shape))
        variance = None
        if "square" in layers:
            spread = np.maximum(layers["square"] - layers["image"] ** 2, 0) / (plan.repeats - 1)
            variance = spread.reshape(*shape, 3)
        detect = {"luma": filters.luma_edges, "sobel": filters.sobel_edges}[plan.detector]
        return detect(layers["image"].reshape(*shape, 3), variance=variance)


def _refine(job, tracer, camera, plan, pixels, layers, seed) -> None:
    """Add the lattice's other samples in the pixels given; the first sample is not traced again."""
    lattice = plan.lattice
    first = 1 if lattice.holds_centre else 0
    bundle = Bundle(pixels, lattice, first=first, count=lattice.count - first, repeats=plan.repeats)
    wanted = frozenset(name for name in layers if name in AVERAGED and name != "square")
    more = job.trace("Anti-aliasing", "Computing Anti aliasing..", tracer, camera, bundle, wanted, seed + 1)
    for name, values in more.items():
        layers[name][pixels] = (first * layers[name][pixels] + bundle.count * values) / np.float32(lattice.count)
    layers["samples"][pixels] = lattice.count


def _blur(job: _Job, plan: Plan, focus: _Focus, layers: dict[str, np.ndarray]) -> None:
    from mrt_mitsuba import filters

    shape = (plan.height, plan.width)
    depth, image = layers["depth"].reshape(shape), layers["image"].reshape(*shape, 3)
    message = "Computing depth of field.."
    with job.timed("depth of field"), job.progress.stage("Depth of field", len(layers["depth"]), message) as advance:
        blurred = filters.gaussian_dof(image, depth, focal_distance=focus.distance, focal_range=focus.range,
                                       mode=plan.blur)
        layers["image"] = blurred.reshape(-1, 3)
        if "blur" in plan.layers:
            amount = filters.blur_amount(depth, focal_distance=focus.distance, focal_range=focus.range)
            layers["blur"] = amount.ravel()
        advance(len(layers["depth"]))


# ------------------------------------------------ Bookkeeping ------------------------------------------------


@dataclass
class _Job:
    """A render under way: where to report, and what it has cost so far."""

    progress: Progress
    rays_at_once: int = MOST_RAYS
    passes: dict[str, float] = field(default_factory=dict)
    primary_rays: int = 0
    launches: int = 0
    compile: float = 0.0
    kernels: float = 0.0

    def trace(self, title: str, message: str, tracer: Tracer, camera: Camera, bundle: Bundle, wanted: Any,
              seed: int) -> dict[str, np.ndarray]:
        self.primary_rays += bundle.ray_count
        with self.timed(title.lower()), self.progress.stage(title, len(bundle.pixels), message) as advance:
            return trace_bundle(tracer, camera, bundle, wanted, seed=seed, advance=advance,
                                rays_at_once=self.rays_at_once)

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
        layers = {name: values / np.float32(self.count) if name in AVERAGED and self.count > 1 else values
                  for name, values in self.sum.items()}
        rays = {"primary": job.primary_rays}
        if plan.count_rays:
            # means over the pixel's rays, counted in float32 ones: exact to 2^24 for each pixel
            samples = np.float64(plan.repeats) * layers["samples"].astype(np.float64)
            for kind, name in (("mirror", "bounces"), ("shadow", "shadow_rays")):
                if name in layers:
                    rays[kind] = round(self.count * float(np.sum(layers[name] * samples)))
        image = layers.pop("image").reshape(plan.height, plan.width, 3)
        return Result(image, _channels(plan, layers), plan, timings, rays, job.launches, given)


def _channels(plan: Plan, layers: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Layers [H W] or [H W, channels] by EXR channel name, [H, W] each; those that nobody asked for only if free."""
    from mrt_mitsuba.output import LAYERS

    result = {}
    for name in plan.returned_layers & layers.keys():
        for index, letter in enumerate(LAYERS[name]):
            values = layers[name] if layers[name].ndim == 1 else layers[name][:, index]
            result[f"{name}.{letter}"] = np.ascontiguousarray(values.reshape(plan.height, plan.width))
    return dict(sorted(result.items()))
