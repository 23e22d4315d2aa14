"""Facts about a scene, and the plan of the kernels that ``mrt_whitted`` makes for them.

Plain data: nothing here knows Mitsuba. Rules map scene facts to a kernel plan, which the integrator follows.
A plan may be edited (``dataclasses.replace``) first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..table import names_in

# Up to this many lights the kernel holds the code of each; beyond, it loops over them
MAX_UNROLLED_LIGHTS = 8

# With fewer objects, looking up what is in the way of a light takes as long as searching for it; with more
# pairs of an object and a light, the lists are too long for a processor's caches; with more objects than
# ``MAX_EYE_OBJECTS``, those around the eye take longer to make than they save
MIN_BUFFERED_OBJECTS = 64
MAX_LIGHT_OBJECT_PAIRS = 2**17
MAX_EYE_OBJECTS = 2**14

BUDGETS = ("report", "plain")

# Reasons that several rules have, or why materials have no place in one table
SCALAR_VARIANT = "a scalar variant compiles no kernel"
VARYING = "a material varies over its surface"
GRADIENTS = "derivatives are wanted"
OTHER_SHAPES = "other shapes, or spheres that emit or face inwards"


class Mirror(NamedTuple):
    """Bounds of a material's specular reflection; inf where unknown."""

    reflectance: float
    int_ior: float
    at_normal: float = 1.0  # reflectance at normal incidence


@dataclass(frozen=True)
class SceneFacts:
    """The content of a scene, as far as a kernel depends on it."""

    vectorised: bool  #: the variant compiles kernels
    pinhole: bool  #: all rays of the first camera start at one point
    native_shapes: int  #: shapes that only Mitsuba can trace
    meshes: int  #: meshes among these, and in groups
    spheres: int  #: spheres among them
    plain_spheres: int  #: those that face outwards and do not emit
    planes: int  #: infinite planes
    quadrics: tuple[tuple[str, int], ...]  #: kinds of exact quadrics, and how many of each
    lights: int  #: emitters but for the environment and those that are black
    random_lights: int  #: lights that are no point and no direction
    surface_emitters: int  #: lights that are a surface
    lights_tabulated: bool  #: all lights are rows of a table
    environment: bool  #: there is an environment emitter
    sky: float  #: its largest radiance; 0 without one, inf where it is not known
    emission: float  #: the same of the surfaces
    lobes: tuple[tuple[str, bool], ...]  #: those of ``mrt_bsdf``, and whether a material may have them
    mirrors: tuple[Mirror, ...]  #: of the materials that reflect like a mirror
    anisotropic: bool  #: a material depends on the tangent frame
    textured: bool  #: a material varies over its surface
    merge_obstacle: str  #: why the materials have no place in one table; "" where they do
    differentiated: bool  #: derivatives are wanted


@dataclass(frozen=True)
class KernelPlan:
    """Every decision that changes a kernel."""

    spheres: str  #: "none", "corrected": hits moved onto them, "table": and no call to the shape
    lights: str  #: "none", "unrolled", "loop" that calls each, or "table": a loop over their numbers
    mirrors: bool  #: mirror reflections
    lobes: tuple[str, ...]  #: of the materials, by name
    #: factors of a path's throughput (inf: it never ends for being too dim), and of a light's share at a hit,
    #: before these are compared with ``min_contribution``
    contribution_bounds: tuple[float, float]
    bvh: bool  #: Mitsuba's ray queries
    coherent: bool  #: Embree's mode for packets of coherent rays
    quadrics: tuple[str, ...]  #: kinds of exact quadrics; others are traced as meshes
    planes: bool  #: analytic planes, else they are traced as meshes
    light_buffers: bool  #: per light, a cube map of the objects that may occlude it, in place of a search
    eye_buffer: bool  #: the same around the camera, of the quadrics that it may see
    sky: str  #: "none", "parameter" or "environment"
    tangents: bool  #: derivatives of the surface by uv, and frames along them
    merged: bool  #: one BSDF with a table of materials, in place of a call to each
    reasons: tuple[tuple[str, str], ...] = ()  #: names of what was left out, and why, in words


