"""Facts about a scene, and the plan of the kernels that ``mrt_whitted`` makes for them.

Plain data and one table, ``RULES``: nothing here knows Mitsuba. The integrator reads the facts, the rules
decide, and the integrator obeys. A plan may be edited (``dataclasses.replace``) first.
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

# Up to this many lights the kernel holds the code of each; beyond, it loops over them
UNROLLED_LIGHTS = 8

# With fewer objects, looking up what is in the way of a light takes as long as searching for it; with more
# pairs of an object and a light, the lists are too long for a processor's caches; with more objects than
# ``MOST_SEEN``, those around the eye take longer to make than they save
LEAST_BUFFERED, MOST_PAIRS, MOST_SEEN = 64, 2**17, 2**14

BUDGETS = ("report", "plain")

# Why materials have no place in one table
SCALAR_VARIANT = "a scalar variant compiles no kernel"
VARYING = "a material varies over its surface"
GRADIENTS = "derivatives are wanted"


#: Bounds of a material's mirror rays: reflectance, index, reflectance at normal incidence; inf if unknown
Mirror = namedtuple("Mirror", "reflectance int_ior at_normal", defaults=[1.0])

#: The content of a scene, as far as a kernel depends on it: see ``facts``
SceneFacts = SimpleNamespace


@dataclass(frozen=True)
class KernelPlan:
    """Every decision that changes a kernel. ``reason(name)`` says why one left something out."""

    spheres: str  #: "none", "corrected": hits moved onto them, "table": and no call to the shape
    lights: str  #: "none", "unrolled", "loop" that calls each, or "table": a loop over their numbers
    mirrors: bool  #: mirror reflections
    lobes: tuple[str, ...]  #: of the materials: "diffuse", "specular"
    #: what multiplies a path's throughput (inf: it never ends for being too dim), and a light's share at a
    #: hit, before they are compared with ``min_contribution``
    cut_off: tuple[float, float]
    bvh: bool  #: Mitsuba's ray queries
    coherent: bool  #: Embree's treatment of packets of like rays
    quadrics: tuple[str, ...]  #: kinds of exact quadrics; others are traced as meshes
    planes: bool  #: analytic planes, else they are traced as meshes
    buffers: bool  #: lists of what may be in the way of a light, in place of a search
    eye: bool  #: lists of the quadrics that the camera may see, in place of a search
    random: bool  #: random numbers
    emission: bool  #: surfaces that emit
    sky: str  #: "none", "parameter" or "environment"
    textures: bool  #: texture coordinates
    shading_frames: bool  #: interpolated normals
    tangents: bool  #: derivatives of the surface by uv, and frames along them
    merged: bool  #: one BSDF with a table of materials, in place of a call to each
    two_sided: bool  #: light from behind a surface
    reasons: tuple[tuple[str, str], ...] = ()  #: what was left out, and why, in words

    def reason(self, name: str) -> str | None:
        """Return why ``name`` was left out; None where it was not."""
        return dict(self.reasons).get(name)


def bounce_cost(tracer: Any, int_ior: float) -> int:
    """Return what a bounce off a material of this index takes from the bounce budget."""
    if tracer.bounce_budget == "plain":
        return 1
    return max(10 - int(np.float32(10) * np.float32(min(int_ior, 1))), 1)


def _cut_off(case: SimpleNamespace) -> tuple[float, float]:
    """Return the bound of what may still arrive along a path, and that of what lights bring.

    Both count the hits of a path, weighted by its throughput at normal incidence. It is one where materials
    reflect less than a half there: what is left out at further hits adds less than as much again. Where
    mirrors face each other, it adds up.
    """
    mirrors, tracer = case.affordable if case.made["mirrors"] else [], case.tracer
    reflectance, hits = max((m.at_normal for m in mirrors if m.at_normal < math.inf), default=0.0), 1.0
    if reflectance > 0.5:
        bounces = (tracer.max_depth - 2) // min(bounce_cost(tracer, m.int_ior) for m in mirrors) + 1
        hits = sum(min(reflectance, 1.0) ** k for k in range(max(bounces, 0) + 1))
    return case.arriving * hits if case.made["mirrors"] else 0.0, case.facts.lights * hits


#: A decision: the field of the plan; what is decided, in words; what kernels hold, perhaps by facts and plan
#: ("" if there is nothing to tell); reasons against it, the first that holds being given; and the value, by
#: the case (see ``make_plan``) and whether there is no reason
Rule = namedtuple("Rule", "name what held against value", defaults=[lambda case, free: free])

_SPHERES = {"table": "spheres from a table of centres and radii", "corrected": "hits moved onto spheres"}
_LIGHTS = {"unrolled": "unrolled", "loop": "in a loop of calls", "table": "in a loop over a table"}
_SKY = {"parameter": "the integrator's sky", "environment": "the scene's sky"}
_OTHERS = "other shapes, or spheres that emit or face inwards"


# In the order in which they are taken: later ones may ask for earlier decisions
RULES = (
    Rule(
        "spheres", "table of spheres",
        lambda facts, plan: _SPHERES[plan.spheres],
        lambda case: {
            "no sphere in the scene": case.facts.spheres == 0,
            SCALAR_VARIANT: not case.facts.vectorised,
            VARYING: case.facts.textured,
            "a material needs the frame along texture coordinates": case.facts.oriented,
            _OTHERS: case.facts.plain_spheres < case.facts.native_shapes,
        },
        lambda case, free: "table" if free else "corrected" if case.facts.spheres else "none",
    ),
    Rule(
        "lights", "shadow rays",
        lambda facts, plan: f"{facts.lights} lights, {_LIGHTS[plan.lights]}",
        lambda case: {"no light": case.facts.lights == 0, "every material is black": not case.lobes},
        lambda case, free: "none" if not free
        else "unrolled" if case.facts.lights <= UNROLLED_LIGHTS or not case.facts.vectorised
        else "table" if case.facts.tabled else "loop",
    ),
    Rule(
        "mirrors", "bounce loop", "mirror bounces",
        lambda case: {
            "max_depth admits no mirror ray": bool(case.facts.mirrors) and not case.affordable,
            "no material reflects visibly": not case.visible,
        },
    ),
    Rule(
        "lobes", "one of the lobes",
        lambda facts, plan: f"lobes: {', '.join(plan.lobes)}",
        lambda case: {
            "every material is black": not case.lobes,
            **{f"no material has the {name} one": not there for name, there in reversed(case.facts.lobes)},
        },
        lambda case, free: case.lobes,
    ),
    Rule(
        "cut_off", "cut-off",
        lambda facts, plan: "an end of paths too dim to be seen" if 0 < plan.cut_off[0] < math.inf else "",
        lambda case: {
            "what may still arrive has no known bound": case.made["mirrors"] and case.arriving == math.inf
        },
        lambda case, free: _cut_off(case),
    ),
    Rule(
        "bvh", "BVH",
        lambda facts, plan: f"{facts.native_shapes} shapes in Mitsuba's BVH",
        lambda case: {"no shapes but analytic ones": case.facts.native_shapes == 0},
    ),
    Rule(  # it pays where there are thousands of triangles to meet
        "coherent", "coherent packets", "coherent packets of rays",
        lambda case: {"no mesh in the scene": case.facts.meshes == 0},
    ),
    Rule(
        "quadrics", "cones and cylinders",
        lambda facts, plan: f"{sum(n for kind, n in facts.quadrics if kind in plan.quadrics)} exact objects "
        f"in a tree: {', '.join(plan.quadrics)}",
        lambda case: {"none in the scene": not case.facts.quadrics},
        lambda case, free: tuple(kind for kind, _ in case.facts.quadrics),
    ),
    Rule(
        "planes", "planes",
        lambda facts, plan: f"{facts.planes} analytic planes",
        lambda case: {"none in the scene": case.facts.planes == 0},
    ),
    Rule(
        "buffers", "light buffers", "light buffers: what may be in the way of each light",
        lambda case: {
            "no light": case.made["lights"] == "none",
            SCALAR_VARIANT: not case.facts.vectorised,
            "a light other than mrt_light, or one with derivatives": not case.facts.tabled,
            _OTHERS: case.facts.native_shapes > 0 and case.made["spheres"] != "table",
            "few objects": case.objects < LEAST_BUFFERED,
            "too many lights and objects": case.objects * case.facts.lights > MOST_PAIRS,
        },
    ),
    Rule(
        "eye", "lists around the eye", "lists around the eye: what its rays may meet",
        lambda case: {
            SCALAR_VARIANT: not case.facts.vectorised,
            "few cones and cylinders": case.quadrics < LEAST_BUFFERED,
            "too many cones and cylinders": case.quadrics > MOST_SEEN,
            "the camera is no pinhole": not case.facts.pinhole,
        },
    ),
    Rule(
        "random", "random numbers", "random numbers",
        lambda case: {"every light is a point or a direction": case.facts.random_lights == 0},
    ),
    Rule(
        "emission", "emission", "emission of surfaces",
        lambda case: {"no surface emits": case.facts.surface_emitters == 0},
    ),
    Rule(
        "sky", "sky",
        lambda facts, plan: _SKY[plan.sky],
        lambda case: {"no sky in the scene": case.sky == "none"},
        lambda case, free: case.sky,
    ),
    Rule(
        "textures", "textures", "textures and their coordinates",
        lambda case: {"every material is uniform": not case.facts.textured},
    ),
    Rule(
        "shading_frames", "shading normals", "shading normals of meshes",
        lambda case: {"no mesh in the scene": case.facts.meshes == 0},
    ),
    Rule(
        "tangents", "tangents", "tangents along texture coordinates",
        lambda case: {
            "no material depends on the direction of texture coordinates": not case.facts.oriented
        },
    ),
    Rule(
        "merged", "merged materials", "all materials as one, from a table",
        lambda case: {case.facts.unmergeable: bool(case.facts.unmergeable)},
    ),
    Rule(
        "two_sided", "light from behind", "light from behind surfaces",
        lambda case: {"no material is lit from behind": not case.facts.two_sided},
    ),
)  # fmt: skip

#: What a decision is about, by its name
WHAT = {rule.name: rule.what for rule in RULES}


def make_plan(facts: SceneFacts, tracer: Any, own_sky: float | None) -> KernelPlan:
    """Decide what the kernels for a scene hold.

    ``tracer`` has the integrator's parameters; ``own_sky`` is the largest radiance of its ``sky``: inf where
    that is not known, None without one.
    """
    sky = facts.sky if own_sky is None else own_sky
    # A light counts for one, where its share is clamped to that, and the sky for one at least
    lights = facts.lights if tracer.clamp or facts.lights == 0 else math.inf
    arriving = lights + max(1, sky) + facts.emission
    quadrics = sum(count for _, count in facts.quadrics)
    affordable = [m for m in facts.mirrors if bounce_cost(tracer, m.int_ior) < tracer.max_depth]
    made, reasons = dict[str, Any](), list[tuple[str, str]]()
    case = SimpleNamespace(  # what the rules go by
        facts=facts,
        tracer=tracer,
        made=made,  # the decisions so far
        arriving=arriving,  # bounds the radiance from anywhere, but for what mirrors add; inf without bound
        affordable=affordable,  # mirrors that the bounce budget admits
        visible=any(m.reflectance * arriving > tracer.min_contribution for m in affordable),
        sky="parameter" if own_sky is not None else "environment" if facts.environment else "none",
        lobes=tuple(name for name, there in facts.lobes if there),
        quadrics=quadrics,
        objects=facts.native_shapes + quadrics,
    )
    for rule in RULES:
        found = [why for why, holds in rule.against(case).items() if holds]
        reasons += [(rule.name, why) for why in found[:1]]
        made[rule.name] = rule.value(case, not found)
    return KernelPlan(**made, reasons=tuple(reasons))


def held(plan: KernelPlan, facts: SceneFacts) -> list[str]:
    """Return a line for each thing that the kernels hold."""
    there = [rule.held for rule in RULES if getattr(plan, rule.name) not in (False, "none", ())]
    lines = [text if isinstance(text, str) else text(facts, plan) for text in there]
    return [line for line in lines if line]
