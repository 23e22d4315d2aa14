"""The render plan: what a render will do and what it leaves out, decided before anything is traced."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import groupby

import mitsuba as mi

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.output.layers import DERIVED, FIRST_HIT, LAYERS, TABLE
from mrt_mitsuba.plugins import kernel_plan
from mrt_mitsuba.plugins.kernel_plan import KernelPlan, SceneFacts
from mrt_mitsuba.rays.film import Places, Region
from mrt_mitsuba.rendering.settings import (
    AA,
    AAMODE,
    DETECTORS,
    FILM,
    MAX_SPP,
    MIN_SPP,
    NOISE,
    RenderSettings,
)
from mrt_mitsuba.rendering.shading import Shader
from mrt_mitsuba.scene.open import Source

# Float32 channels of a pixel that its statistics take: of a film, for each band and channel of the
# integrator's own, and while rounds are shared out
FILM_CHANNELS, OWN_CHANNELS, ROUND_CHANNELS = 28, 5, 240

# Passes over the picture, in the order in which they may occur
FIRST_HITS, RENDERING, EDGES = "first hits", "rendering", "edges"
REFINEMENT, BLUR, ROUNDS = "anti-aliasing", "depth of field", "rounds"


@dataclass(frozen=True)
class Pass:
    """A pass over the picture. ``str()`` shows it."""

    name: str  #: ``FIRST_HITS``, ``RENDERING``, ``EDGES``, ``REFINEMENT``, ``BLUR`` or ``ROUNDS``
    layers: frozenset[str] = frozenset()  #: that it traces
    places: Places = Places()  # noqa: RUF009 - it is frozen  #: where and when its rays start
    mode: str = ""  #: of a filter, or what rounds go to
    noisy: bool = False  #: does a filter take noise for edges

    def __str__(self) -> str:
        count, repeats = self.places.count, self.places.repeats
        if self.places.lattice == FILM and self.name != ROUNDS:
            where = "a pixel" if self.name == RENDERING else "and more in edge pixels"
            return f"{count * repeats} rays {where}, placed and filtered by the film"
        times = f", {repeats} rays each" if repeats > 1 else ""
        shown = [name for name in LAYERS if name in self.layers]
        layers = f", with {', '.join(shown)}" if shown else ""
        noise = ", noise will count as edges: variance needs spp >= 2" if self.noisy else ""
        return {
            FIRST_HITS: f"first hits: 1 ray through the centre of a pixel{layers}",
            RENDERING: f"{count} sample{'s' if count > 1 else ''} a pixel{times}{layers}",
            EDGES: f"edges: {self.mode}{noise}",
            REFINEMENT: f"{count} further samples in edge pixels{times}",
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
    focus: tuple[float | None, float]  #: distance that is sharp, None for no depth of field; and half a range
    film: str  #: filter and pixel format, where a film is exposed by its own rules rather than a lattice
    bands: tuple[str, ...]  #: spectral ones of the film
    kernel: KernelPlan | None  #: what the tracing kernels hold; None where the integrator does not say
    parts: SceneFacts | None  #: what the kernels depend on
    region: Region  #: that is returned
    seen: Region  #: with the pixels around it that filters look at
    samples: int  #: of a pixel, where they are refined or everywhere
    channels: int  #: float32 ones kept for every pixel: the picture, its layers, and the detector's
    blur: str | None  #: depth-of-field mode
    motion: str | None  #: "frames", "stratified", "film", or None where the camera stands still
    moments: int  #: while the shutter is open
    frames: int  #: pictures to average, each with filters of its own
    layers: frozenset[str]  #: that are returned
    passes: tuple[Pass, ...]  #: over the picture, in their order
    left_out: tuple[tuple[str, str], ...]  #: passes, layers and parts of the kernels, and why

    def __str__(self) -> str:
        lines = [f"Plan for {self.scene}, {self.width}x{self.height}, {self.integrator} in {self.variant}"]
        part = self.region
        if (part.width, part.height) != (self.width, self.height):
            lines += [f"  region  {part.width}x{part.height} from column {part.x}, row {part.y}"]
        moments = {"stratified": "at least {} moments in a pixel", "film": "each ray at its own moment"}
        if self.motion:
            lines += [f"  pass    motion blur: {moments.get(self.motion, '{} frames').format(self.moments)}"]
        lines += [f"  pass    {step}" for step in self.passes]
        if self.film:
            lines += [f"  film    {self.film}"]
        if self.kernel is None or self.parts is None:
            lines += [f"  kernel  {self.integrator}.sample"]
        else:
            lines += [f"  kernel  {text}" for text in kernel_plan.held(self.kernel, self.parts)]
        for why, group in groupby(self.left_out, lambda left_out: left_out[1]):
            lines += [f"  without {', '.join(what for what, _ in group)}: {why}"]
        return "\n".join(lines)


def make_plan(source: Source, shader: Shader, settings: RenderSettings) -> tuple[Plan, RenderSettings]:
    """Decide what to trace and what to leave out; return the settings in force as well.

    Raises ``UsageError`` for options that do not go together, and for layers that nothing provides.
    """
    settings = _decided(settings, source, shader)
    on_film, film = settings.lattice == FILM, shader.film
    asked, possible = _layers(settings, shader)
    refining = settings.aamode in DETECTORS and (settings.aa != 1 or "edges" in asked)
    detector = settings.aamode if refining else None
    blur = settings.dof if settings.focaldist else None
    motion = (FILM if on_film else settings.motionmode) if settings.motion else None
    moments = settings.motionsamples if motion else 1
    frames = moments if motion == "frames" and (detector or blur) else 1
    traced = _traced(asked & shader.layers, blur, detector, shader, settings)
    passes = _passes(traced, detector, shader, settings, frames)
    passes += [Pass(BLUR, mode=str(blur))] * bool(blur)
    made = {step.name for step in passes}
    returned = asked | {name for name in possible if made & set(TABLE[name].free_with)}
    region = Region(*(settings.region or (0, 0, source.width, source.height)))
    channels = sum(len(TABLE[name].letters) for name in traced | returned)
    # sums by pixel, in double precision, while a film is exposed
    sums = ROUND_CHANNELS if ROUNDS in made else FILM_CHANNELS
    channels += on_film * (sums + OWN_CHANNELS * len(film.bands + shader.aovs))
    plan = Plan(
        scene=source.name,
        variant=str(mi.variant()),
        integrator=shader.name,
        width=source.width,
        height=source.height,
        focus=settings.focus(None, 0.0),
        film=f"{film.rfilter}, {film.pixel_format or 'spectral bands'}" if on_film else "",
        bands=film.bands,
        kernel=shader.kernel,
        parts=shader.facts,
        region=region,
        seen=region.grown(edges.REACH * bool(detector) + dof.REACH * bool(blur), source.width, source.height),
        samples=int(settings.aa or 1) ** 2,
        channels=channels,
        blur=blur,
        motion=motion,
        moments=moments,
        frames=frames,
        layers=returned,
        passes=tuple(passes),
        left_out=_left_out(traced, made, source.own, shader, settings),
    )
    return plan, settings.but(layers=tuple(name for name in settings.layers if name in returned))


def _traced(
    asked: frozenset[str], blur: str | None, detector: str | None, shader: Shader, settings: RenderSettings
) -> frozenset[str]:
    """Return the layers that must be traced: for the picture, the passes over it, and those asked for."""
    read = DETECTORS[detector] if detector else ()
    traced = {"image", *asked, *read, *(["depth"] if blur else [])}
    if (settings.spp or 1) > 1 and "image" in read:
        traced.add("square")
    if settings.count_rays:
        traced |= {name for name, layer in TABLE.items() if layer.counts} & shader.layers
    return frozenset(traced)


def _decided(settings: RenderSettings, source: Source, shader: Shader) -> RenderSettings:
    """Return the settings in force: someone's own scene is rendered as Mitsuba renders it, the report's
    scenes as the report does."""
    own, whole, aamode = source.own, not shader.layers, settings.aamode
    distance, reach = settings.focus(source.focal_distance, source.focal_range)
    _check(settings, shader, distance)
    x, y, width, height = settings.region or (0, 0, 1, 1)
    if x + width > source.width or y + height > source.height:
        size = f"{source.width}x{source.height} pixels"
        raise UsageError(f"region={settings.region}: it exceeds the picture, {size}")
    # Mitsuba's integrators draw random numbers for every ray, and their noise would pass for edges
    plain = (own or whole) and shader.random and settings.aa is None
    if aamode is None:
        aamode = NOISE if settings.rmse is not None else "none" if plain or whole else AAMODE
    lattice = settings.lattice or (FILM if own or whole or aamode == NOISE else "report")
    aa = settings.aa or (1 if aamode == NOISE or (plain and aamode == "none") else AA)
    spp = settings.spp or (shader.film.rays if own and plain and settings.aamode is None else 1)
    most = settings.maxspp or (MAX_SPP if settings.rmse is not None else None)
    if aamode == NOISE and settings.rmse is None and spp < MIN_SPP:
        raise UsageError(
            f"aamode=noise: give the mean of a pixel's rays as spp, {MIN_SPP} or more, or a target"
        )
    return settings.but(
        aa=aa,
        aamode=aamode,
        lattice=lattice,
        spp=spp,
        maxspp=most,
        width=source.width,
        height=source.height,
        fresnel=source.fresnel,
        focaldist=distance or 0.0,
        focalrange=reach,
        variant=str(mi.variant()),
        integrator=shader.name,
    )


def _check(settings: RenderSettings, shader: Shader, focaldist: float | None) -> None:
    """Raise ``UsageError`` for options that do not go together: a row for each rule, with the values that it
    allows."""
    to_error, whole = settings.rmse is not None, not shader.layers
    rounds = to_error or settings.aamode == NOISE
    name = f"target={settings.rmse:g}" if to_error else "aamode=noise"
    only = "{0} is of use only where rays go in rounds: with target or aamode=noise"
    share = "rounds share rays out over the whole film, at most maxspp of them"
    both = f"{name} with {{0}}={{1}}: {share}; leave one of them out"
    alone = f"the integrator {shader.name} gives whole pictures, and no single rays"
    other = f"{{0}}={{1}}: {alone}; leave it out, or choose another, such as path"
    rules: tuple[tuple[bool, tuple[str, ...], tuple[str, ...], str], ...] = (
        (not rounds, ("maxspp", "maxseconds", "on_round"), (), only),
        (to_error, ("aamode", "spp"), (NOISE,), both),
        (rounds, ("aa", "lattice", "region"), (FILM,), both),
        (whole, ("aamode", "lattice", "motion"), ("none", NOISE, FILM), other),
    )
    for holds, options, allowed, text in rules:
        for option in options if holds else ():
            value = getattr(settings, option)
            if value not in (None, *allowed):
                raise UsageError(text.format(option, value))
    if whole and focaldist is not None:
        other = "write focaldist=0, or choose another, such as path"
        raise UsageError(f"focaldist={focaldist}: {alone}; {other}")


def _layers(settings: RenderSettings, shader: Shader) -> tuple[frozenset[str], frozenset[str]]:
    """Return the layers that are asked for, and those that can be made."""
    derived, asked = {name for name in TABLE if TABLE[name].source == DERIVED}, frozenset(settings.layers)
    made = shader.layers | derived
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
    traced: frozenset[str], detector: str | None, shader: Shader, settings: RenderSettings, frames: int
) -> list[Pass]:
    """Return the passes that trace rays, and the look for edges between them."""
    aa, repeats, film = int(settings.aa or 1), int(settings.spp or 1), settings.lattice == FILM
    moments, stratified = settings.motionsamples * bool(settings.motion), settings.motionmode == "stratified"
    whole = Places(str(settings.lattice), aa, count=aa**2, repeats=repeats)
    if film and moments:  # each ray has a moment of its own
        whole = replace(
            whole, repeats=max(repeats, -(-moments // aa**2)) if stratified else repeats * moments
        )
    # the pixel's centre alone, at the same times in every pixel
    centre = Places(repeats=repeats, moments=int(moments > 0))
    if moments and frames == 1:
        phase = 0.5 if stratified else 0.0
        centre = Places(repeats=repeats * moments, moments=moments, phase=phase)

    def samples(first: int) -> Places:
        """Return the samples from ``first`` on."""
        count = aa**2 - first
        if film:
            return replace(whole, first=first, count=count)
        if moments and stratified:  # every ray of a pixel in a part of its own
            rays = repeats * math.ceil(moments / (count * repeats))
            return replace(whole, first=first, count=count, repeats=rays, moments=count * rays, phase=None)
        return replace(centre, lattice=whole.lattice, aa=aa, first=first, count=count)

    passes = list[Pass]()
    at_centre = frozenset(filter(lambda name: TABLE[name].source == FIRST_HIT, traced))
    if at_centre and (film or (detector is None and not whole.holds_centre)):
        # layers of the first hit belong to the pixel's centre
        passes.append(Pass(FIRST_HITS, at_centre, Places(moments=int(moments > 0))))
        traced -= at_centre
    if settings.aamode == NOISE:
        seconds = "" if settings.maxseconds is None else f" or {settings.maxseconds:g} s"
        goal = f"{settings.spp} a pixel on average, where the variance is"
        if settings.rmse is not None:
            goal = f"to an error of {settings.rmse:g}, at most {settings.maxspp} a pixel{seconds}"
        return [*passes, Pass(ROUNDS, traced, Places(FILM), mode=goal)]
    if detector is None:
        return [*passes, Pass(RENDERING, traced, samples(0))]
    # a detector must see no noise: it looks at the centre of each pixel
    begin = replace(whole, count=1) if film else centre
    noisy = shader.random and begin.repeats == 1 and "image" in DETECTORS[detector]
    passes += [Pass(RENDERING, traced, begin), Pass(EDGES, mode=detector, noisy=noisy)]
    if aa > 1:
        first = 1 if film or whole.holds_centre else 0  # the centre is not traced again
        passes.append(Pass(REFINEMENT, traced - at_centre - {"square"}, samples(first)))
    return passes


def _left_out(
    traced: frozenset[str], made: set[str], own: bool, shader: Shader, settings: RenderSettings
) -> tuple[tuple[str, str], ...]:
    """Return what kernels and passes leave out, and what a film or a sampler asks for in vain; with why."""
    aamodes = {
        "none": "aamode=none gives every pixel all its samples",
        NOISE: "rounds go where the variance is",
    }
    edgeless = aamodes.get(str(settings.aamode), "aa=1 has no further samples to add")
    film, on_film = shader.film, settings.lattice == FILM
    scalar, rounds = mi.variant().startswith("scalar"), settings.aamode == NOISE
    reasons = shader.kernel.reasons if shader.kernel else ()
    rows = [
        *((True, kernel_plan.WHAT.get(name, name), why) for name, why in reasons),
        (EDGES not in made, "edge pass", edgeless),
        (BLUR not in made, BLUR, "no focal distance"),
        ("depth" not in traced, "depth", "nothing needs it"),
        *((name in shader.layers - traced - {"depth"}, name, "not asked for") for name in LAYERS),
        (own and not on_film, f"{film.rfilter} and {film.sampler}",
         "the lattice that was asked for places and averages samples"),
        (on_film and film.pixel_format.startswith("xyz"), f"pixel format {film.pixel_format}",
         "pictures are linear sRGB, whose luminance or XYZ follow"),
        (on_film and film.bands, f"{', '.join(film.bands)} in the picture, only as layers",
         "the picture is the colour of the spectrum that the film sees, and rounds go by it"),
        (on_film and scalar and film.sampler != "IndependentSampler", film.sampler,
         "a scalar variant draws independent numbers, ray by ray"),
        (on_film and not scalar and rounds, film.sampler,
         "rounds continue one sequence of numbers in each pixel"),
    ]  # fmt: skip
    return tuple((what, why) for holds, what, why in rows if holds)
