"""The render plan: all that a render will do, and what it leaves out, decided before anything is traced."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, ClassVar

import mitsuba as mi

from mrt_mitsuba.adaptive.metric import LINEAR, METRICS
from mrt_mitsuba.adaptive.target import Goal
from mrt_mitsuba.errors import UsageError, needs_extra
from mrt_mitsuba.files.layers import DERIVED, FIRST_HIT, LAYERS, TABLE
from mrt_mitsuba.filters import dof, edges
from mrt_mitsuba.plugins.whitted import plan as kernel_plan
from mrt_mitsuba.plugins.whitted.plan import KernelPlan, SceneFacts
from mrt_mitsuba.rendering.film import Film, Region, SamplePattern
from mrt_mitsuba.rendering.settings import (
    AA,
    AAMODE,
    DETECTORS,
    FILM,
    NOISE,
    RenderSettings,
)
from mrt_mitsuba.rendering.settings import TABLE as OPTIONS
from mrt_mitsuba.rendering.shading import Shader
from mrt_mitsuba.scene.open import Source

# Float32 channels of a pixel that its statistics take: of a film, for each band and channel of the
# integrator's own, and while rounds are shared out
FILM_CHANNELS = 28
OWN_CHANNELS = 5
ROUND_CHANNELS = 240

# The options that a result names: those that shape a picture
_NAMED = (*(name for name in OPTIONS if name != "memory"), "params", "region", "integrator")


# ---------------------------------- Passes over the picture -----------------------------------


@dataclass(frozen=True, kw_only=True)
class Pass:
    """A pass over the picture. ``str()`` describes it."""

    name: ClassVar[str]
    layers: frozenset[str] = frozenset()  #: that it traces
    pattern: SamplePattern = SamplePattern()  # noqa: RUF009 - it is frozen  #: where and when its rays start

    @property
    def repeated(self) -> str:
        """The number of rays of each sample, in words; empty for one."""
        return f", {self.pattern.repeats} rays each" if self.pattern.repeats > 1 else ""


class FirstHits(Pass):
    """One ray through the centre of each pixel, for the layers that describe a point."""

    name = "first hits"

    def __str__(self) -> str:
        return f"first hits: 1 ray through the centre of a pixel{_with(self.layers)}"


class Exposure(Pass):
    """The same rays in every pixel."""

    name = "rendering"

    def __str__(self) -> str:
        if self.pattern.lattice == FILM:
            return f"{_counted(self.pattern.size, 'ray')} a pixel, placed and filtered by the film"
        return f"{_counted(self.pattern.count, 'sample')} a pixel{self.repeated}{_with(self.layers)}"


@dataclass(frozen=True, kw_only=True)
class Edges(Pass):
    """The search for edges in the picture."""

    name = "edges"
    detector: str  #: a key of ``DETECTORS``
    noisy: bool  #: whether it takes noise for edges

    def __str__(self) -> str:
        noise = ", noise will count as edges: variance needs spp >= 2" if self.noisy else ""
        return f"edges: {self.detector}{noise}"


class Refinement(Pass):
    """Further rays in the pixels at edges."""

    name = "anti-aliasing"

    def __str__(self) -> str:
        if self.pattern.lattice == FILM:
            rays = _counted(self.pattern.size, "ray")
            return f"{rays} and more in edge pixels, placed and filtered by the film"
        return f"{self.pattern.count} further samples in edge pixels{self.repeated}"


@dataclass(frozen=True, kw_only=True)
class Rounds(Pass):
    """Rounds of rays to the pixels that need them, until a goal is reached."""

    name = "rounds"
    goal: Goal
    rmse: float | None = None  #: that the target has come to; None until a round has been traced

    def __str__(self) -> str:
        goal = self.goal
        metric = METRICS[goal.metric]
        kind = "an error" if metric is LINEAR else f"a {metric.name} error"
        if goal.target is None:
            where = "the variance" if metric is LINEAR else f"the {metric.name} error"
            denoised = ", denoised" if goal.denoise else ""
            return f"adaptive sampling: {goal.max_spp} spp on average, allocated by {where}{denoised}"
        error = str(goal.target)
        if goal.target.relative and metric.reference is None:
            error += " of the mean luminance" + ("" if self.rmse is None else f", {self.rmse:.3g}")
        seconds = "" if goal.max_seconds is None else f" or {goal.max_seconds:g} s"
        denoised = ", denoised where that pays" if goal.denoise else ""
        return f"adaptive sampling to {kind} of {error}, at most {goal.max_spp} spp{seconds}{denoised}"


@dataclass(frozen=True, kw_only=True)
class Blur(Pass):
    """Depth of field, from the depth of each pixel."""

    name = "depth of field"
    mode: str  #: "report" or "corrected"
    focal_distance: float  #: that is sharp, from the camera in units of the scene
    focal_range: float  #: half-width of the sharp zone around it

    def __str__(self) -> str:
        return f"depth of field: {self.mode}"


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'s' if number > 1 else ''}"


def _with(layers: frozenset[str]) -> str:
    shown = [name for name in LAYERS if name in layers]
    return f", with {', '.join(shown)}" if shown else ""


# ----------------------------------------- The plan -------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The facts known before a render, and every decision made from them. ``str()`` describes it."""

    scene: str  #: its number or name
    variant: str  #: of Mitsuba
    integrator: str  #: name of its plugin
    whole: bool  #: does it give whole pictures only, rather than follow rays from the camera
    width: int  #: pixels
    height: int  #: pixels
    film: str  #: filter and pixel format, where a film is exposed by its own rules rather than a lattice
    bands: tuple[str, ...]  #: spectral ones of the film
    kernel: KernelPlan | None  #: what the tracing kernels hold; None where the integrator does not say
    facts: SceneFacts | None  #: what the kernels depend on
    region: Region  #: that is returned
    padded_region: Region  #: with the pixels around it that filters look at
    samples: int  #: of a pixel, where they are refined or everywhere
    channels: int  #: float32 ones kept for every pixel: the picture, its layers, and the detector's
    motion: str | None  #: "frames", "stratified", "film", or None where the camera stands still
    time_strata: int  #: while the shutter is open; 0 where the camera stands still
    frames: int  #: pictures to average, each with filters of its own
    seed: int  #: of all random numbers
    layers: frozenset[str]  #: that are returned
    passes: tuple[Pass, ...]  #: over the picture, in their order
    options: Mapping[str, Any]  #: the values in force, as JSON can hold them
    left_out: tuple[tuple[str, str], ...]  #: passes, layers and parts of the kernels, and why

    @property
    def blur(self) -> Blur | None:
        """The pass that gives the picture depth of field, if any."""
        return next((step for step in self.passes if isinstance(step, Blur)), None)

    def resolved(self, rmse: float | None, left_out: tuple[str, str] | None = None) -> Plan:
        """The plan with the RMSE that its target has come to, and what the rounds have left out."""
        steps = (replace(step, rmse=rmse) if isinstance(step, Rounds) else step for step in self.passes)
        further = () if left_out is None else (left_out,)
        return replace(self, passes=tuple(steps), left_out=(*self.left_out, *further))

    def __str__(self) -> str:
        lines = [f"Plan for {self.scene}, {self.width}x{self.height}, {self.integrator} in {self.variant}"]
        part = self.region
        if (part.width, part.height) != (self.width, self.height):
            lines += [f"  region  {part.width}x{part.height} from column {part.x}, row {part.y}"]
        if self.motion:
            moments = f"{self.time_strata} frames"
            if self.motion == FILM:
                moments = "each ray at its own moment"
            elif self.motion == "stratified":
                moments = f"at least {self.time_strata} moments in a pixel"
            lines += [f"  pass    motion blur: {moments}"]
        lines += [f"  pass    {step}" for step in self.passes]
        if self.film:
            lines += [f"  film    {self.film}"]
        if self.kernel is None or self.facts is None:
            lines += [f"  kernel  {self.integrator}.sample"]
        else:
            lines += [f"  kernel  {text}" for text in kernel_plan.contents(self.kernel, self.facts)]
        for why, group in groupby(self.left_out, lambda left_out: left_out[1]):
            lines += [f"  without {', '.join(what for what, _ in group)}: {why}"]
        return "\n".join(lines)


