"""The render plan: all that a render will do, and what it leaves out, decided before anything is traced."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, ClassVar

import mitsuba as mi

from mrt_mitsuba.adaptive.target import Goal
from mrt_mitsuba.errors import UsageError, needs_extra, printable
from mrt_mitsuba.files.layers import DERIVED, FIRST_HIT, LAYERS, TABLE
from mrt_mitsuba.options import either
from mrt_mitsuba.plugins.variants import is_jit
from mrt_mitsuba.plugins.whitted import plan as kernel_plan
from mrt_mitsuba.plugins.whitted.plan import KernelPlan, SceneFacts
from mrt_mitsuba.rendering.film import Film, SamplePattern
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
MOST_SPP = 65536  # that the option ``spp`` can hold

# The options that a result names: those that shape a picture
_NAMED = (*(name for name in OPTIONS if name != "memory"), "params", "integrator")


# ---------------------------------- Passes over the picture -----------------------------------


@dataclass(frozen=True, kw_only=True)
class Pass:
    """A pass over the picture. ``str()`` describes it."""

    name: ClassVar[str]
    message: ClassVar[str] = ""  #: printed before it starts
    gives: ClassVar[frozenset[str]] = frozenset()  #: layers that it makes whether asked for or not
    layers: frozenset[str] = frozenset()  #: that it traces
    pattern: SamplePattern = SamplePattern()  # noqa: RUF009 - it is frozen  #: where and when its rays start

    def _counted(self, more: str = "") -> str:
        """Return the number of samples of a pixel in words, such as "15 more samples, 2 rays each"."""
        on_lattice = self.pattern.lattice != FILM
        count = self.pattern.count if on_lattice else self.pattern.size
        each = f", {self.pattern.repeats} rays each" if on_lattice and self.pattern.repeats > 1 else ""
        return f"{count}{more} sample{'s' if count > 1 else ''}{each}"

    def _placed(self) -> str:
        """Return the layers that are traced, and who places samples, in words."""
        shown = [name for name in LAYERS if name in self.layers]
        film = ", by the sampler and filter of the film" if self.pattern.lattice == FILM else ""
        return film + (f", with {', '.join(shown)}" if shown else "")


class FirstHits(Pass):
    """One ray through the centre of each pixel, for the layers that describe a point."""

    name = "first hits"

    def __str__(self) -> str:
        return f"first hits: 1 ray through each pixel's centre{self._placed()}"


class Exposure(Pass):
    """The same samples in every pixel."""

    name = "rendering"

    def __str__(self) -> str:
        return f"{self._counted()} per pixel{self._placed()}"


@dataclass(frozen=True, kw_only=True)
class Edges(Pass):
    """Edge detection."""

    name = "edges"
    gives = frozenset({"edges", "samples"})
    detector: str  #: a key of ``DETECTORS``
    noisy: bool  #: whether it takes noise for edges

    def __str__(self) -> str:
        noise = ", noise will count as edges: variance needs spp >= 2" if self.noisy else ""
        return f"edge detection: {self.detector}{noise}"


class Refinement(Pass):
    """Further samples in edge pixels."""

    name = "anti-aliasing"
    message = "Computing Anti aliasing.."  # as the original program prints it

    def __str__(self) -> str:
        return f"{self._counted(' more')} in edge pixels{self._placed()}"


@dataclass(frozen=True, kw_only=True)
class Rounds(Pass):
    """Adaptive sampling in rounds, until a goal is reached."""

    name = "rounds"
    gives = frozenset({"samples", "error", "variance", "noisy", "denoised"})
    goal: Goal

    def __str__(self) -> str:
        goal = self.goal
        error = f"the {goal.metric} error"
        denoised = ", denoised where that pays" if goal.denoise else ""
        if goal.target is None:
            return f"adaptive sampling: {goal.max_spp} spp on average, allocated by {error}{denoised}"
        seconds = "" if goal.max_seconds is None else f" or {goal.max_seconds:g} s"
        return f"adaptive sampling: {error} to {goal.target}, at most {goal.max_spp} spp{seconds}{denoised}"


@dataclass(frozen=True, kw_only=True)
class Blur(Pass):
    """Depth of field, from the depth of each pixel."""

    name = "depth of field"
    message = "Computing depth of field.."  # as the original program prints it
    gives = frozenset({"depth"})
    mode: str  #: "report" or "corrected"
    focal_distance: float  #: that is sharp, from the camera in units of the scene
    focal_range: float  #: half-width of the sharp zone around it

    def __str__(self) -> str:
        return f"depth of field: {self.mode}"


# ----------------------------------------- The plan -------------------------------------------


@dataclass(frozen=True, kw_only=True, repr=False)
class Plan:
    """Plan of a render: the facts known before it, and every decision made from them.

    Notebooks and ``print`` show it as text.
    """

    scene: str  #: its number or name
    variant: str  #: of Mitsuba
    integrator: str  #: name of its plugin
    width: int  #: pixels
    height: int  #: pixels
    film: str  #: filter and pixel format, where a film is exposed by its own rules rather than a lattice
    bands: tuple[str, ...]  #: spectral ones of the film
    kernel: KernelPlan | None  #: what the tracing kernels hold; None where the integrator does not say
    facts: SceneFacts | None  #: what the kernels depend on
    channels: int  #: float32 ones kept for every pixel: the picture, its layers, and the detector's
    time_strata: int  #: while the shutter is open; 0 where the camera stands still
    frames: int  #: pictures to average, each with filters of its own
    seed: int  #: of all random numbers
    layers: frozenset[str]  #: that are returned
    passes: tuple[Pass, ...]  #: over the picture, in their order
    options: Mapping[str, Any]  #: the values in force, as JSON can hold them
    left_out: tuple[tuple[str, str], ...]  #: passes, layers and parts of the kernels, and why

    @property
    def blur(self) -> Blur | None:
        """The pass of the depth of field, if any."""
        return next((step for step in self.passes if isinstance(step, Blur)), None)

    def parameters(self) -> str:
        """Return the parameters of the render, one per line, as the original program prints them."""
        distance = self.options["focaldist"]
        lines = {
            "Scene": printable(self.scene),
            "Width": self.width,
            "Height": self.height,
            "AA": self.options["aa"],
            "AA mode": self.options["aamode"],
            "F distance": distance or "off",
            "F range": self.options["focalrange"] if distance else "off",
        }
        return "\n".join(f"{name + ':':<12}{value}" for name, value in lines.items())

    def __repr__(self) -> str:
        lines = [f"Plan for {self.scene}, {self.width}x{self.height}, {self.integrator} in {self.variant}"]
        if self.time_strata:
            moments = "each ray at its own moment" if self.film else f"{self.time_strata} frames"
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


def make_plan(source: Source, shader: Shader, settings: RenderSettings) -> Plan:
    """Decide what to trace and what to leave out.

    Raises ``UsageError`` for options that do not go together, and for layers that nothing provides.
    """
    goal = settings.goal(source.goal)
    decided = _decided(settings, goal, source, shader)
    _check(settings, decided, goal, shader)
    film = shader.film
    on_film = decided.lattice == FILM
    asked, possible = _layers(decided, goal, shader)
    refining = decided.aa != 1 or "edges" in asked
    detector = decided.aamode if decided.aamode in DETECTORS and refining else None
    strata = decided.motionsamples if decided.motion else 0
    # a filter works on the picture of each moment, a film's rays have moments of their own
    frames = strata if strata and not on_film and (detector or decided.focaldist) else 1
    traced = _traced(asked, decided, detector, shader)
    passes = tuple(_passes(traced, decided, detector, strata if frames == 1 else 1, goal, shader))
    returned = asked.union(*(step.gives & possible for step in passes))
    channels = sum(len(TABLE[name].letters) for name in traced | returned)
    if on_film:  # sums by pixel, in double precision, while a film is exposed
        channels += ROUND_CHANNELS if goal else FILM_CHANNELS
        channels += OWN_CHANNELS * len(film.bands + shader.aovs)
    return Plan(
        scene=source.name,
        variant=str(mi.variant()),
        integrator=shader.name,
        width=source.width,
        height=source.height,
        film=f"{film.rfilter.class_name()}, {film.pixel_format or 'spectral bands'}" if on_film else "",
        bands=film.bands,
        kernel=shader.kernel,
        facts=shader.facts,
        channels=channels,
        time_strata=strata,
        frames=frames,
        seed=decided.seed,
        layers=returned,
        passes=passes,
        options=_in_force(decided, goal, source, shader, returned),
        left_out=tuple(_left_out(traced, {type(step) for step in passes}, source, shader, (decided, goal))),
    )


# --------------------------------------- Its decisions ----------------------------------------


def _decided(settings: RenderSettings, goal: Goal | None, source: Source, shader: Shader) -> RenderSettings:
    """Return the settings with values for options that were left open.

    A scene of the user's is rendered as Mitsuba renders it, the report's scenes as the report does.
    """
    whole = shader.whole
    aamode = NOISE if goal else settings.aamode
    # Mitsuba's integrators draw random numbers for every ray, and their noise would pass for edges
    plain = (source.own or whole) and shader.random and settings.aa is None
    if aamode is None:
        aamode = "none" if plain or whole else AAMODE
    one = aamode == NOISE or (plain and aamode == "none")
    spp = settings.spp or 1
    if goal and goal.target is None:
        spp = min(goal.max_spp, MOST_SPP)
    elif settings.spp is None and source.own and plain and settings.aamode is None:
        spp = shader.film.rays
    distance = source.focal_distance if settings.focaldist is None else settings.focaldist
    return replace(
        settings,
        aa=settings.aa or (1 if one else AA),
        aamode=aamode,
        lattice=settings.lattice or (FILM if source.own or whole or goal else "report"),
        spp=spp,
        focaldist=distance or 0.0,
        focalrange=source.focal_range if settings.focalrange is None else settings.focalrange,
    )


def _in_force(
    settings: RenderSettings, goal: Goal | None, source: Source, shader: Shader, returned: frozenset[str]
) -> dict[str, Any]:
    """Return the options that shape the picture, with the values that were decided."""
    values = vars(settings) | {
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


def _traced(
    asked: frozenset[str], settings: RenderSettings, detector: str | None, shader: Shader
) -> frozenset[str]:
    """Return the layers to trace: the picture, those that passes over it read, and those asked for."""
    read = DETECTORS[detector] if detector else ()
    traced = {"image", *(asked & shader.layers), *read}
    if settings.focaldist:
        traced.add("depth")
    if settings.spp != 1 and "image" in read:
        traced.add("square")
    if settings.count_rays:
        traced |= {name for name, layer in TABLE.items() if layer.counts} & shader.layers
    return frozenset(traced)


def _check(given: RenderSettings, decided: RenderSettings, goal: Goal | None, shader: Shader) -> None:
    """Raise ``UsageError`` for options that do not go together."""
    if goal is None:
        only = "{0} is of use only with adaptive sampling: with target or aamode=noise"
        _refuse(given, ("metric", "maxspp", "maxseconds", "on_round"), (), only)
        _refuse(given, ("denoise",), (False,), "{0} needs two half pictures: give target or spp")
    else:
        name = f"target={goal.target}" if goal.target else "aamode=noise"
        both = (
            f"{name} with {{0}}={{1}}: adaptive sampling allocates rays over the whole film, at most maxspp "
            "of them; leave one of them out"
        )
        if given.error is not None:
            _refuse(given, ("aamode", "spp"), (NOISE,), both)
        _refuse(given, ("aa", "lattice"), (FILM,), both)
        if goal.denoise:
            if decided.focaldist:
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
        _refuse(given, ("aamode", "lattice", "motion"), ("none", FILM), leave)
        if decided.focaldist:
            raise UsageError(
                f"focaldist={decided.focaldist}: {alone}; write focaldist=0, or choose another, such as path"
            )


def _refuse(settings: RenderSettings, options: Sequence[str], allowed: Sequence[Any], text: str) -> None:
    """Raise ``UsageError`` for the first of some options with a value that is not allowed.

    ``text``: the message, with places for its name and its value.
    """
    for option in options:
        value = getattr(settings, option)
        if value not in (None, *allowed):
            raise UsageError(text.format(option, value))


def _layers(
    settings: RenderSettings, goal: Goal | None, shader: Shader
) -> tuple[frozenset[str], frozenset[str]]:
    """Return the layers that are asked for, and those that can be made."""
    asked = frozenset(settings.layers)
    possible = shader.layers.union(name for name in TABLE if TABLE[name].source == DERIVED)
    if goal is None:
        possible -= {"error", "variance"}
    if goal is None or not goal.denoise:
        possible -= {"noisy", "denoised"}
    if settings.aamode not in DETECTORS:
        possible -= {"edges"}
    if asked == LAYERS.keys():
        return asked & possible, possible
    for name in sorted(asked - possible):
        way = _WAYS.get(name, f"{shader.name} does not provide it; use mrt_whitted")
        raise UsageError(f"layers={name}: {way}")
    return asked, possible


# What makes layers that not every render has
_WAYS = {
    "edges": f"give aamode={either([*DETECTORS])}, which look for edges",
    **dict.fromkeys(("error", "variance"), "only rounds estimate them; give a target= or aamode=noise"),
    **dict.fromkeys(("noisy", "denoised"), "give denoise=1, with a target= or spp="),
}


def _passes(
    traced: frozenset[str],
    settings: RenderSettings,
    detector: str | None,
    strata: int,
    goal: Goal | None,
    shader: Shader,
) -> Iterator[Pass]:
    """Yield the passes over the picture, in their order; ``strata``: of the time that one frame sees."""
    on_film = settings.lattice == FILM
    aa = settings.aa or AA
    repeats = (settings.spp or 1) * max(strata, 1)
    if on_film:  # each ray has a time of its own
        every = SamplePattern(FILM, aa, count=aa**2, repeats=repeats)
        centre = replace(every, count=1)
    else:
        centre = SamplePattern(repeats=repeats, time_strata=strata)
        every = replace(centre, lattice=str(settings.lattice), aa=aa, count=aa**2)
    at_centre = frozenset(name for name in traced if TABLE[name].source == FIRST_HIT)
    if at_centre and (on_film or (detector is None and not every.holds_centre)):
        # layers of the first hit belong to the pixel's centre
        yield FirstHits(layers=at_centre, pattern=SamplePattern(time_strata=min(strata, 1)))
        traced -= at_centre
    if goal:
        yield Rounds(layers=traced, pattern=SamplePattern(FILM), goal=goal)
    elif detector is None:
        yield Exposure(layers=traced, pattern=every)
    else:
        # a detector must see no noise: it looks at the centre of each pixel
        noisy = shader.random and centre.repeats == 1 and "image" in DETECTORS[detector]
        yield Exposure(layers=traced, pattern=centre)
        yield Edges(detector=detector, noisy=noisy)
        if settings.aa != 1:
            first = 1 if on_film or every.holds_centre else 0  # the centre is not traced again
            further = replace(every, first=first, count=aa**2 - first)
            yield Refinement(layers=traced - at_centre - {"square"}, pattern=further)
    if settings.focaldist and settings.focalrange is not None:
        yield Blur(mode=settings.dof, focal_distance=settings.focaldist, focal_range=settings.focalrange)


def _left_out(
    traced: frozenset[str],
    passes: set[type[Pass]],
    source: Source,
    shader: Shader,
    decided: tuple[RenderSettings, Goal | None],
) -> Iterator[tuple[str, str]]:
    """Yield the parts that kernels and passes leave out, each with its reason."""
    settings, goal = decided
    for name, why in shader.kernel.reasons if shader.kernel else ():
        yield kernel_plan.WHAT.get(name, name), why
    if Edges not in passes:
        why = "aa=1 has no further samples to add"
        if goal:
            why = "adaptive sampling allocates samples by variance"
        elif settings.aamode == "none":
            why = "aamode=none gives every pixel all its samples"
        yield "edge detection", why
    if Blur not in passes:
        yield Blur.name, "no focal distance"
    if "depth" not in traced:
        yield "depth", "nothing needs it"
    for name in LAYERS:
        if name in shader.layers - traced - {"depth"}:
            yield name, "not asked for"
    yield from _ignored(source, shader.film, settings.lattice == FILM, goal)


def _ignored(source: Source, film: Film, on_film: bool, goal: Goal | None) -> Iterator[tuple[str, str]]:
    """Yield the settings of the film and its sampler that are ignored, each with its reason."""
    if not on_film:
        if source.own:
            why = "the lattice that was asked for places and averages samples"
            yield f"{film.rfilter.class_name()} and {film.sampler}", why
        return
    if film.pixel_format.startswith("xyz"):
        yield f"pixel format {film.pixel_format}", "pictures are linear sRGB, whose luminance or XYZ follow"
    if film.bands:
        why = "the picture is the colour of the spectrum that the film sees, and sampling adapts to it"
        yield f"{', '.join(film.bands)} in the picture, only as layers", why
    if not is_jit():
        if film.sampler != "IndependentSampler":
            yield film.sampler, "scalar variants draw independent numbers, ray by ray"
    elif goal:
        yield film.sampler, "adaptive sampling continues one sequence in each pixel"
