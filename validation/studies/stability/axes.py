"""Errors of this project and of Mitsuba, in units of roundoff, along axes that are hard on float32."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.linalg import norm

from mrt_mitsuba.plugins import fresnel
from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Plane, Scene
from mrt_mitsuba.validation import plotting
from mrt_mitsuba.validation.bsdf_probe import evaluate, pairs_about
from mrt_mitsuba.validation.oracles import exact
from mrt_mitsuba.validation.oracles.reference import Array, dot, nearest, unit
from mrt_mitsuba.validation.studies import roughconductor
from mrt_mitsuba.validation.study import Study, Values

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROUNDING = 2.0**-24
MIRROR = Material(1.5, 1.0, (1, 1, 1), (1, 1, 1))
TIP = 0.2, 1.0, -0.4  # direction of slanted axes

OURS = "ours"
THEIRS = "Mitsuba"
LEAST = 0.3  # roundings: as good as exact
NONE_RIGHT = 2.0**24  # roundings: no digit is right
STEEPEST = 4.0
WORST = 0.99  # the share of the samples that stay below the figure shown

Curves = dict[str, Array]  # roundings [places] by ``OURS``, ``THEIRS``


@dataclass(frozen=True)
class Axis:
    """An axis along which a figure gets hard to compute."""

    title: str
    label: str  #: of the axis
    nearest: str  #: Mitsuba's closest plugin
    ends: tuple[float, float]  #: exponents of ten
    measure: Callable[[float, int], Curves]  #: figures [samples] of one place, from the number of samples
    limit: float  #: that ours is promised to stay below, in roundings


def show(study: Study, *, quick: bool) -> None:
    """Add the diagram of all axes and its table to a study, and hold ours to its promised limit.

    They show the roundings that nearly all samples of a place stay below.
    """
    rows = []
    caption = (
        "Roundings of float32 (6e-8). Blue: ours. Orange: Mitsuba's closest plugin. At the top, no digit "
        "is right."
    )
    for number, axis in enumerate(study.each("Axes", AXES)):
        x = np.logspace(*axis.ends, 13 if quick else 33)
        samples = [axis.measure(place, 24 if quick else 96) for place in x.tolist()]
        lines = {}
        for side in (OURS, THEIRS):
            quantiles = [np.quantile(row[side], WORST, method="lower") for row in samples]
            lines[side] = np.clip(quantiles, LEAST, NONE_RIGHT)
        ours = lines[OURS].max()
        title = f"{axis.title} along the {axis.label}"
        why = "three times what was measured; the worst place of this axis"
        study.at_most(f"roundings of the {title}", ours, axis.limit, why)
        row = {"what": axis.title, "along": axis.label, "promised": axis.limit, "ours, worst": ours}
        row |= {f"{THEIRS}, worst": lines[THEIRS].max(), "Mitsuba's closest plugin": axis.nearest}
        rows.append(row)
        study.picture(f"roundings {number}", title, roundings(axis, x, lines), "" if number else caption)
    note = f"One rounding is 2⁻²⁴. {WORST:.0%} of the samples of a place stay below its figure."
    study.records("roundings", "Where float32 breaks, and where ours does not", rows, note, first=True)


def roundings(axis: Axis, x: Array, lines: Curves) -> Figure:
    """Draw errors in roundings of float32 along an axis; all axes have the same scale."""
    drawn, axes = plotting.panel(axis.title, height=3.4)
    blue, orange, *_ = plotting.COLORS
    plotting.logarithmic(axes, axis.label, "error in roundings")
    axes.axhspan(0.1, axis.limit, color="#dcebf7", zorder=0, label="promised")
    axes.plot(x, lines[THEIRS], color=orange, label=axis.nearest)
    axes.plot(x, lines[OURS], color=blue, linewidth=2.4, label=OURS)
    axes.set_ylim(0.2, 10 * NONE_RIGHT)
    plotting.legend(axes)
    return drawn


@np.errstate(all="ignore")  # what has no digit left may be NaN
def _off(ours: object, theirs: object, truth: Array) -> Curves:
    """Return relative errors in roundings; NaN and infinity count as ``NONE_RIGHT``."""
    errors = {}
    for name, value in ((OURS, ours), (THEIRS, theirs)):
        error = abs(np.asarray(value, np.float64) / truth - 1) / ROUNDING
        errors[name] = np.where(np.isfinite(error), error, NONE_RIGHT)
    return errors


# ------------------------------------------ Reflectance ------------------------------------------


def lobes(cosine: Array, alpha: float) -> Curves:
    """Measure the lobe D G / (4 cos θi), without Fresnel, for light from these cosines [N].

    tan²θh / alpha² of half vectors is at most ``STEEPEST``: D is at least exp(-STEEPEST) of its peak.
    """
    rng = np.random.default_rng(11)
    wi, wo = pairs_about(cosine, alpha * np.sqrt(STEEPEST * rng.random(len(cosine))), rng)
    up = wo[:, 2] > 5e-8
    wi = wi[up]
    wo = wo[up]
    a = np.float32(alpha)
    truth = [exact.lobe(i, o, exact.number(a)).value for i, o in zip(wi, wo, strict=True)]
    bsdfs = (roughconductor.ours(float(a)), roughconductor.theirs(float(a)))
    found = [evaluate(mi.load_dict(bsdf), wi, wo)[0][:, 0] for bsdf in bsdfs]
    return _off(found[0], found[1], np.array(truth, float))


def roughness(alpha: float, count: int) -> Curves:
    """Measure the lobe at a roughness, for directions that are not grazing."""
    return lobes(np.random.default_rng(3).uniform(0.2, 1, count), alpha)


def grazing(cosine: float, count: int) -> Curves:
    """Measure a lobe of roughness 0.3 at so small a cosine of the light's direction."""
    return lobes(np.full(count, cosine), 0.3)