@dataclass(frozen=True)
class _Choices:
    """Decisions that the options leave open, made for one scene; by the names of options where they are such.

    Someone's own scene is rendered as Mitsuba renders it, the report's scenes as the report does.
    """

    settings: RenderSettings
    aa: int
    aamode: str
    lattice: str
    spp: int
    focaldist: float  #: 0 for no depth of field
    focalrange: float
    goal: Goal | None  #: of rounds; None without them
    detector: str | None  #: the edge detector that runs, a key of ``DETECTORS``
    moving: str | None  #: ``motion`` of the ``Plan``
    moments: int  #: at which a moving camera sees the scene, else 0
    frames: int


def _decide(settings: RenderSettings, source: Source, shader: Shader) -> _Choices:
    whole = shader.whole
    goal = settings.goal(source.goal)
    aamode = NOISE if goal else settings.aamode
    # Mitsuba's integrators draw random numbers for every ray, and their noise would pass for edges
    plain = (source.own or whole) and shader.random and settings.aa is None
    if aamode is None:
        aamode = "none" if plain or whole else AAMODE
    one = aamode == NOISE or (plain and aamode == "none")
    aa = settings.aa or (1 if one else AA)
    spp = settings.spp or 1
    if goal and goal.target is None:
        spp = goal.max_spp
    elif settings.spp is None and source.own and plain and settings.aamode is None:
        spp = shader.film.rays
    lattice = settings.lattice or (FILM if source.own or whole or goal else "report")
    refining = aamode in DETECTORS and (aa != 1 or "edges" in settings.layers)
    distance, reach = settings.focus(source.focal_distance, source.focal_range)
    moving = None
    moments = 0
    if settings.motion:
        moving = FILM if lattice == FILM else settings.motionmode
        moments = settings.motionsamples
    return _Choices(
        settings=settings,
        aa=aa,
        aamode=aamode,
        lattice=lattice,
        spp=spp,
        focaldist=distance or 0.0,
        focalrange=reach,
        goal=goal,
        detector=aamode if refining else None,
        moving=moving,
        moments=moments,
        frames=moments if moving == "frames" and (refining or distance) else 1,
    )


