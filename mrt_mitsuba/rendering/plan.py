"""The render plan: what a render will do and what it leaves out, decided before anything is traced."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.output import layers
from mrt_mitsuba.output.layers import DERIVED, FIRST_HIT, LAYERS, TABLE
from mrt_mitsuba.plugins import kernel_plan
from mrt_mitsuba.plugins.kernel_plan import KernelPlan, SceneFacts
from mrt_mitsuba.rays.lattice import CENTRE, FILM, Lattice, Places
from mrt_mitsuba.rays.region import Region
from mrt_mitsuba.rendering.settings import DETECTORS, NOISE, Focus, RenderSettings

# Float32 channels of a pixel that its statistics take while rounds are shared out
ROUND_CHANNELS = 240

# Passes over the picture, in the order in which they may occur
FIRST_HITS, RENDERING, EDGES = "first hits", "rendering", "edges"
REFINEMENT, BLUR, ROUNDS = "anti-aliasing", "depth of field", "rounds"

_WHY = {
    "one-sample": "aa=1 has no further samples to add",
    "all-samples": "aamode=none gives every pixel all its samples",
    "no-focus": "no focal distance",
    "not-needed": "nothing needs it",
    "not-asked-for": "not asked for",
    "noise": "rounds go where the variance is",
    "linear-rgb": "pictures are linear sRGB, whose luminance or XYZ follow",
    "spectrum": "the picture is the colour of the spectrum that the film sees, and rounds go by it",
    "one-sequence": "rounds continue one sequence of numbers in each pixel",
    "lattice": "the lattice that was asked for places and averages samples",
    "arrays": "a scalar variant draws independent numbers, ray by ray",
}


@dataclass(frozen=True)
class FilmFacts:
    """The demands of the film and the sampler of someone's own scene."""

    rays: int  #: of each pixel, as the sampler says
    sampler: str  #: its class
    rfilter: str  #: class of the reconstruction filter
    pixel_format: str  #: "rgb", "rgba", "luminance", ...; "" for a film of another kind
    bands: tuple[str, ...] = ()  #: of its spectrum
    aovs: tuple[str, ...] = ()  #: channels of the integrator's own


@dataclass(frozen=True)
class RenderFacts:
    """Facts about a scene, its integrator and the variant, known before anything is decided."""

    scene: str  #: its number or name
    variant: str  #: of Mitsuba
    integrator: str  #: name of its plugin
    width: int  #: pixels
    height: int  #: pixels
    focus: Focus  #: what is sharp
    traceable: frozenset[str]  #: layers that the integrator provides
    random: bool  #: does the integrator draw random numbers
    film: FilmFacts | None  #: of someone's own scene
    kernel: KernelPlan | None  #: what the tracing kernels hold; None where the integrator does not say
    parts: SceneFacts | None  #: what the kernels depend on

    @property
    def whole(self) -> bool:
        """Does the integrator give whole pictures only, and nothing along single rays."""
        return not self.traceable


