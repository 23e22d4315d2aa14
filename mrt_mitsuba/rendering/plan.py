"""The render plan: what a render will do and what it leaves out, decided before anything is traced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.output import layers
from mrt_mitsuba.output.layers import DERIVED, FIRST_HIT, LAYERS, TABLE
from mrt_mitsuba.plugins.kernel_plan import KernelPlan, SceneFacts
from mrt_mitsuba.rays.lattice import Lattice
from mrt_mitsuba.rays.region import Region
from mrt_mitsuba.rendering import kernel_text
from mrt_mitsuba.rendering.detectors import DETECTORS
from mrt_mitsuba.rendering.settings import Focus, RenderSettings

# Passes over the picture, in the order in which they may occur
FIRST_HITS, RENDERING, EDGES = "first hits", "rendering", "edges"
REFINEMENT, BLUR = "anti-aliasing", "depth of field"

_WHY = {
    "one-sample": "aa=1 has no further samples to add",
    "all-samples": "aamode=none gives every pixel all its samples",
    "no-focus": "no focal distance",
    "not-needed": "nothing needs it",
    "not-asked-for": "not asked for",
}


@dataclass(frozen=True)
class RenderFacts:
    """What is known of a scene, its integrator and the variant before anything is decided."""

    scene: str  #: its number or name
    variant: str  #: of Mitsuba
    integrator: str  #: name of its plugin
    width: int  #: pixels
    height: int  #: pixels
    focus: Focus  #: what is sharp
    traceable: frozenset[str]  #: layers that the integrator provides
    random: bool  #: does the integrator draw random numbers
    kernel: KernelPlan | None  #: what the tracing kernels hold; None where the integrator does not say
    parts: SceneFacts | None  #: what the kernels depend on


@dataclass(frozen=True)
class Omission:
    """Something that exists in general, but not in this render."""

    name: str  #: of a pass, a layer, or a field of the ``KernelPlan``
    reason: str  #: a fixed word

    @property
    def what(self) -> str:
        """What is left out, in words."""
        return "edge pass" if self.name == EDGES else kernel_text.WHAT.get(self.name, self.name)

    @property
    def why(self) -> str:
        """Why, in words."""
        return _WHY.get(self.reason) or kernel_text.why(self.reason)


@dataclass(frozen=True)
class Pass:
    """A pass over the picture. ``str()`` shows it."""

    name: str  #: ``FIRST_HITS``, ``RENDERING``, ``EDGES``, ``REFINEMENT`` or ``BLUR``
    layers: frozenset[str] = frozenset()  #: that it traces
    samples: int = 0  #: that it traces in a pixel
    first: int = 0  #: number of the first one
    repeats: int = 1  #: rays for each sample
    mode: str = ""  #: of a filter
    noisy: bool = False  #: does a filter take noise for edges

    def __str__(self) -> str:
        times = f", {self.repeats} rays each" if self.repeats > 1 else ""
        shown = [name for name in LAYERS if name in self.layers]
        layers = f", with {', '.join(shown)}" if shown else ""
        noise = ", noise will count as edges: variance needs spp >= 2" if self.noisy else ""
        return {
            FIRST_HITS: f"first hits: 1 ray through the centre of a pixel{layers}",
            RENDERING: f"{self.samples} sample{'s' if self.samples > 1 else ''} a pixel{times}{layers}",
            EDGES: f"edges: {self.mode}{noise}",
            REFINEMENT: f"{self.samples} further samples in edge pixels{times}",
            BLUR: f"depth of field: {self.mode}",
        }[self.name]


@dataclass(frozen=True)
class Plan(RenderFacts):
    """The facts of a render, and what was decided from them and the settings. ``str()`` shows it."""

    region: Region  #: that is returned
    lattice: Lattice  #: where the samples of a pixel lie
    detector: str | None  #: edge detector; None where every pixel gets all samples at once
    blur: str | None  #: depth-of-field mode
    repeats: int  #: rays for each sample
    motion: str | None  #: "frames", "stratified", or None where the camera stands still
    motion_samples: int  #: moments while the shutter is open
    layers: frozenset[str]  #: that are returned
    passes: tuple[Pass, ...]  #: over the picture, in their order
    left_out: tuple[Omission, ...]  #: what, and why

    @property
    def traced(self) -> frozenset[str]:
        """The layers that tracing kernels return."""
        return frozenset().union(*(step.layers for step in self.passes))

    @property
    def channels(self) -> int:
        """Float32 channels kept for every pixel: the picture, its layers, and the detector's."""
        return layers.channels(self.traced | self.layers)

    @property
    def seen(self) -> Region:
        """The region with the pixels around it that filters look at."""
        reach = (edges.REACH if self.detector else 0) + (dof.REACH if self.blur else 0)
        return self.region.grown(reach, self.width, self.height)

    @property
    def frames(self) -> int:
        """Pictures to average, each with filters of its own."""
        return self.motion_samples if self.motion == "frames" and (self.detector or self.blur) else 1

    def __str__(self) -> str:
        lines = [f"Plan for {self.scene}, {self.width}x{self.height}, {self.integrator} in {self.variant}"]
        part = self.region
        if (part.width, part.height) != (self.width, self.height):
            lines += [f"  region  {part.width}x{part.height} from column {part.x}, row {part.y}"]
        moments = "at least {} moments in a pixel" if self.motion == "stratified" else "{} frames"
        if self.motion:
            lines += [f"  pass    motion blur: {moments.format(self.motion_samples)}"]
        lines += [f"  pass    {step}" for step in self.passes]
        if self.kernel is None or self.parts is None:
            lines += [f"  kernel  {self.integrator}.sample"]
        else:
            lines += [f"  kernel  {text}" for text in kernel_text.held(self.kernel, self.parts)]
        for why, group in groupby(self.left_out, lambda omission: omission.why):
            lines += [f"  without {', '.join(omission.what for omission in group)}: {why}"]
        return "\n".join(lines)


