"""The render plan: what a render will do and what it leaves out, decided before anything is traced."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.rays.bundle import Lattice
from mrt_mitsuba.rendering.trace import CHANNELS


@dataclass(frozen=True)
class Omission:
    """Something that exists in general, but not in this render, and why."""

    what: str
    why: str


@dataclass(frozen=True)
class Plan:
    """What a render consists of. ``str()`` shows it."""

    scene: str  #: its number or name
    variant: str  #: of Mitsuba
    integrator: str  #: name of its plugin
    width: int  #: pixels
    height: int  #: pixels
    lattice: Lattice  #: where the samples of a pixel lie
    detector: str | None  #: edge detector; None where every pixel gets all samples at once
    blur: str | None  #: depth-of-field mode
    repeats: int  #: rays for each sample
    motion: str | None  #: "frames", "stratified", or None where the camera stands still
    motion_samples: int  #: moments while the shutter is open
    count_rays: bool  #: were they asked for
    layers: frozenset[str]  #: asked for
    traced_layers: frozenset[str]  #: what the tracing kernels return beside the picture
    kernel: tuple[str, ...]  #: what the tracing kernels hold
    passes: tuple[str, ...]  #: over the picture, in their order
    left_out: tuple[Omission, ...] = field(default=())  #: what, and why

    @property
    def returned_layers(self) -> frozenset[str]:
        """The layers that were asked for, and those that are known anyway."""
        free = {"samples", "edges"} if self.detector else set()
        if self.blur:
            free |= {"depth"}
        return self.layers | free

    @property
    def channels(self) -> int:
        """Float32 channels kept for every pixel: the picture, its layers, and the detector's."""
        sizes = CHANNELS | {"edges": 1, "samples": 1, "blur": 1}
        return sum(sizes[name] for name in {"image", *self.traced_layers, *self.returned_layers})

    def __str__(self) -> str:
        lines = [f"Plan for {self.scene}, {self.width}x{self.height}, {self.integrator} in {self.variant}"]
        lines += [f"  pass    {text}" for text in self.passes]
        lines += [f"  kernel  {text}" for text in self.kernel]
        lines += [f"  without {omission.what}: {omission.why}" for omission in self.left_out]
        return "\n".join(lines)


def make_plan(
    *,
    scene: str,
    variant: str,
    integrator: str,
    width: int,
    height: int,
    lattice: Lattice,
    aamode: str,
    focal_distance: float | None,
    dof: str,
    layers: frozenset[str],
    count_rays: bool,
    repeats: int,
    motion: str | None,
    motion_samples: int,
    random: bool,
    features: Features,
) -> Plan:
    """Decide what to trace and what to leave out. ``layers``: asked for; ``features``: of scene and
    integrator."""
    _check_layers(layers, features, aamode, integrator)
    detector = aamode if aamode != "none" and (lattice.aa > 1 or "edges" in layers) else None
    blur = dof if focal_distance else None
    left_out = list(features.left_out)
    if detector is None and aamode != "none":
        left_out.append(Omission("edge pass", "aa=1 has no further samples to add"))
    elif detector is None:
        left_out.append(Omission("edge pass", "aamode=none gives every pixel all its samples"))
    if blur is None:
        left_out.append(Omission("depth of field", "no focal distance"))
    traced = set(layers & features.layers)
    if blur:
        traced.add("depth")
    elif "depth" not in layers:
        left_out.append(Omission("depth", "nothing asks for it"))
    if detector == "geometry":
        traced |= {"depth", "normal"}
    if detector in ("luma", "sobel") and repeats > 1:
        traced.add("square")
    if count_rays:
        traced |= {"bounces", "shadow_rays"} & features.layers
    skipped = sorted(features.layers - traced - {"depth", "square", "shadow_rays"})
    if skipped:
        left_out.append(Omission(f"layers {', '.join(skipped)}", "not asked for"))
    return Plan(
        scene=scene,
        variant=variant,
        integrator=integrator,
        width=width,
        height=height,
        lattice=lattice,
        detector=detector,
        blur=blur,
        repeats=repeats,
        motion=motion,
        motion_samples=motion_samples if motion else 1,
        count_rays=count_rays,
        layers=layers,
        traced_layers=frozenset(traced),
        kernel=features.kernel,
        passes=(*_motion_pass(motion, motion_samples), *_passes(lattice, detector, blur, repeats, random)),
        left_out=tuple(left_out),
    )


