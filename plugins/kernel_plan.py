"""Facts about a scene, and the plan of the kernels that ``mrt_whitted`` makes for them.

Plain data and one pure function, ``make_plan``: nothing here knows Mitsuba. The integrator reads the facts,
the plan decides, the integrator obeys. A plan may be edited (``dataclasses.replace``) before it is obeyed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import numpy as np

# Up to this many lights the kernel holds the code of each; beyond, it loops over them
UNROLLED_LIGHTS = 8

# With fewer objects, looking up what is in the way of a light takes as long as searching for it; with more
# pairs of an object and a light, the lists are too long for a processor's caches
LEAST_BUFFERED, MOST_PAIRS = 64, 2**17
# Beyond, lists of what the eye sees take longer to make than they save
MOST_SEEN = 2**14

BUDGETS = ("report", "plain")


class Reason(str, Enum):
    """Why something is not in the kernel."""

    NO_NATIVE_SHAPES = "no-native-shapes"  # every shape is traced by the integrator itself
    NO_MESHES = "no-meshes"
    NO_SPHERES = "no-spheres"
    NO_QUADRICS = "no-quadrics"
    NO_PLANES = "no-planes"
    NO_LIGHTS = "no-lights"
    NO_SURFACE_EMITTERS = "no-surface-emitters"
    NO_SKY = "no-sky"
    DELTA_LIGHTS = "delta-lights"  # every light is a point or a direction
    MAX_DEPTH = "max-depth"  # the bounce budget admits no mirror ray
    NO_MIRRORS = "no-mirrors"  # no material reflects visibly
    UNIFORM = "uniform"  # no material varies over its surface
    ONE_SIDED = "one-sided"  # no material is lit from behind
    SCALAR_VARIANT = "scalar-variant"
    SPECTRAL_VARIANT = "spectral-variant"
    TANGENTS = "tangents"  # materials need derivatives of the surface, which the table does not have
    ISOTROPIC = "isotropic"  # no material asks how the surface is turned
    NATIVE_SHAPES = "native-shapes"  # shapes other than plain spheres
    INSTANCES = "instances"
    OTHER_LIGHTS = "other-lights"  # a light other than mrt_light, or not known by its numbers
    FEW_OBJECTS = "few-objects"
    MANY_OBJECTS = "many-objects"
    MANY_PAIRS = "many-pairs"  # of an object and a light
    OTHER_CAMERA = "other-camera"  # the first is no pinhole, or there is none
    OTHER_BSDF = "other-bsdf"  # a BSDF other than mrt_bsdf
    MIXED_FRESNEL = "mixed-fresnel"
    VARYING = "varying"  # a parameter varies over the surface, or has no place in the table
    APART = "apart"  # no point light is on a surface
    ALONE = "alone"  # a ray that leaves the only object, which is convex, meets nothing
    BLACK = "black"  # no material reflects
    NO_DIFFUSE = "no-diffuse"
    NO_SPECULAR = "no-specular"
    UNBOUNDED = "unbounded"  # no bound of what may still arrive is known
    BOUNDED = "bounded"  # a path's throughput stays within float32
    GRADIENTS = "gradients"  # derivatives are wanted


@dataclass(frozen=True)
class Mirror:
    """Bounds of one material's mirror rays; inf where they are not known."""

    reflectance: float
    int_ior: float
    at_normal: float = 1.0  # its reflectance at normal incidence


@dataclass(frozen=True)
class MaterialRows:
    """Parameters of an ``mrt_bsdf`` as plain numbers: one row, or one for each object of a group."""

    numbers: np.ndarray  # [n, 3]: alpha, int_ior, ext_ior
    diffuse: np.ndarray  # [n, channels]
    specular: np.ndarray