@dataclass(frozen=True)
class Omission:
    """Something that exists in general, but not in this render."""

    name: str  #: of a pass, a layer, or a field of the ``KernelPlan``
    reason: str  #: a fixed word

    @property
    def what(self) -> str:
        """Return in words what is left out."""
        return "edge pass" if self.name == EDGES else kernel_plan.WHAT.get(self.name, self.name)

    @property
    def why(self) -> str:
        """Why, in words."""
        return _WHY.get(self.reason, self.reason)


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
    film: bool = False  #: are samples placed by the rules of a film

    def __str__(self) -> str:
        if self.film and self.name in (RENDERING, REFINEMENT):
            where = "a pixel" if self.name == RENDERING else "and more in edge pixels"
            return f"{self.samples * self.repeats} rays {where}, placed and filtered by the film"
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
            ROUNDS: f"rounds of rays, {self.mode}",
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
        channels = layers.channels(self.traced | self.layers)
        if self.lattice.kind == FILM:
            # sums by pixel, in double precision, while a film is exposed
            more = len(self.film.bands + self.film.aovs) if self.film else 0
            channels += (ROUND_CHANNELS if ROUNDS in {step.name for step in self.passes} else 28) + 5 * more
        return channels

    @cached_property
    def seen(self) -> Region:
        """The region with the pixels around it that filters look at."""
        reach = (edges.REACH if self.detector else 0) + (dof.REACH if self.blur else 0)
        return self.region.grown(reach, self.width, self.height)

    @property
    def on_film(self) -> bool:
        """Is a film exposed by its own rules, rather than a lattice."""
        return self.lattice.kind == FILM

    def places(self, seed: int, frame: int | None = None, first: int = 0) -> Places:
        """Return the lattice's samples from ``first`` on; ``frame``: of the only moment that is seen."""
        count = self.lattice.count - first
        if self.motion == "stratified":  # every ray of a pixel in a part of its own
            repeats = self.repeats * math.ceil(self.motion_samples / (count * self.repeats))
            return Places(self.lattice, first, count, repeats, count * repeats, None, seed)
        return replace(self.centre(frame), lattice=self.lattice, first=first, count=count)

    def centre(self, frame: int | None) -> Places:
        """Return the pixel's centre alone, at the same times in every pixel."""
        if self.motion is None or frame is not None:
            return replace(self.first_hit(frame), repeats=self.repeats)
        repeats, phase = self.repeats * self.motion_samples, 0.0 if self.motion == "frames" else 0.5
        return Places(CENTRE, repeats=repeats, moments=self.motion_samples, phase=phase)

    def first_hit(self, frame: int | None) -> Places:
        """Return the pixel's centre when the shutter opens, or at the moment of the frame."""
        return Places(CENTRE, moments=int(self.motion is not None), phase=(frame or 0) / self.motion_samples)

    @property
    def frames(self) -> int:
        """Pictures to average, each with filters of its own."""
        return self.motion_samples if self.motion == "frames" and (self.detector or self.blur) else 1

    def __str__(self) -> str:
        lines = [f"Plan for {self.scene}, {self.width}x{self.height}, {self.integrator} in {self.variant}"]
        part = self.region
        if (part.width, part.height) != (self.width, self.height):
            lines += [f"  region  {part.width}x{part.height} from column {part.x}, row {part.y}"]
        moments = {"stratified": "at least {} moments in a pixel", "film": "each ray at its own moment"}
        if self.motion:
            text = moments.get(self.motion, "{} frames").format(self.motion_samples)
            lines += [f"  pass    motion blur: {text}"]
        lines += [f"  pass    {step}" for step in self.passes]
        if self.film and self.lattice.kind == FILM:
            lines += [f"  film    {self.film.rfilter}, {self.film.pixel_format or 'spectral bands'}"]
        if self.kernel is None or self.parts is None:
            lines += [f"  kernel  {self.integrator}.sample"]
        else:
            lines += [f"  kernel  {text}" for text in kernel_plan.held(self.kernel, self.parts)]
        for why, group in groupby(self.left_out, lambda omission: omission.why):
            lines += [f"  without {', '.join(omission.what for omission in group)}: {why}"]
        return "\n".join(lines)


def make_plan(facts: RenderFacts, settings: RenderSettings) -> Plan:
    """Decide what to trace and what to leave out. Raises ``UsageError`` for layers that nothing provides."""
    possible, asked = _possible(facts, settings), frozenset(settings.layers)
    if asked == LAYERS.keys():
        asked &= possible
    _check_layers(asked, facts, settings)
    lattice = Lattice(str(settings.lattice), int(settings.aa or 1))
    aamode = str(settings.aamode)
    detector = aamode if aamode in DETECTORS and (lattice.aa > 1 or "edges" in asked) else None
    blur = settings.dof if facts.focus.distance else None
    traced = _traced(asked, facts, settings, detector)
    passes = _passes(traced, lattice, detector, facts, settings)
    if blur:
        passes += (Pass(BLUR, mode=blur),)
    made = {step.name for step in passes}
    return Plan(
        **vars(facts),
        region=_region(settings.region, facts),
        lattice=lattice,
        detector=detector,
        blur=blur,
        repeats=_repeats(settings, lattice),
        motion=(FILM if lattice.kind == FILM else settings.motionmode) if settings.motion else None,
        motion_samples=settings.motionsamples if settings.motion else 1,
        layers=asked | {name for name in possible if made & set(TABLE[name].free_with)},
        passes=passes,
        left_out=tuple(_left_out(traced, facts, made, settings)),
    )


def _region(asked: Sequence[int] | None, facts: RenderFacts) -> Region:
    region = Region(*(asked or (0, 0, facts.width, facts.height)))
    if region.x + region.width > facts.width or region.y + region.height > facts.height:
        raise UsageError(f"region={asked}: it exceeds the picture, {facts.width}x{facts.height} pixels")
    return region


def _possible(facts: RenderFacts, settings: RenderSettings) -> frozenset[str]:
    """Return the layers that can be made."""
    made = facts.traceable | layers.named(DERIVED)
    made -= {"error", "variance"} if settings.aamode != NOISE else set()
    return made - ({"edges"} if settings.aamode not in DETECTORS else set())


