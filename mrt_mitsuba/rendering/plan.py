"""The render plan: what a render will do and what it leaves out, decided before anything is traced."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple

import mitsuba as mi

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.output import layers
from mrt_mitsuba.output.layers import DERIVED, FIRST_HIT, LAYERS, TABLE
from mrt_mitsuba.plugins import kernel_plan
from mrt_mitsuba.plugins.kernel_plan import KernelPlan, SceneFacts
from mrt_mitsuba.rays.film import Region, pixel_format, spectral_bands
from mrt_mitsuba.rays.lattice import Lattice, Places
from mrt_mitsuba.rendering.settings import DETECTORS, FILM, MAX_SPP, MIN_SPP, NOISE, Focus, RenderSettings
from mrt_mitsuba.rendering.shading import Shader
from mrt_mitsuba.scene.open import Source

# Float32 channels of a pixel that its statistics take while rounds are shared out
ROUND_CHANNELS = 240

# Passes over the picture, in the order in which they may occur
FIRST_HITS, RENDERING, EDGES = "first hits", "rendering", "edges"
REFINEMENT, BLUR, ROUNDS = "anti-aliasing", "depth of field", "rounds"


class FilmFacts(NamedTuple):
    """The demands of the film and the sampler of someone's own scene."""

    rays: int  #: of each pixel, as the sampler says
    sampler: str  #: its class
    rfilter: str  #: class of the reconstruction filter
    pixel_format: str  #: "rgb", "rgba", "luminance", ...; "" for a film of another kind
    bands: tuple[str, ...] = ()  #: of its spectrum
    aovs: tuple[str, ...] = ()  #: channels of the integrator's own


class Omission(NamedTuple):
    """Something that exists in general, but not in this render."""

    what: str  #: a pass, a layer, or a part of the kernels, in words
    why: str  #: in words


@dataclass(frozen=True)
class Pass:
    """A pass over the picture. ``str()`` shows it."""

    name: str  #: ``FIRST_HITS``, ``RENDERING``, ``EDGES``, ``REFINEMENT``, ``BLUR`` or ``ROUNDS``
    layers: frozenset[str] = frozenset()  #: that it traces
    samples: int = 0  #: that it traces in a pixel
    first: int = 0  #: number of the first one
    repeats: int = 1  #: rays for each sample
    mode: str = ""  #: of a filter, or what rounds go to
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


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What was known before a render, and what was decided from it and the settings. ``str()`` shows it."""

    scene: str  #: its number or name
    variant: str  #: of Mitsuba
    integrator: str  #: name of its plugin
    width: int  #: pixels
    height: int  #: pixels
    focus: Focus  #: what is sharp
    whole: bool  #: does the integrator give whole pictures only, and nothing along single rays
    film: FilmFacts | None  #: of someone's own scene
    kernel: KernelPlan | None  #: what the tracing kernels hold; None where the integrator does not say
    parts: SceneFacts | None  #: what the kernels depend on
    region: Region  #: that is returned
    seen: Region  #: with the pixels around it that filters look at
    lattice: Lattice  #: where the samples of a pixel lie
    on_film: bool  #: is a film exposed by its own rules, rather than a lattice
    detector: str | None  #: edge detector; None where every pixel gets all samples at once
    blur: str | None  #: depth-of-field mode
    repeats: int  #: rays for each sample
    motion: str | None  #: "frames", "stratified", or None where the camera stands still
    motion_samples: int  #: moments while the shutter is open
    frames: int  #: pictures to average, each with filters of its own
    layers: frozenset[str]  #: that are returned
    passes: tuple[Pass, ...]  #: over the picture, in their order
    left_out: tuple[Omission, ...]  #: what, and why

    @property
    def channels(self) -> int:
        """Float32 channels kept for every pixel: the picture, its layers, and the detector's."""
        channels = layers.channels(self.layers.union(*(step.layers for step in self.passes)))
        if self.on_film:  # sums by pixel, in double precision, while a film is exposed
            more = len(self.film.bands + self.film.aovs) if self.film else 0
            channels += (ROUND_CHANNELS if ROUNDS in {step.name for step in self.passes} else 28) + 5 * more
        return channels

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
        return Places(repeats=repeats, moments=self.motion_samples, phase=phase)

    def first_hit(self, frame: int | None) -> Places:
        """Return the pixel's centre when the shutter opens, or at the moment of the frame."""
        return Places(moments=int(self.motion is not None), phase=(frame or 0) / self.motion_samples)

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
        if self.film and self.on_film:
            lines += [f"  film    {self.film.rfilter}, {self.film.pixel_format or 'spectral bands'}"]
        if self.kernel is None or self.parts is None:
            lines += [f"  kernel  {self.integrator}.sample"]
        else:
            lines += [f"  kernel  {text}" for text in kernel_plan.held(self.kernel, self.parts)]
        for why, group in groupby(self.left_out, lambda omission: omission.why):
            lines += [f"  without {', '.join(omission.what for omission in group)}: {why}"]
        return "\n".join(lines)