@dataclass(frozen=True)
class SceneFacts:
    """The content of a scene, as far as a kernel depends on it."""

    vectorised: bool  #: is the variant one that compiles kernels
    native_shapes: int  #: shapes that only Mitsuba can trace
    meshes: int  #: of the native ones
    spheres: int  #: of the native ones
    plain_spheres: int  #: of the spheres, those that face outwards and do not emit
    planes: int  #: shapes that are infinite planes
    quadrics: tuple[tuple[str, int], ...]  #: kinds of exact quadrics, and how many of each
    alone: bool  #: is there only one object, convex and reflecting on its outside
    touching: bool  #: is a point light on a surface
    lights: int  #: emitters but for the environment and what is black
    random_lights: int  #: of the lights, those that need random numbers
    surface_emitters: int  #: of the lights, those that are surfaces
    environment: bool  #: is there an environment emitter
    sky: float  #: its largest radiance; inf where that is not known
    arriving: float  #: the most that arrives from all lights; inf where there is no bound
    emission: float  #: the largest radiance of a surface; inf where that is not known
    value: float  #: the largest value of a BSDF times the cosine; inf where that is not known
    diffuse: bool  #: has a material a diffuse lobe
    specular: bool  #: has a material a specular lobe
    mirrors: tuple[Mirror, ...]  #: of the materials that reflect like a mirror
    oriented: bool  #: does a material depend on tangents: anisotropy, bump and normal maps
    textured: bool  #: does a material vary over its surface
    two_sided: bool  #: is a material lit from behind
    unmergeable: Reason | None  #: why the materials cannot be looked up in one table
    tabled: bool  #: can the lights be
    pinhole: bool  #: do all rays of the first camera come from one point


@dataclass(frozen=True)
class Settings:
    """The parameters of the integrator on which its kernels depend."""

    max_depth: int
    min_contribution: float
    bounce_budget: str
    clamp: bool
    own_sky: float | None  #: largest radiance of ``sky``; inf where that is not known, None without one

    def cost(self, int_ior: float) -> int:
        """Return what a bounce off a material of this index takes from the bounce budget."""
        if self.bounce_budget == "plain":
            return 1
        return max(10 - int(np.float32(10) * np.float32(min(int_ior, 1))), 1)


@dataclass(frozen=True)
class CutOff:
    """The quantities that are compared with ``min_contribution``, by their factors."""

    paths: float  #: a path's throughput; inf: it never ends for being too dim
    lights: float  #: a light's share at a hit, below which it is taken for visible


@dataclass(frozen=True)
class KernelPlan:
    """Every decision that changes a kernel. ``reason(name)`` says why one left something out."""

    bvh: bool  #: Mitsuba's ray queries
    coherent: bool  #: Embree's treatment of packets of like rays
    spheres: str  #: "none", "corrected": hits moved onto them, "table": and no call to the shape
    quadrics: tuple[str, ...]  #: kinds of exact quadrics; others are traced as meshes
    planes: bool  #: analytic planes, else they are traced as meshes
    lights: str  #: "none", "unrolled", "loop" that calls each, or "table": a loop over their numbers
    buffers: bool  #: lists of what may be in the way of a light, in place of a search
    eye: bool  #: lists of the quadrics that are seen from the camera, in place of a search for its rays
    touching: bool  #: shadow rays that end short of lights on surfaces
    random: bool  #: random numbers
    emission: bool  #: surfaces that emit
    sky: str  #: "none", "parameter" or "environment"
    mirrors: bool  #: mirror reflections
    mirror_rays: bool  #: the loop that traces them; else they see the sky
    cut_off: CutOff  #: what is too little to be traced
    guarded: bool  #: throughputs kept within float32
    lobes: tuple[str, ...]  #: of the materials: "diffuse", "specular"
    textures: bool  #: texture coordinates
    shading_frames: bool  #: interpolated normals
    tangents: bool  #: derivatives of the surface by uv, and frames along them
    merged: bool  #: one BSDF with a table of materials, in place of a call to each
    two_sided: bool  #: light from behind a surface
    reasons: tuple[tuple[str, Reason], ...] = ()  #: of what was left out

    def reason(self, name: str) -> Reason | None:
        """Return why ``name`` was left out; None where it was not."""
        return dict(self.reasons).get(name)