def make_plan(facts: RenderFacts, settings: RenderSettings) -> Plan:
    """Decide what to trace and what to leave out. Raises ``UsageError`` for layers that nothing provides."""
    asked, lattice = frozenset(settings.layers), Lattice(settings.lattice, settings.aa)
    _check_layers(asked, facts, settings.aamode)
    detector = settings.aamode if settings.aamode != "none" and (lattice.aa > 1 or "edges" in asked) else None
    blur = settings.dof if facts.focus.distance else None
    traced = _traced(asked, facts, settings, detector)
    passes = _passes(traced, lattice, detector, blur, settings.spp, facts.random)
    made = {step.name for step in passes}
    return Plan(
        **vars(facts),
        region=_region(settings.region, facts),
        lattice=lattice,
        detector=detector,
        blur=blur,
        repeats=settings.spp,
        motion=settings.motionmode if settings.motion else None,
        motion_samples=settings.motionsamples if settings.motion else 1,
        layers=asked | {name for name, layer in LAYERS.items() if layer.free_with in made},
        passes=passes,
        left_out=tuple(_left_out(traced, facts, made, lattice.aa, settings.aamode)),
    )


def _region(asked: Sequence[int] | None, facts: RenderFacts) -> Region:
    region = Region(*(asked or (0, 0, facts.width, facts.height)))
    if region.x + region.width > facts.width or region.y + region.height > facts.height:
        raise UsageError(f"region={asked}: it exceeds the picture, {facts.width}x{facts.height} pixels")
    return region


def _check_layers(asked: frozenset[str], facts: RenderFacts, aamode: str) -> None:
    if "edges" in asked and aamode == "none":
        raise UsageError("layers=edges: aamode=none looks for none; choose luma, sobel or geometry")
    missing = sorted(asked - facts.traceable - layers.named(DERIVED))
    if missing:
        raise UsageError(
            f"layers={','.join(missing)}: {facts.integrator} does not provide these layers; use mrt_whitted"
        )


def _traced(
    asked: frozenset[str], facts: RenderFacts, settings: RenderSettings, detector: str | None
) -> frozenset[str]:
    """Return the layers that must be traced: for the picture, the passes over it, and those asked for."""
    wanted = {"image"} | asked & facts.traceable
    if facts.focus.distance:
        wanted |= {"depth"}
    if detector:
        wanted |= set(DETECTORS[detector].reads)
        if settings.spp > 1 and DETECTORS[detector].takes_variance:
            wanted |= {"square"}
    if settings.count_rays:
        wanted |= {name for name, layer in TABLE.items() if layer.counts} & facts.traceable
    return frozenset(wanted)


def _passes(
    traced: frozenset[str],
    lattice: Lattice,
    detector: str | None,
    blur: str | None,
    repeats: int,
    random: bool,
) -> tuple[Pass, ...]:
    passes = []
    at_centre = traced & layers.named(FIRST_HIT)
    if detector is None:
        if at_centre and not lattice.holds_centre:
            # layers of the first hit belong to the pixel's centre
            passes.append(Pass(FIRST_HITS, at_centre, 1))
            traced -= at_centre
        passes.append(Pass(RENDERING, traced, lattice.count, repeats=repeats))
    else:
        noisy = random and repeats == 1 and DETECTORS[detector].takes_variance
        passes += [Pass(RENDERING, traced, 1, repeats=repeats), Pass(EDGES, mode=detector, noisy=noisy)]
        if lattice.count > 1:
            first = 1 if lattice.holds_centre else 0  # the centre is not traced again
            averaged = traced - at_centre - {"square"}
            passes.append(Pass(REFINEMENT, averaged, lattice.count - first, first, repeats))
    return tuple(passes + ([Pass(BLUR, mode=blur)] if blur else []))


def _left_out(
    traced: frozenset[str], facts: RenderFacts, made: set[str], aa: int, aamode: str
) -> list[Omission]:
    left_out = [Omission(name, reason.value) for name, reason in facts.kernel.reasons] if facts.kernel else []
    if EDGES not in made:
        left_out.append(Omission(EDGES, "all-samples" if aamode == "none" else "one-sample"))
    if BLUR not in made:
        left_out.append(Omission(BLUR, "no-focus"))
    if "depth" not in traced:
        left_out.append(Omission("depth", "not-needed"))
    skipped = [name for name in LAYERS if name in facts.traceable - traced - {"depth"}]
    return left_out + [Omission(name, "not-asked-for") for name in skipped]