def make_plan(source: Source, shader: Shader, settings: RenderSettings) -> tuple[Plan, RenderSettings]:
    """Decide what to trace and what to leave out; return the settings in force as well.

    Raises ``UsageError`` for options that do not go together, and for layers that nothing provides.
    """
    film = _film(source, shader)
    focus = settings.focus(source.focal_distance, source.focal_range)
    settings = _decided(settings, film, shader, focus)
    lattice = Lattice(str(settings.lattice), int(settings.aa or 1))
    aamode, on_film = str(settings.aamode), lattice.kind == FILM
    asked, possible = _layers(settings, shader)
    detector = aamode if aamode in DETECTORS and (lattice.aa > 1 or "edges" in asked) else None
    repeats, moments = int(settings.spp or 1), settings.motionsamples if settings.motion else 1
    if settings.motion and on_film and aamode != NOISE:  # on a film, each ray has a moment of its own
        least = -(-moments // lattice.count)
        repeats = repeats * moments if settings.motionmode == "frames" else max(repeats, least)
    traced = _traced(asked & shader.layers, focus, detector, shader, settings)
    passes = _passes(traced, lattice, detector, repeats, shader, settings)
    blur = settings.dof if focus.distance else None
    passes += (Pass(BLUR, mode=blur),) if blur else ()
    motion = (FILM if on_film else settings.motionmode) if settings.motion else None
    reach = edges.REACH * bool(detector) + dof.REACH * bool(blur)
    made = {step.name for step in passes}
    region = Region(*(settings.region or (0, 0, source.width, source.height)))
    if region.x + region.width > source.width or region.y + region.height > source.height:
        size = f"{source.width}x{source.height} pixels"
        raise UsageError(f"region={settings.region}: it exceeds the picture, {size}")
    plan = Plan(
        scene=source.name,
        variant=str(mi.variant()),
        integrator=shader.name,
        width=source.width,
        height=source.height,
        focus=focus,
        whole=not shader.layers,
        film=film,
        kernel=shader.kernel,
        parts=shader.facts,
        region=region,
        seen=region.grown(reach, source.width, source.height),
        lattice=lattice,
        on_film=on_film,
        detector=detector,
        blur=blur,
        repeats=repeats,
        motion=motion,
        motion_samples=moments,
        frames=moments if motion == "frames" and (detector or blur) else 1,
        layers=asked | {name for name in possible if made & set(TABLE[name].free_with)},
        passes=passes,
        left_out=_left_out(traced, made, film, shader, settings),
    )
    return plan, settings


def _film(source: Source, shader: Shader) -> FilmFacts | None:
    """Return what the film and the sampler of someone's own scene demand."""
    if not source.own:
        return None
    sampler, film = source.sensor.sampler(), source.sensor.film()
    kinds = sampler.class_name(), film.rfilter().class_name()
    bands = spectral_bands(film)
    return FilmFacts(int(sampler.sample_count()), *kinds, pixel_format(film), bands, shader.aovs)


def _traced(
    asked: frozenset[str], focus: Focus, detector: str | None, shader: Shader, settings: RenderSettings
) -> frozenset[str]:
    """Return the layers that must be traced: for the picture, the passes over it, and those asked for."""
    traced = {"image", *asked, *(DETECTORS[detector] if detector else ())}
    if focus.distance:
        traced.add("depth")
    if detector and (settings.spp or 1) > 1 and "image" in DETECTORS[detector]:
        traced.add("square")
    if settings.count_rays:
        traced |= {name for name, layer in TABLE.items() if layer.counts} & shader.layers
    return frozenset(traced)


def _decided(
    settings: RenderSettings, film: FilmFacts | None, shader: Shader, focus: Focus
) -> RenderSettings:
    """Return the settings in force: someone's own scene is rendered as Mitsuba renders it, the report's
    scenes as the report does."""
    whole, aamode = not shader.layers, settings.aamode
    _check(settings, shader, focus)
    # Mitsuba's integrators draw random numbers for every ray, and their noise would pass for edges
    plain = (film is not None or whole) and shader.random and settings.aa is None
    if aamode is None:
        aamode = NOISE if settings.rmse is not None else "none" if plain or whole else "sobel"
    lattice = settings.lattice or (FILM if film or whole or aamode == NOISE else "report")
    aa = settings.aa or (1 if aamode == NOISE or (plain and aamode == "none") else 4)
    spp = settings.spp or (film.rays if film and plain and settings.aamode is None else 1)
    most = settings.maxspp or (MAX_SPP if settings.rmse is not None else None)
    if aamode == NOISE and settings.rmse is None and spp < MIN_SPP:
        raise UsageError(
            f"aamode=noise: give the mean of a pixel's rays as spp, {MIN_SPP} or more, or a target"
        )
    return settings.but(aa=aa, aamode=aamode, lattice=lattice, spp=spp, maxspp=most)


def _check(settings: RenderSettings, shader: Shader, focus: Focus) -> None:
    """Raise ``UsageError`` for options that do not go together: a row for each, and what to do instead."""
    to_error, on_film = settings.rmse is not None, settings.lattice in (None, FILM)
    rounds, whole = to_error or settings.aamode == NOISE, not shader.layers
    name = f"target={settings.rmse:g}" if to_error else "aamode=noise"
    only = "is of use only where rays go in rounds: with target or aamode=noise"
    alone = f"the integrator {shader.name} gives whole pictures, and no single rays"
    other = f"{alone}; leave it out, or choose another, such as path"
    aamode, lattice = f"aamode={settings.aamode}", f"lattice={settings.lattice}"
    rows = [
        *((not rounds and getattr(settings, given) is not None, f"{given} {only}")
          for given in ("maxspp", "maxseconds", "on_round")),
        (to_error and settings.aamode not in (None, NOISE), f"{name} with {aamode}: leave one of them out"),
        (to_error and settings.spp is not None,
         f"{name} with spp={settings.spp}: leave one of them out, or bound it by maxspp"),
        (rounds and settings.aa is not None,
         f"{name} with aa={settings.aa}: rounds decide it; leave one of them out"),
        (rounds and not on_film, f"{name} with {lattice}: rounds follow the film; leave lattice out"),
        (rounds and settings.region is not None,
         f"{name} with region: rounds share the rays out over the whole picture"),
        (whole and settings.aamode not in (None, "none", NOISE), f"{aamode}: {other}"),
        (whole and not on_film, f"{lattice}: {other}"),
        (whole and settings.motion is not None, f"motion: {other}"),
        (whole and focus.distance is not None,
         f"focaldist={focus.distance}: {alone}; write focaldist=0, or choose another, such as path"),
    ]  # fmt: skip
    wrong = next((text for holds, text in rows if holds), None)
    if wrong is not None:
        raise UsageError(wrong)


def _layers(settings: RenderSettings, shader: Shader) -> tuple[frozenset[str], frozenset[str]]:
    """Return the layers that are asked for, and those that can be made."""
    made, asked = shader.layers | layers.named(DERIVED), frozenset(settings.layers)
    possible = made - ({"error", "variance"} if settings.aamode != NOISE else set())
    possible -= {"edges"} if settings.aamode not in DETECTORS else set()
    if asked == LAYERS.keys():
        return asked & possible, possible
    wrong = sorted(asked - possible)
    if "edges" in wrong:
        text = f"aamode={settings.aamode} looks for none; choose one of {', '.join(DETECTORS)}"
        raise UsageError(f"layers=edges: {text}")
    if not made.isdisjoint(wrong):
        raise UsageError("layers=error,variance: only rounds estimate them; give a target= or aamode=noise")
    if wrong:
        text = f"{shader.name} does not provide these layers; use mrt_whitted"
        raise UsageError(f"layers={','.join(wrong)}: {text}")
    return asked, possible


def _passes(
    traced: frozenset[str],
    lattice: Lattice,
    detector: str | None,
    repeats: int,
    shader: Shader,
    settings: RenderSettings,
) -> tuple[Pass, ...]:
    """Return the passes that trace rays, and the look for edges between them."""
    passes, film, at_centre = [], lattice.kind == FILM, traced & layers.named(FIRST_HIT)
    if at_centre and (film or (detector is None and not lattice.holds_centre)):
        # layers of the first hit belong to the pixel's centre
        passes.append(Pass(FIRST_HITS, at_centre, 1))
        traced -= at_centre
    if settings.aamode == NOISE:
        seconds = "" if settings.maxseconds is None else f" or {settings.maxseconds:g} s"
        goal = f"{settings.spp} a pixel on average, where the variance is"
        if settings.rmse is not None:
            goal = f"to an error of {settings.rmse:g}, at most {settings.maxspp} a pixel{seconds}"
        return *passes, Pass(ROUNDS, traced, mode=goal, film=film)
    if detector is None:
        return *passes, Pass(RENDERING, traced, lattice.count, repeats=repeats, film=film)
    noisy = shader.random and repeats == 1 and "image" in DETECTORS[detector]
    passes.append(Pass(RENDERING, traced, 1, repeats=repeats, film=film))
    passes.append(Pass(EDGES, mode=detector, noisy=noisy))
    if lattice.count > 1:
        first = 1 if film or lattice.holds_centre else 0  # the centre is not traced again
        averaged = traced - at_centre - {"square"}
        passes.append(Pass(REFINEMENT, averaged, lattice.count - first, first, repeats, film=film))
    return tuple(passes)


def _left_out(
    traced: Any, made: set[str], film: FilmFacts | None, shader: Shader, settings: RenderSettings
) -> tuple[Omission, ...]:
    """Return what kernels and passes leave out, and what a film or a sampler asks for in vain; with why."""
    aamodes = {
        "none": "aamode=none gives every pixel all its samples",
        NOISE: "rounds go where the variance is",
    }
    one = "aa=1 has no further samples to add"
    skipped = [name for name in LAYERS if name in shader.layers - traced - {"depth"}]
    kernel = shader.kernel.reasons if shader.kernel else ()
    rows = [(True, kernel_plan.WHAT.get(name, name), why) for name, why in kernel]
    rows += [
        (EDGES not in made, "edge pass", aamodes.get(str(settings.aamode), one)),
        (BLUR not in made, BLUR, "no focal distance"),
        ("depth" not in traced, "depth", "nothing needs it"),
        *((True, name, "not asked for") for name in skipped),
    ]
    if film is not None and settings.lattice != FILM:
        lattice = "the lattice that was asked for places and averages samples"
        rows.append((True, f"{film.rfilter} and {film.sampler}", lattice))
    elif film is not None:
        scalar = shader.scene.variant_name().startswith("scalar")
        linear = "pictures are linear sRGB, whose luminance or XYZ follow"
        spectrum = "the picture is the colour of the spectrum that the film sees, and rounds go by it"
        alone = "a scalar variant draws independent numbers, ray by ray"
        rounds = "rounds continue one sequence of numbers in each pixel"
        rows += [
            (film.pixel_format.startswith("xyz"), f"pixel format {film.pixel_format}", linear),
            (bool(film.bands), f"{', '.join(film.bands)} in the picture, only as layers", spectrum),
            (scalar and film.sampler != "IndependentSampler", film.sampler, alone),
            (not scalar and settings.aamode == NOISE, film.sampler, rounds),
        ]
    return tuple(Omission(what, why) for holds, what, why in rows if holds)