def _arriving(facts: SceneFacts, settings: Settings) -> float:
    """Return a bound of the radiance from anywhere, but for what mirrors add: inf where there is none.

    Each light counts for one where its share is clamped to that, and the sky for one at least.
    """
    lights = facts.lights if settings.clamp or facts.lights == 0 else facts.arriving * facts.value
    sky = facts.sky if settings.own_sky is None else settings.own_sky
    return lights + max(1, sky) + facts.emission


def _hits(mirrors: Sequence[Mirror], settings: Settings) -> float:
    """Return the number of hits of a path, weighted by its throughput at normal incidence.

    It is one where materials reflect less than a half there: what is left out at further hits adds less than
    as much again. Where mirrors face each other, it adds up.
    """
    reflectance = max((m.at_normal for m in mirrors if m.at_normal < math.inf), default=0.0)
    bounces = (settings.max_depth - 2) // min((settings.cost(m.int_ior) for m in mirrors), default=1) + 1
    return 1.0 if reflectance <= 0.5 else sum(min(reflectance, 1.0) ** k for k in range(max(bounces, 0) + 1))


Unless = Callable[..., bool]


@lru_cache(maxsize=16)  # asked twice in each render
def make_plan(facts: SceneFacts, settings: Settings) -> KernelPlan:
    """Decide what the kernels for a scene hold."""
    reasons: list[tuple[str, Reason]] = []

    def unless(name: str, *obstacles: tuple[bool, Reason]) -> bool:
        """Note the first reason that holds against ``name``; return whether there is none."""
        found = [reason for holds, reason in obstacles if holds]
        reasons.extend((name, reason) for reason in found[:1])
        return not found

    spheres, lights = _spheres(facts, unless), _lights(facts, unless)
    affordable = [m for m in facts.mirrors if settings.cost(m.int_ior) < settings.max_depth]
    mirrors = _mirrors(facts, settings, affordable, unless)
    lobes = _lobes(facts, unless)
    return KernelPlan(
        spheres=spheres,
        lights=lights,
        mirrors=mirrors,
        lobes=lobes,
        cut_off=_cut_off(facts, settings, affordable if mirrors else None, unless),
        bvh=unless("bvh", (facts.native_shapes == 0, Reason.NO_NATIVE_SHAPES)),
        # It pays where there are thousands of triangles to meet
        coherent=unless("coherent", (facts.meshes == 0, Reason.NO_MESHES)),
        quadrics=_quadrics(facts, unless),
        planes=unless("planes", (facts.planes == 0, Reason.NO_PLANES)),
        buffers=_buffers(facts, spheres, lights, unless),
        eye=_eye(facts, unless),
        touching=unless("touching", (not facts.touching, Reason.APART)),
        random=unless("random", (facts.random_lights == 0, Reason.DELTA_LIGHTS)),
        emission=unless("emission", (facts.surface_emitters == 0, Reason.NO_SURFACE_EMITTERS)),
        sky=_sky(facts, settings, unless),
        mirror_rays=mirrors and unless("mirror_rays", (facts.alone, Reason.ALONE)),
        guarded=mirrors and unless("guarded", (_bounded(affordable, settings), Reason.BOUNDED)),
        textures=unless("textures", (not facts.textured, Reason.UNIFORM)),
        shading_frames=unless("shading_frames", (facts.meshes == 0, Reason.NO_MESHES)),
        tangents=unless("tangents", (not facts.oriented, Reason.ISOTROPIC)),
        merged=unless("merged", (facts.unmergeable is not None, facts.unmergeable or Reason.VARYING)),
        two_sided=unless("two_sided", (not facts.two_sided, Reason.ONE_SIDED)),
        reasons=tuple(reasons),
    )


def _spheres(facts: SceneFacts, unless: Unless) -> str:
    table = unless(
        "spheres",
        (facts.spheres == 0, Reason.NO_SPHERES),
        (not facts.vectorised, Reason.SCALAR_VARIANT),
        (facts.textured, Reason.VARYING),
        (facts.oriented, Reason.TANGENTS),
        (facts.plain_spheres < facts.native_shapes, Reason.NATIVE_SHAPES),
    )
    return "table" if table else "corrected" if facts.spheres else "none"