class IntegratorParams(Protocol):
    """The parameters of the integrator that a plan depends on."""

    max_depth: int
    clamp: bool
    min_contribution: float
    bounce_budget: str


#: Subject of each decision, by name
WHAT = {
    "spheres": "table of spheres",
    "lights": "shadow rays",
    "mirrors": "bounce loop",
    "lobes": "one of the lobes",
    "contribution_bounds": "cut-off",
    "bvh": "BVH",
    "coherent": "coherent packets",
    "quadrics": "cones and cylinders",
    "planes": "planes",
    "light_buffers": "light buffers",
    "eye_buffer": "camera buffer",
    "sky": "sky",
    "tangents": "tangents",
    "merged": "merged materials",
}

Reasons = dict[str, bool]  # against something, by whether they hold; the first that holds is given

# Decisions by the fields of the plan, each with the reasons against it
Decisions = dict[str, tuple[Any, Reasons]]


def make_plan(facts: SceneFacts, integrator: IntegratorParams, own_sky: float | None) -> KernelPlan:
    """Decide what the kernels for a scene hold.

    ``own_sky`` is the largest radiance of the integrator's ``sky``: inf where that is not known, None without
    one.
    """
    decisions = _surfaces(facts) | _light(facts, integrator, own_sky)
    decisions |= _buffers(facts, decisions)
    reasons = list[tuple[str, str]]()
    for name in WHAT:
        reasons += [(name, why) for why, holds in decisions[name][1].items() if holds][:1]
    return KernelPlan(**{name: value for name, (value, _) in decisions.items()}, reasons=tuple(reasons))


def unless(reasons: Reasons) -> tuple[bool, Reasons]:
    """Decide for something where no reason against it holds."""
    return not any(reasons.values()), reasons


def _surfaces(facts: SceneFacts) -> Decisions:
    """Decide who traces the shapes, and what is known of surfaces."""
    in_table, against = unless(
        {
            "no sphere in the scene": facts.spheres == 0,
            SCALAR_VARIANT: not facts.vectorised,
            VARYING: facts.textured,
            "a material needs the frame along texture coordinates": facts.anisotropic,
            OTHER_SHAPES: facts.plain_spheres < facts.native_shapes,
        }
    )
    spheres = "corrected" if facts.spheres else "none"
    kinds = tuple(kind for kind, _ in facts.quadrics)
    no_direction = "no material depends on the direction of texture coordinates"
    return {
        "spheres": ("table" if in_table else spheres, against),
        "bvh": unless({"no shapes but analytic ones": facts.native_shapes == 0}),
        # It pays where there are thousands of triangles to meet
        "coherent": unless({"no mesh in the scene": facts.meshes == 0}),
        "quadrics": (kinds, {"none in the scene": not kinds}),
        "planes": unless({"none in the scene": facts.planes == 0}),
        "tangents": unless({no_direction: not facts.anisotropic}),
        "merged": unless({facts.merge_obstacle: bool(facts.merge_obstacle)}),
    }


