"""Facts about a scene, and the plan of the kernels that ``mrt_whitted`` makes for them.

Plain data and one table, ``RULES``: nothing here knows Mitsuba. Rules map scene facts to a kernel plan, which
the integrator follows. A plan may be edited (``dataclasses.replace``) first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
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

# Why materials have no place in one table
SCALAR_VARIANT = "a scalar variant compiles no kernel"
VARYING = "a material varies over its surface"
GRADIENTS = "derivatives are wanted"


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
    """Every decision that changes a kernel. ``reason(name)`` says why one left something out."""

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
    reasons: tuple[tuple[str, str], ...] = ()  #: what was left out, and why, in words

    def reason(self, name: str) -> str | None:
        """Return the reason for leaving ``name`` out; None where it is in."""
        return dict(self.reasons).get(name)


class IntegratorParams(Protocol):
    """The parameters of the integrator that a plan depends on."""

    max_depth: int
    clamp: bool
    min_contribution: float
    bounce_budget: str


@dataclass
class PlanInput:
    """Input of the rules: scene facts, parameters of the integrator, decisions so far."""

    facts: SceneFacts
    integrator: IntegratorParams
    own_sky: float | None  # largest radiance of the integrator's ``sky``; None without one
    decisions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        facts = self.facts
        sky = facts.sky if self.own_sky is None else self.own_sky
        # A light counts for one, where its share is clamped to that, and the sky for one at least
        lights = facts.lights if self.integrator.clamp or facts.lights == 0 else math.inf
        #: bounds the radiance from anywhere, but for what mirrors add; inf without bound
        self.radiance_bound = lights + max(1, sky) + facts.emission
        #: mirrors that the bounce budget admits
        self.affordable = [m for m in facts.mirrors if self.cost(m) < self.integrator.max_depth]
        self.lobes = tuple(name for name, present in facts.lobes if present)
        self.quadrics = sum(count for _, count in facts.quadrics)
        self.objects = facts.native_shapes + self.quadrics

    def cost(self, mirror: Mirror) -> int:
        """Return the cost of a bounce off a mirror, a part of ``max_depth``."""
        if self.integrator.bounce_budget == "plain":
            return 1
        return max(10 - int(np.float32(10) * np.float32(min(mirror.int_ior, 1))), 1)


Reasons = dict[str, bool]  # against something, by whether they hold; the first that holds is given

# A decision, and the reasons against it
Decision = tuple[Any, Reasons]

# What kernels hold, in words: a format of ``facts`` and ``plan``, one for each value of the field, or a
# function of facts and plan, which gives "" for nothing
Content = str | dict[str, str] | Callable[[SceneFacts, KernelPlan], str]


@dataclass(frozen=True)
class Rule:
    """A rule of the kernel plan, and its words."""

    name: str  #: the field of the plan
    what: str  #: what is decided, in words
    content: Content
    decide: Callable[[PlanInput], Decision]


RULES: list[Rule] = []  #: in the order in which they are taken: later ones may ask for earlier decisions


def rule(
    name: str, what: str, content: Content
) -> Callable[[Callable[[PlanInput], Decision]], Callable[[PlanInput], Decision]]:
    """Put a decision into ``RULES``, by the function that takes it."""

    def add(decide: Callable[[PlanInput], Decision]) -> Callable[[PlanInput], Decision]:
        RULES.append(Rule(name, what, content, decide))
        return decide

    return add


def unless(reasons: Reasons) -> Decision:
    """Decide for something where no reason against it holds."""
    return not any(reasons.values()), reasons


# ----------------------------------------------- The rules ---------------------------------------------

_OTHERS = "other shapes, or spheres that emit or face inwards"

_SPHERES: Content = {
    "table": "spheres from a table of centres and radii",
    "corrected": "hits moved onto spheres",
}


@rule("spheres", "table of spheres", _SPHERES)
def _spheres(case: PlanInput) -> Decision:
    facts = case.facts
    reasons = {
        "no sphere in the scene": facts.spheres == 0,
        SCALAR_VARIANT: not facts.vectorised,
        VARYING: facts.textured,
        "a material needs the frame along texture coordinates": facts.anisotropic,
        _OTHERS: facts.plain_spheres < facts.native_shapes,
    }
    if not any(reasons.values()):
        return "table", reasons
    return "corrected" if facts.spheres else "none", reasons


_LIGHTS: Content = {
    "unrolled": "{facts.lights} lights, unrolled",
    "loop": "{facts.lights} lights, in a loop of calls",
    "table": "{facts.lights} lights, in a loop over a table",
}


@rule("lights", "shadow rays", _LIGHTS)
def _lights(case: PlanInput) -> Decision:
    facts = case.facts
    reasons = {"no light": facts.lights == 0, "every material is black": not case.lobes}
    if any(reasons.values()):
        return "none", reasons
    # Dr.Jit has no derivatives through a loop of such calls
    if facts.lights <= MAX_UNROLLED_LIGHTS or not facts.vectorised or facts.differentiated:
        return "unrolled", reasons
    return "table" if facts.lights_tabulated else "loop", reasons


@rule("mirrors", "bounce loop", "mirror bounces")
def _mirrors(case: PlanInput) -> Decision:
    brightest = max((m.reflectance for m in case.affordable), default=0.0) * case.radiance_bound
    return unless(
        {
            "max_depth admits no mirror ray": bool(case.facts.mirrors) and not case.affordable,
            "no material reflects visibly": not brightest > case.integrator.min_contribution,
        }
    )


def _lobe_content(facts: SceneFacts, plan: KernelPlan) -> str:
    return f"lobes: {', '.join(plan.lobes)}"


@rule("lobes", "one of the lobes", _lobe_content)
def _lobes(case: PlanInput) -> Decision:
    missing = {f"no material has the {name} one": not present for name, present in reversed(case.facts.lobes)}
    return case.lobes, {"every material is black": not case.lobes, **missing}


def _contribution_bounds_content(facts: SceneFacts, plan: KernelPlan) -> str:
    return "an end of paths too dim to be seen" if 0 < plan.contribution_bounds[0] < math.inf else ""


@rule("contribution_bounds", "cut-off", _contribution_bounds_content)
def _contribution_bounds(case: PlanInput) -> Decision:
    """Bound what may still arrive along a path, and what lights bring.

    Both bounds count the hits of a path, weighted by its throughput at normal incidence. It is one where
    materials reflect less than a half there: what is left out at further hits adds less than as much again.
    Where mirrors face each other, it adds up.
    """
    mirrors = case.affordable if case.decisions["mirrors"] else []
    hits = 1.0
    reflectance = max((m.at_normal for m in mirrors if m.at_normal < math.inf), default=0.0)
    if reflectance > 0.5:
        bounces = (case.integrator.max_depth - 2) // min(map(case.cost, mirrors)) + 1
        hits = sum(min(reflectance, 1.0) ** k for k in range(max(bounces, 0) + 1))
    along_path = case.radiance_bound * hits if case.decisions["mirrors"] else 0.0
    unbounded = case.decisions["mirrors"] and case.radiance_bound == math.inf
    reasons = {"what may still arrive has no known bound": unbounded}
    return (along_path, case.facts.lights * hits), reasons


@rule("bvh", "BVH", "{facts.native_shapes} shapes in Mitsuba's BVH")
def _bvh(case: PlanInput) -> Decision:
    return unless({"no shapes but analytic ones": case.facts.native_shapes == 0})


@rule("coherent", "coherent packets", "coherent packets of rays")
def _coherent(case: PlanInput) -> Decision:  # it pays where there are thousands of triangles to meet
    return unless({"no mesh in the scene": case.facts.meshes == 0})


def _quadric_content(facts: SceneFacts, plan: KernelPlan) -> str:
    count = sum(number for kind, number in facts.quadrics if kind in plan.quadrics)
    return f"{count} exact objects in a tree: {', '.join(plan.quadrics)}"


@rule("quadrics", "cones and cylinders", _quadric_content)
def _quadrics(case: PlanInput) -> Decision:
    kinds = tuple(kind for kind, _ in case.facts.quadrics)
    return kinds, {"none in the scene": not kinds}


@rule("planes", "planes", "{facts.planes} analytic planes")
def _planes(case: PlanInput) -> Decision:
    return unless({"none in the scene": case.facts.planes == 0})


@rule("light_buffers", "light buffers", "light buffers: candidate occluders of each light")
def _light_buffers(case: PlanInput) -> Decision:
    facts = case.facts
    return unless(
        {
            "no light": case.decisions["lights"] == "none",
            SCALAR_VARIANT: not facts.vectorised,
            f"a light other than {names_in('lights')}, or one with derivatives": not facts.lights_tabulated,
            _OTHERS: facts.native_shapes > 0 and case.decisions["spheres"] != "table",
            "few objects": case.objects < MIN_BUFFERED_OBJECTS,
            "too many lights and objects": case.objects * facts.lights > MAX_LIGHT_OBJECT_PAIRS,
        }
    )


@rule("eye_buffer", "camera buffer", "camera buffer: candidate hits of camera rays")
def _eye_buffer(case: PlanInput) -> Decision:
    return unless(
        {
            SCALAR_VARIANT: not case.facts.vectorised,
            "few cones and cylinders": case.quadrics < MIN_BUFFERED_OBJECTS,
            "too many cones and cylinders": case.quadrics > MAX_EYE_OBJECTS,
            "the camera is no pinhole": not case.facts.pinhole,
        }
    )


_SKY: Content = {"parameter": "the integrator's sky", "environment": "the scene's sky"}


@rule("sky", "sky", _SKY)
def _sky(case: PlanInput) -> Decision:
    source = "environment" if case.facts.environment else "none"
    if case.own_sky is not None:
        source = "parameter"
    return source, {"no sky in the scene": source == "none"}


@rule("tangents", "tangents", "tangents along texture coordinates")
def _tangents(case: PlanInput) -> Decision:
    return unless({"no material depends on the direction of texture coordinates": not case.facts.anisotropic})


@rule("merged", "merged materials", "all materials as one, from a table")
def _merged(case: PlanInput) -> Decision:
    return unless({case.facts.merge_obstacle: bool(case.facts.merge_obstacle)})


#: Subject of each decision, by name
WHAT = {each.name: each.what for each in RULES}


def make_plan(facts: SceneFacts, integrator: IntegratorParams, own_sky: float | None) -> KernelPlan:
    """Decide what the kernels for a scene hold.

    ``own_sky`` is the largest radiance of the integrator's ``sky``: inf where that is not known, None without
    one.
    """
    case = PlanInput(facts, integrator, own_sky)
    reasons = list[tuple[str, str]]()
    for each in RULES:
        case.decisions[each.name], against = each.decide(case)
        valid = [why for why, holds in against.items() if holds]
        reasons += [(each.name, why) for why in valid[:1]]
    return KernelPlan(**case.decisions, reasons=tuple(reasons))


def contents(plan: KernelPlan, facts: SceneFacts) -> list[str]:
    """Return a line for each thing that the kernels hold."""
    lines = []
    for each in RULES:
        value = getattr(plan, each.name)
        if value in (False, "none", ()):
            continue
        content = each.content
        if isinstance(content, dict):
            content = content[value]
        line = content.format(facts=facts, plan=plan) if isinstance(content, str) else content(facts, plan)
        if line:
            lines.append(line)
    return lines