def _lights(facts: SceneFacts, unless: Unless) -> str:
    black = not (facts.diffuse or facts.specular)
    lit = unless("lights", (facts.lights == 0, Reason.NO_LIGHTS), (black, Reason.BLACK))
    unrolled = facts.lights <= UNROLLED_LIGHTS or not facts.vectorised
    return ("unrolled" if unrolled else "table" if facts.tabled else "loop") if lit else "none"


def _buffers(facts: SceneFacts, spheres: str, lights: str, unless: Unless) -> bool:
    objects = facts.native_shapes + sum(count for _, count in facts.quadrics)
    return unless(
        "buffers",
        (lights == "none", Reason.NO_LIGHTS),
        (not facts.vectorised, Reason.SCALAR_VARIANT),
        (not facts.tabled, Reason.OTHER_LIGHTS),
        (facts.native_shapes > 0 and spheres != "table", Reason.NATIVE_SHAPES),
        (objects < LEAST_BUFFERED, Reason.FEW_OBJECTS),
        (objects * facts.lights > MOST_PAIRS, Reason.MANY_PAIRS),
    )


def _eye(facts: SceneFacts, unless: Unless) -> bool:
    quadrics = sum(count for _, count in facts.quadrics)
    return unless(
        "eye",
        (not facts.vectorised, Reason.SCALAR_VARIANT),
        (quadrics < LEAST_BUFFERED, Reason.FEW_OBJECTS),
        (quadrics > MOST_SEEN, Reason.MANY_OBJECTS),
        (not facts.pinhole, Reason.OTHER_CAMERA),
    )


def _mirrors(facts: SceneFacts, settings: Settings, affordable: Sequence[Mirror], unless: Unless) -> bool:
    arriving, has_sky = _arriving(facts, settings), settings.own_sky is not None or facts.environment
    bright = [m for m in affordable if m.reflectance * arriving > settings.min_contribution]
    return unless(
        "mirrors",
        (bool(facts.mirrors) and not affordable, Reason.MAX_DEPTH),
        (not bright, Reason.NO_MIRRORS),
        (facts.alone and not has_sky, Reason.ALONE),
    )


def _lobes(facts: SceneFacts, unless: Unless) -> tuple[str, ...]:
    lobes = tuple(name for name in ("diffuse", "specular") if getattr(facts, name))
    unless(
        "lobes",
        (not lobes, Reason.BLACK),
        (not facts.specular, Reason.NO_SPECULAR),
        (not facts.diffuse, Reason.NO_DIFFUSE),
    )
    return lobes


def _cut_off(
    facts: SceneFacts, settings: Settings, mirrors: Sequence[Mirror] | None, unless: Unless
) -> CutOff:
    """Return the limits for paths off these mirrors; None where nothing is reflected."""
    arriving, hits = _arriving(facts, settings), 1.0 if mirrors is None else _hits(mirrors, settings)
    bounded = unless("cut_off", (mirrors is not None and arriving == math.inf, Reason.UNBOUNDED))
    paths = 0.0 if mirrors is None else arriving * hits if bounded else math.inf
    return CutOff(paths, facts.lights * hits)


def _bounded(mirrors: Sequence[Mirror], settings: Settings) -> bool:
    """Return whether throughputs stay below 1e30."""
    growth = max((m.reflectance for m in mirrors), default=0.0)
    return growth <= 1 or (settings.max_depth - 1) * math.log10(growth) < 30


def _quadrics(facts: SceneFacts, unless: Unless) -> tuple[str, ...]:
    unless("quadrics", (not facts.quadrics, Reason.NO_QUADRICS))
    return tuple(kind for kind, _ in facts.quadrics)


def _sky(facts: SceneFacts, settings: Settings, unless: Unless) -> str:
    given = settings.own_sky is not None
    found = unless("sky", (not given and not facts.environment, Reason.NO_SKY))
    return ("parameter" if given else "environment") if found else "none"