def make_plan(source: Source, shader: Shader, settings: RenderSettings) -> Plan:
    """Decide what to trace and what to leave out.

    Raises ``UsageError`` for options that do not go together, and for layers that nothing provides.
    """
    choices = _decide(settings, source, shader)
    _check(choices, source, shader)
    film = shader.film
    on_film = choices.lattice == FILM
    asked, possible = _layers(choices, shader)
    traced = _traced(asked & shader.layers, choices, shader)
    passes = tuple(_passes(traced, choices, shader))
    names = {step.name for step in passes}
    returned = asked | {name for name in possible if names & set(TABLE[name].free_with)}
    returned |= possible & {"noisy", "denoised"}
    region = Region(*(settings.region or (0, 0, source.width, source.height)))
    reach = edges.REACH * bool(choices.detector) + dof.REACH * bool(choices.focaldist)
    channels = sum(len(TABLE[name].letters) for name in traced | returned)
    if on_film:  # sums by pixel, in double precision, while a film is exposed
        channels += ROUND_CHANNELS if choices.goal else FILM_CHANNELS
        channels += OWN_CHANNELS * len(film.bands + shader.aovs)
    return Plan(
        scene=source.name,
        variant=str(mi.variant()),
        integrator=shader.name,
        whole=shader.whole,
        width=source.width,
        height=source.height,
        film=f"{film.rfilter.class_name()}, {film.pixel_format or 'spectral bands'}" if on_film else "",
        bands=film.bands,
        kernel=shader.kernel,
        facts=shader.facts,
        region=region,
        padded_region=region.grown(reach, source.width, source.height),
        samples=choices.aa**2,
        channels=channels,
        motion=choices.moving,
        time_strata=choices.moments,
        frames=choices.frames,
        seed=settings.seed,
        layers=returned,
        passes=passes,
        options=_in_force(choices, source, shader, returned),
        left_out=tuple(_left_out(traced, names, source, shader, choices)),
    )


def _in_force(choices: _Choices, source: Source, shader: Shader, returned: frozenset[str]) -> dict[str, Any]:
    """The options that shape the picture, with the values that were decided."""
    settings = choices.settings
    goal = choices.goal
    values = vars(settings) | vars(choices)
    values |= {
        "width": source.width,
        "height": source.height,
        "fresnel": source.fresnel,
        "layers": tuple(name for name in settings.layers if name in returned),
        "variant": str(mi.variant()),
        "integrator": shader.name,
    }
    if goal and goal.target:
        values |= {"target": goal.target.plain, "maxspp": goal.max_spp}
    if goal:
        values |= {"maxseconds": goal.max_seconds, "metric": goal.metric, "denoise": goal.denoise}
    return {name: values[name] for name in _NAMED if values[name] is not None}


# --------------------------------------- Its decisions ----------------------------------------