def reflectances(cosines: Array, iors: Array) -> Curves:
    """Measure Fresnel's reflectance for cosines and indices of refraction [N], float32."""
    truth = [float(exact.fresnel_dielectric(c, 1, n)) for c, n in zip(cosines, iors, strict=True)]
    ours = fresnel.fresnel_dielectric(mi.Float(cosines), 1, mi.Float(iors))
    return _off(ours, mi.fresnel(mi.Float(cosines), mi.Float(iors))[0], np.array(truth))


def index(above: float, count: int) -> Curves:
    """Measure Fresnel's reflectance at an index of refraction, given as its excess over 1."""
    return reflectances(np.linspace(0.02, 1, count, dtype=np.float32), np.full(count, 1 + above, np.float32))


# -------------------------------------------- Geometry --------------------------------------------


def _hits(thing: Cone | Cylinder | Plane, targets: Array, eyes: Array, stock: Values | None = None) -> Curves:
    """How far hits of rays from eyes to targets [N, 3] are off a surface, in roundings of coordinates.

    ``stock``: a shape of Mitsuba's, for what it has no shape of our own for: there it sees our mesh.
    """
    o = np.float32(eyes)
    d = np.float32(unit(targets - o))
    things: Any = {f"{type(thing).__name__.lower()}s": (thing,)}
    light = Light((9e6, 9e6, 9e6), (1, 1, 1))
    lit = Scene(Camera((0, 0, 9), (0, 0, 0)), (0, 0, 0), (light,), **things)
    scene = mi.load_dict(lit.to_dict(fresnel="unity"))
    whitted = mi.load_dict({"type": "mrt_whitted", "min_contribution": 0.0})
    other = mi.load_dict({"type": "scene", "shape": stock}) if stock else scene
    ours = np.array(whitted.trace(scene, None, mi.Ray3f(o.T, d.T)).hit.si.t)
    theirs = np.array(other.ray_intersect(mi.Ray3f(o.T, d.T)).t)
    length = norm(np.float64(d), axis=1)
    distance, _, normal, *_ = nearest([thing], o, d / length[:, None])  # in float64
    truth = distance / length
    scale = np.maximum(abs(o).max(axis=1), abs(o + truth[:, None] * d).max(axis=1))
    errors = {}
    for name, t in ((OURS, ours), (THEIRS, theirs)):
        hit = np.isfinite(t) & (t > 0)
        off = np.where(hit, t, truth) - truth
        errors[name] = np.where(hit, abs(off * dot(normal, d)) / scale / ROUNDING, NONE_RIGHT)
    return errors


def floor(far: float, count: int) -> Curves:
    """Measure hits of a floor at a distance, in heights of the eye."""
    rng = np.random.default_rng(6)
    normal = np.array([0.6, 0.64, 0.48], np.float32).astype(np.float64)  # as the plugin rounds it
    up = unit(normal)
    targets = far * unit(np.cross(rng.normal(size=(count, 3)), up))
    turned = mi.ScalarTransform4f().look_at([0, 0, 0], up.tolist(), [0, 0, 1]).scale(2 * far)
    stock = {"type": "rectangle", "to_world": turned}
    return _hits(Plane(tuple(normal), 0.0, MIRROR), targets, np.tile(up, (count, 1)), stock)


def axial(kind: type[Cone] | type[Cylinder], slender: float, count: int) -> Curves:
    """Measure hits on the side of a solid ``slender`` radii high, on a slanted axis; its larger extent is 1.

    At a depth below the tip its radius is ``wide + slope * depth``.
    """
    rng = np.random.default_rng(7)
    radius = min(1 / slender, 1.0)
    tip = np.float32(min(slender, 1.0) / 2 * unit(np.array(TIP))).astype(np.float64)
    base = -tip
    along = unit(tip)
    height = 2 * float(norm(tip))
    wide, slope = (0.0, radius / height) if kind is Cone else (radius, 0.0)
    outwards = unit(np.cross(along, rng.normal(size=(count, 3))))
    depths = height * rng.uniform(0.2, 0.8, (count, 1))
    targets = tip - depths * along + (wide + slope * depths) * outwards
    normal = unit(outwards + slope * along)
    eyes = targets + 3 * unit(normal + 0.3 * rng.normal(size=(count, 3)))
    thing = kind(tuple(tip.tolist()), tuple(base.tolist()), radius, MIRROR)
    stock = {"type": "cylinder", "p0": base, "p1": tip, "radius": radius}
    return _hits(thing, targets, eyes, stock if kind is Cylinder else None)


LOBE = 48  # roundings
HIT = 16
cone = partial(axial, Cone)
cylinder = partial(axial, Cylinder)
AXES = (
    Axis("value of a highlight", "roughness α", "roughconductor", (-8, 0), roughness, LOBE),
    Axis("Fresnel reflectance", "index of refraction − 1", "mi.fresnel", (-7, 8), index, 32),
    Axis("value of a highlight", "cosine of the light", "roughconductor", (-8, 0), grazing, LOBE),
    Axis("hit with a floor", "distance / height of the eye", "rectangle", (0, 6), floor, HIT),
    Axis("hit with a cone", "height / radius", "256-sided mesh", (-4, 4), cone, HIT),
    Axis("hit with a cylinder", "height / radius", "cylinder", (-4, 4), cylinder, HIT),
)