def _check_layers(asked: frozenset[str], facts: RenderFacts, settings: RenderSettings) -> None:
    if "edges" in asked and settings.aamode not in DETECTORS:
        raise UsageError(
            f"layers=edges: aamode={settings.aamode} looks for none; choose luma, sobel or geometry"
        )
    if asked & {"error", "variance"} and settings.aamode != NOISE:
        raise UsageError("layers=error,variance: only rounds estimate them; give a target= or aamode=noise")
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
        wanted |= set(DETECTORS[detector])
        if (settings.spp or 1) > 1 and "image" in DETECTORS[detector]:
            wanted |= {"square"}
    if settings.count_rays:
        wanted |= {name for name, layer in TABLE.items() if layer.counts} & facts.traceable
    return frozenset(wanted)


def _passes(
    traced: frozenset[str],
    lattice: Lattice,
    detector: str | None,
    facts: RenderFacts,
    settings: RenderSettings,
) -> tuple[Pass, ...]:
    passes, repeats, film = [], _repeats(settings, lattice), lattice.kind == FILM
    at_centre = traced & layers.named(FIRST_HIT)
    noise = settings.aamode == NOISE
    if at_centre and (film or (detector is None and not lattice.holds_centre)):
        # layers of the first hit belong to the pixel's centre
        passes.append(Pass(FIRST_HITS, at_centre, 1))
        traced -= at_centre
    if noise:
        passes.append(Pass(ROUNDS, traced, mode=_goal(settings), film=film))
    elif detector is None:
        passes.append(Pass(RENDERING, traced, lattice.count, repeats=repeats, film=film))
    else:
        noisy = facts.random and repeats == 1 and "image" in DETECTORS[detector]
        passes += [
            Pass(RENDERING, traced, 1, repeats=repeats, film=film),
            Pass(EDGES, mode=detector, noisy=noisy),
        ]
        if lattice.count > 1:
            first = 1 if film or lattice.holds_centre else 0  # the centre is not traced again
            averaged = traced - at_centre - {"square"}
            passes.append(Pass(REFINEMENT, averaged, lattice.count - first, first, repeats, film=film))
    return tuple(passes)


def _repeats(settings: RenderSettings, lattice: Lattice) -> int:
    """Return the rays for each sample; on a film, each has a moment of its own."""
    rays, moments = int(settings.spp or 1), settings.motionsamples
    if not settings.motion or lattice.kind != FILM or settings.aamode == NOISE:
        return rays
    return rays * moments if settings.motionmode == "frames" else max(rays, -(-moments // lattice.count))


def _goal(settings: RenderSettings) -> str:
    if settings.rmse is None:
        return f"{settings.spp} a pixel on average, where the variance is"
    seconds = "" if settings.maxseconds is None else f" or {settings.maxseconds:g} s"
    return f"to an error of {settings.rmse:g}, at most {settings.maxspp} a pixel{seconds}"


def _left_out(
    traced: frozenset[str], facts: RenderFacts, made: set[str], settings: RenderSettings
) -> list[Omission]:
    left_out = [Omission(name, why) for name, why in facts.kernel.reasons] if facts.kernel else []
    if EDGES not in made:
        reasons = {"none": "all-samples", NOISE: "noise"}
        left_out.append(Omission(EDGES, reasons.get(str(settings.aamode), "one-sample")))
    if BLUR not in made:
        left_out.append(Omission(BLUR, "no-focus"))
    if "depth" not in traced:
        left_out.append(Omission("depth", "not-needed"))
    skipped = [name for name in LAYERS if name in facts.traceable - traced - {"depth"}]
    left_out += [Omission(name, "not-asked-for") for name in skipped]
    return left_out + _film_left_out(facts, settings)


def _film_left_out(facts: RenderFacts, settings: RenderSettings) -> list[Omission]:
    """Return what a film or a sampler asks for and does not get."""
    film = facts.film
    if film is None:
        return []
    if settings.lattice != FILM:
        return [Omission(f"{film.rfilter} and {film.sampler}", "lattice")]
    left_out = []
    if film.pixel_format.startswith("xyz"):
        left_out.append(Omission(f"pixel format {film.pixel_format}", "linear-rgb"))
    if film.bands:
        left_out.append(Omission(f"{', '.join(film.bands)} in the picture, only as layers", "spectrum"))
    if facts.variant.startswith("scalar"):
        left_out += [Omission(film.sampler, "arrays")] if film.sampler != "IndependentSampler" else []
    elif settings.aamode == NOISE:
        left_out.append(Omission(film.sampler, "one-sequence"))
    return left_out