def _traced(asked: frozenset[str], choices: _Choices, shader: Shader) -> frozenset[str]:
    """The layers that rays must give: the picture, those that passes over it read, and those asked for."""
    traced = {"image", *asked}
    read = DETECTORS[choices.detector] if choices.detector else ()
    traced.update(read)
    if choices.focaldist:
        traced.add("depth")
    if choices.spp > 1 and "image" in read:
        traced.add("square")
    if choices.settings.count_rays:
        traced |= {name for name, layer in TABLE.items() if layer.counts} & shader.layers
    return frozenset(traced)


def _check(choices: _Choices, source: Source, shader: Shader) -> None:
    """Raise ``UsageError`` for options that do not go together."""
    settings = choices.settings
    goal = choices.goal
    if goal is None:
        only = "{0} is of use only where rays go in rounds: with target or aamode=noise"
        _refuse(settings, ("metric", "maxspp", "maxseconds", "on_round"), (), only)
        _refuse(settings, ("denoise",), (False,), "{0} needs two half pictures: give target or spp")
    else:
        name = f"target={goal.target}" if goal.target else "aamode=noise"
        both = (
            f"{name} with {{0}}={{1}}: rounds share rays out over the whole film, at most maxspp of them; "
            "leave one of them out"
        )
        if settings.error is not None:
            _refuse(settings, ("aamode", "spp"), (NOISE,), both)
        _refuse(settings, ("aa", "lattice", "region"), (FILM,), both)
        if goal.denoise:
            if choices.focaldist:
                raise UsageError("denoise with depth of field as a filter: write focaldist=0")
            with needs_extra("denoise"):
                importlib.import_module("pyoidn")
    if shader.whole:
        if goal is not None:
            raise UsageError(
                f"{name}: the integrator {shader.name} gives whole pictures, not single rays; "
                "write spp, or choose another, such as path"
            )
        alone = f"the integrator {shader.name} gives whole pictures, and no single rays"
        leave = f"{{0}}={{1}}: {alone}; leave it out, or choose another, such as path"
        _refuse(settings, ("aamode", "lattice", "motion"), ("none", FILM), leave)
        if choices.focaldist:
            raise UsageError(
                f"focaldist={choices.focaldist}: {alone}; write focaldist=0, or choose another, such as path"
            )
    x, y, width, height = settings.region or (0, 0, 1, 1)
    if x + width > source.width or y + height > source.height:
        size = f"{source.width}x{source.height} pixels"
        raise UsageError(f"region={settings.region}: it exceeds the picture, {size}")


def _refuse(settings: RenderSettings, options: Sequence[str], allowed: Sequence[str], text: str) -> None:
    """Raise ``UsageError`` for the first of some options with a value that is not allowed.

    ``text``: the message, with places for its name and its value.
    """
    for option in options:
        value = getattr(settings, option)
        if value not in (None, *allowed):
            raise UsageError(text.format(option, value))


def _layers(choices: _Choices, shader: Shader) -> tuple[frozenset[str], frozenset[str]]:
    """The layers that are asked for, and those that can be made."""
    derived = {name for name in TABLE if TABLE[name].source == DERIVED}
    asked = frozenset(choices.settings.layers)
    known = shader.layers | derived
    possible = set(known)
    if choices.goal is None:
        possible -= {"error", "variance"}
    if choices.goal is None or not choices.goal.denoise:
        possible -= {"noisy", "denoised"}
    if choices.aamode not in DETECTORS:
        possible -= {"edges"}
    if asked == LAYERS.keys():
        return asked & possible, frozenset(possible)
    missing = sorted(asked - possible)
    if "edges" in missing:
        detectors = ", ".join(DETECTORS)
        raise UsageError(f"layers=edges: aamode={choices.aamode} looks for none; choose one of {detectors}")
    if not known.isdisjoint(missing):
        raise UsageError("layers=error,variance: only rounds estimate them; give a target= or aamode=noise")
    if missing:
        text = f"{shader.name} does not provide these layers; use mrt_whitted"
        raise UsageError(f"layers={','.join(missing)}: {text}")
    return asked, frozenset(possible)