def _light(facts: SceneFacts, integrator: IntegratorParams, own_sky: float | None) -> Decisions:
    """Decide where light comes from, and bound what may still arrive along a path, and what lights bring.

    Both bounds count the hits of a path, weighted by its throughput at normal incidence. It is one where
    materials reflect less than a half there: what is left out at further hits adds less than as much again.
    Where mirrors face each other, it adds up.
    """
    sky = "environment" if facts.environment else "none"
    brightest_sky = facts.sky
    if own_sky is not None:
        sky = "parameter"
        brightest_sky = own_sky
    lobes = tuple(name for name, present in facts.lobes if present)
    missing = {f"no material has the {name} one": not present for name, present in reversed(facts.lobes)}
    black = {"every material is black": not lobes}
    lit, unlit = unless({"no light": facts.lights == 0, **black})
    lights = "table" if facts.lights_tabulated else "loop"
    # Dr.Jit has no derivatives through a loop of calls
    if facts.lights <= MAX_UNROLLED_LIGHTS or not facts.vectorised or facts.differentiated:
        lights = "unrolled"

    # A light counts for one, where its share is clamped to that, and the sky for one at least
    brought = facts.lights if integrator.clamp or facts.lights == 0 else math.inf
    radiance = brought + max(1, brightest_sky) + facts.emission  # from anywhere, but for what mirrors add
    budget = integrator.bounce_budget
    affordable = [m for m in facts.mirrors if cost(m, budget) < integrator.max_depth]
    reflected = max((m.reflectance for m in affordable), default=0.0) * radiance
    mirrors, dull = unless(
        {
            "max_depth admits no mirror ray": bool(facts.mirrors) and not affordable,
            "no material reflects visibly": not reflected > integrator.min_contribution,
        }
    )
    hits = 1.0
    reflectance = max((m.at_normal for m in affordable if m.at_normal < math.inf), default=0.0)
    if mirrors and reflectance > 0.5:
        bounces = (integrator.max_depth - 2) // min(cost(m, budget) for m in affordable) + 1
        hits = sum(min(reflectance, 1.0) ** k for k in range(max(bounces, 0) + 1))
    bounds = radiance * hits if mirrors else 0.0, facts.lights * hits
    unbounded = {"what may still arrive has no known bound": mirrors and radiance == math.inf}
    return {
        "lights": (lights if lit else "none", unlit),
        "mirrors": (mirrors, dull),
        "lobes": (lobes, black | missing),
        "contribution_bounds": (bounds, unbounded),
        "sky": (sky, {"no sky in the scene": sky == "none"}),
    }


def cost(mirror: Mirror, budget: str) -> int:
    """Return the cost of a bounce off a mirror, a part of ``max_depth``."""
    if budget == "plain":
        return 1
    return max(10 - int(np.float32(10) * np.float32(min(mirror.int_ior, 1))), 1)


def _buffers(facts: SceneFacts, decisions: Decisions) -> Decisions:
    """Decide where lists of objects around a point replace a search."""
    quadrics = sum(count for _, count in facts.quadrics)
    objects = facts.native_shapes + quadrics
    scalar = {SCALAR_VARIANT: not facts.vectorised}
    light_buffers = {
        "no light": decisions["lights"][0] == "none",
        **scalar,
        f"a light other than {names_in('lights')}, or one with derivatives": not facts.lights_tabulated,
        OTHER_SHAPES: facts.native_shapes > 0 and decisions["spheres"][0] != "table",
        "few objects": objects < MIN_BUFFERED_OBJECTS,
        "too many lights and objects": objects * facts.lights > MAX_LIGHT_OBJECT_PAIRS,
    }
    eye_buffer = {
        **scalar,
        "few cones and cylinders": quadrics < MIN_BUFFERED_OBJECTS,
        "too many cones and cylinders": quadrics > MAX_EYE_OBJECTS,
        "the camera is no pinhole": not facts.pinhole,
    }
    return {"light_buffers": unless(light_buffers), "eye_buffer": unless(eye_buffer)}


def contents(plan: KernelPlan, facts: SceneFacts) -> list[str]:
    """Return a line for each thing that the kernels hold."""
    quadrics = sum(count for kind, count in facts.quadrics if kind in plan.quadrics)
    lines = {
        f"{facts.spheres} spheres: {plan.spheres}": plan.spheres != "none",
        f"{facts.lights} lights: {plan.lights}": plan.lights != "none",
        "mirror bounces": plan.mirrors,
        f"lobes: {', '.join(plan.lobes)}": bool(plan.lobes),
        "an end of paths too dim to be seen": 0 < plan.contribution_bounds[0] < math.inf,
        f"{facts.native_shapes} shapes in Mitsuba's BVH": plan.bvh,
        "coherent packets of rays": plan.coherent,
        f"{quadrics} exact objects in a tree: {', '.join(plan.quadrics)}": bool(plan.quadrics),
        f"{facts.planes} analytic planes": plan.planes,
        "light buffers: candidate occluders of each light": plan.light_buffers,
        "camera buffer: candidate hits of camera rays": plan.eye_buffer,
        f"sky: {plan.sky}": plan.sky != "none",
        "tangents along texture coordinates": plan.tangents,
        "all materials as one, from a table": plan.merged,
    }
    return [line for line, there in lines.items() if there]