def _check_layers(layers: frozenset[str], features: Features, aamode: str, integrator: str) -> None:
    if "edges" in layers and aamode == "none":
        raise UsageError("layers=edges: aamode=none looks for none; choose luma, sobel or geometry")
    missing = sorted(layers - features.layers - {"edges", "samples", "blur"})
    if missing:
        raise UsageError(f"layers={','.join(missing)}: {integrator} does not tell; mrt_whitted does")


def _motion_pass(motion: str | None, moments: int) -> list[str]:
    if motion is None:
        return []
    return [
        f"motion blur: {moments} frames"
        if motion == "frames"
        else f"motion blur: at least {moments} moments in a pixel"
    ]


def _passes(
    lattice: Lattice, detector: str | None, blur: str | None, repeats: int, random: bool
) -> list[str]:
    times = f", {repeats} rays each" if repeats > 1 else ""
    passes = []
    if detector is None:
        passes += [f"{lattice.count} samples a pixel{times}"]
    else:
        blind = random and repeats == 1 and detector in ("luma", "sobel")
        doubt = ", in which noise counts as edges: one random ray tells no noise, spp=2 does" if blind else ""
        passes += [f"1 sample a pixel{times}", f"edges: {detector}{doubt}"]
    if detector is not None and lattice.count > 1:
        further = lattice.count - 1 if lattice.holds_centre else lattice.count
        passes += [f"{further} further samples in edge pixels{times}"]
    return passes + ([f"depth of field: {blur}"] if blur else [])


@dataclass(frozen=True)
class Features:
    """What a scene and its integrator ask of the tracing kernels, and which layers those can return."""

    kernel: tuple[str, ...]
    left_out: tuple[Omission, ...]
    layers: frozenset[str]


def whitted_features(integrator: Any, facts: Any, plan: Any) -> Features:
    """Put into words what ``mrt_whitted`` has planned."""
    kernel, left_out = [], []

    def decide(needed: bool, text: str, what: str, why: str) -> None:
        if needed:
            kernel.append(text)
        else:
            left_out.append(Omission(what, why))

    decide(plan.bvh, f"{facts.native_shapes} shapes in Mitsuba's BVH", "BVH", "no shapes but analytic ones")
    count = sum(number for _, number in facts.quadrics)
    text = f"{count} exact objects in a tree: {', '.join(plan.quadrics)}"
    decide(bool(plan.quadrics), text, "cones and cylinders", "none in the scene")
    decide(plan.planes, f"{facts.planes} analytic planes", "planes", "none in the scene")
    handling = {"loop": "in a loop"}.get(plan.lights, plan.lights)
    decide(plan.lights != "none", f"{facts.lights} lights, {handling}", "shadow rays", "no light")
    decide(plan.emission, "emission of surfaces", "emission", "no surface emits")
    decide(
        plan.mirrors,
        f"mirror bounces, budget {integrator.max_depth}",
        "bounce loop",
        "max_depth is 1" if integrator.max_depth == 1 else "no material reflects visibly",
    )
    decide(plan.textures, "textures and their coordinates", "textures", "every material is uniform")
    decide(plan.random, "random numbers", "random numbers", "every light is a point or a direction")
    return Features(tuple(kernel), tuple(left_out), integrator.provided_layers())


def stock_features(integrator: Any) -> Features:
    """Of an integrator that is not ours: only what ``SamplingIntegrator.sample`` and the first hit tell."""
    return Features((f"{integrator.class_name()}.sample",), (), frozenset({"depth", "normal", "albedo"}))