def _passes(traced: frozenset[str], choices: _Choices, shader: Shader) -> Iterator[Pass]:
    """The passes over the picture, in their order."""
    on_film = choices.lattice == FILM
    all_samples = _samples(choices)
    at_centre = frozenset(name for name in traced if TABLE[name].source == FIRST_HIT)
    if at_centre and (on_film or (choices.detector is None and not all_samples.holds_centre)):
        # layers of the first hit belong to the pixel's centre
        yield FirstHits(layers=at_centre, pattern=SamplePattern(time_strata=min(choices.moments, 1)))
        traced -= at_centre
    if choices.goal:
        yield Rounds(layers=traced, pattern=SamplePattern(FILM), goal=choices.goal)
    elif choices.detector is None:
        yield Exposure(layers=traced, pattern=all_samples)
    else:
        # a detector must see no noise: it looks at the centre of each pixel
        places = replace(all_samples, count=1) if on_film else _centre(choices)
        noisy = shader.random and places.repeats == 1 and "image" in DETECTORS[choices.detector]
        yield Exposure(layers=traced, pattern=places)
        yield Edges(detector=choices.detector, noisy=noisy)
        if choices.aa > 1:
            first = 1 if on_film or all_samples.holds_centre else 0  # the centre is not traced again
            places = _samples(choices, first)
            yield Refinement(layers=traced - at_centre - {"square"}, pattern=places)
    if choices.focaldist:
        mode = choices.settings.dof
        yield Blur(mode=mode, focal_distance=choices.focaldist, focal_range=choices.focalrange)


def _samples(choices: _Choices, first: int = 0) -> SamplePattern:
    """The samples of a pixel from number ``first`` on."""
    repeats = choices.spp
    moments = choices.moments
    count = choices.aa**2 - first
    stratified = choices.settings.motionmode == "stratified"
    if choices.lattice == FILM:  # each ray has a moment of its own
        wanted = math.ceil(moments / choices.aa**2) if stratified else repeats * moments
        return SamplePattern(FILM, choices.aa, first=first, count=count, repeats=max(repeats, wanted))
    if moments and stratified:  # every ray of a pixel in a part of its own
        rays = repeats * math.ceil(moments / (count * repeats))
        return SamplePattern(
            choices.lattice, choices.aa, first, count, repeats=rays, time_strata=count * rays, phase=None
        )
    return replace(_centre(choices), lattice=choices.lattice, aa=choices.aa, first=first, count=count)


def _centre(choices: _Choices) -> SamplePattern:
    """The pixel's centre alone, at the same times in every pixel."""
    moments = choices.moments if choices.frames == 1 else 1
    phase = 0.5 if choices.settings.motionmode == "stratified" else 0.0
    return SamplePattern(repeats=choices.spp * max(moments, 1), time_strata=moments, phase=phase)


def _left_out(
    traced: frozenset[str], passes: set[str], source: Source, shader: Shader, choices: _Choices
) -> Iterator[tuple[str, str]]:
    """The parts that kernels and passes leave out, each with its reason."""
    for name, why in shader.kernel.reasons if shader.kernel else ():
        yield kernel_plan.WHAT.get(name, name), why
    if Edges.name not in passes:
        why = "aa=1 has no further samples to add"
        if choices.goal:
            why = "rounds go where the variance is"
        elif choices.aamode == "none":
            why = "aamode=none gives every pixel all its samples"
        yield "edge pass", why
    if Blur.name not in passes:
        yield Blur.name, "no focal distance"
    if "depth" not in traced:
        yield "depth", "nothing needs it"
    for name in LAYERS:
        if name in shader.layers - traced - {"depth"}:
            yield name, "not asked for"
    yield from _ignored(source, shader.film, choices)


def _ignored(source: Source, film: Film, choices: _Choices) -> Iterator[tuple[str, str]]:
    """The wishes of the film and its sampler that are not followed, each with its reason."""
    if choices.lattice != FILM:
        if source.own:
            yield (
                f"{film.rfilter.class_name()} and {film.sampler}",
                "the lattice that was asked for places and averages samples",
            )
        return
    if film.pixel_format.startswith("xyz"):
        yield f"pixel format {film.pixel_format}", ("pictures are linear sRGB, whose luminance or XYZ follow")
    if film.bands:
        yield (
            f"{', '.join(film.bands)} in the picture, only as layers",
            ("the picture is the colour of the spectrum that the film sees, and rounds go by it"),
        )
    if mi.variant().startswith("scalar"):
        if film.sampler != "IndependentSampler":
            yield film.sampler, "a scalar variant draws independent numbers, ray by ray"
    elif choices.goal:
        yield film.sampler, "rounds continue one sequence of numbers in each pixel"
