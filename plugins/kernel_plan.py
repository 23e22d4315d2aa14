"""What ``mrt_whitted`` knows about a scene, and what its kernels hold because of it.

Plain data and one pure function, ``make_plan``: nothing here knows Mitsuba. The integrator reads the facts,
the plan decides, the integrator obeys. A plan may be edited (``dataclasses.replace``) before it is obeyed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

# Up to this many lights the kernel holds the code of each; beyond, it loops over them
UNROLLED_LIGHTS = 8

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
    OTHER_BSDF = "other-bsdf"  # a BSDF other than mrt_bsdf
    MIXED_FRESNEL = "mixed-fresnel"
    VARYING = "varying"  # a parameter varies over the surface, or has no place in the table
    GRADIENTS = "gradients"  # derivatives are wanted


@dataclass(frozen=True)
class Mirror:
    """Bounds of one material's mirror rays; inf where they are not known."""

    reflectance: float
    int_ior: float


@dataclass(frozen=True)
class SceneFacts:
    """What a scene is made of, as far as a kernel depends on it."""

    vectorised: bool  #: is the variant one that compiles kernels
    native_shapes: int  #: shapes that only Mitsuba can trace
    meshes: int  #: of the native ones
    spheres: int  #: of the native ones
    plain_spheres: int  #: of the spheres, those that face outwards and do not emit
    planes: int  #: shapes that are infinite planes
    quadrics: tuple[tuple[str, int], ...]  #: kinds of exact quadrics, and how many of each
    lights: int  #: emitters but for the environment
    random_lights: int  #: of the lights, those that need random numbers
    surface_emitters: int  #: of the lights, those that are surfaces
    environment: bool  #: is there an environment emitter
    mirrors: tuple[Mirror, ...]  #: of the materials that reflect like a mirror
    oriented: bool  #: does a material depend on tangents: anisotropy, bump and normal maps
    textured: bool  #: does a material vary over its surface
    two_sided: bool  #: is a material lit from behind
    unmergeable: Reason | None  #: why the materials cannot be looked up in one table


@dataclass(frozen=True)
class Settings:
    """The parameters of the integrator on which its kernels depend."""

    max_depth: int
    min_contribution: float
    bounce_budget: str
    own_sky: bool  #: was a ``sky`` given

    def cost(self, int_ior: float) -> int:
        """Return what a bounce off a material of this index takes from the bounce budget."""
        if self.bounce_budget == "plain":
            return 1
        return max(10 - int(np.float32(10) * np.float32(min(int_ior, 1))), 1)


@dataclass(frozen=True)
class KernelPlan:
    """Every decision that changes a kernel. ``reason(name)`` says why one left something out."""

    bvh: bool  #: Mitsuba's ray queries
    coherent: bool  #: Embree's treatment of packets of like rays
    spheres: str  #: "none", "corrected": hits moved onto them, "table": and no call to the shape
    quadrics: tuple[str, ...]  #: kinds of exact quadrics; others are traced as meshes
    planes: bool  #: analytic planes, else they are traced as meshes
    lights: str  #: "none", "unrolled" or "loop"
    random: bool  #: random numbers
    emission: bool  #: surfaces that emit
    sky: str  #: "none", "parameter" or "environment"
    mirrors: bool  #: the loop over mirror bounces
    textures: bool  #: texture coordinates
    shading_frames: bool  #: interpolated normals
    tangents: bool  #: derivatives of the surface by uv, and frames along them
    merged: bool  #: one BSDF with a table of materials, in place of a call to each
    two_sided: bool  #: light from behind a surface
    reasons: tuple[tuple[str, Reason], ...] = ()  #: of what was left out

    def reason(self, name: str) -> Reason | None:
        """Return why ``name`` was left out; None where it was not."""
        return dict(self.reasons).get(name)


def make_plan(facts: SceneFacts, settings: Settings) -> KernelPlan:
    """Decide what the kernels for a scene hold."""
    reasons: list[tuple[str, Reason]] = []

    def unless(name: str, *obstacles: tuple[bool, Reason]) -> bool:
        """Note the first reason that holds against ``name``; return whether there is none."""
        found = [reason for holds, reason in obstacles if holds]
        reasons.extend((name, reason) for reason in found[:1])
        return not found

    no_native = facts.native_shapes == 0
    table = unless(
        "spheres",
        (facts.spheres == 0, Reason.NO_SPHERES),
        (not facts.vectorised, Reason.SCALAR_VARIANT),
        (facts.textured, Reason.VARYING),
        (facts.oriented, Reason.TANGENTS),
        (facts.plain_spheres < facts.native_shapes, Reason.NATIVE_SHAPES),
    )
    unrolled = facts.lights <= UNROLLED_LIGHTS or not facts.vectorised
    lit = unless("lights", (facts.lights == 0, Reason.NO_LIGHTS))
    affordable = [m for m in facts.mirrors if settings.cost(m.int_ior) < settings.max_depth]
    bright = [m for m in affordable if m.reflectance * (facts.lights + 1) > settings.min_contribution]
    sky = "parameter" if settings.own_sky else "environment"
    return KernelPlan(
        bvh=unless("bvh", (no_native, Reason.NO_NATIVE_SHAPES)),
        # It pays where there are thousands of triangles to meet
        coherent=unless("coherent", (facts.meshes == 0, Reason.NO_MESHES)),
        spheres="table" if table else "corrected" if facts.spheres else "none",
        quadrics=tuple(kind for kind, _ in facts.quadrics)
        if unless("quadrics", (not facts.quadrics, Reason.NO_QUADRICS))
        else (),
        planes=unless("planes", (facts.planes == 0, Reason.NO_PLANES)),
        lights=("unrolled" if unrolled else "loop") if lit else "none",
        random=unless("random", (facts.random_lights == 0, Reason.DELTA_LIGHTS)),
        emission=unless("emission", (facts.surface_emitters == 0, Reason.NO_SURFACE_EMITTERS)),
        sky=sky if unless("sky", (not (settings.own_sky or facts.environment), Reason.NO_SKY)) else "none",
        mirrors=unless(
            "mirrors",
            (bool(facts.mirrors) and not affordable, Reason.MAX_DEPTH),
            (not bright, Reason.NO_MIRRORS),
        ),
        textures=unless("textures", (not facts.textured, Reason.UNIFORM)),
        shading_frames=unless("shading_frames", (facts.meshes == 0, Reason.NO_MESHES)),
        tangents=unless("tangents", (not facts.oriented, Reason.ISOTROPIC)),
        merged=unless("merged", (facts.unmergeable is not None, facts.unmergeable or Reason.VARYING)),
        two_sided=unless("two_sided", (not facts.two_sided, Reason.ONE_SIDED)),
        reasons=tuple(reasons),
    )
