"""``mrt_light``: the same light at any distance, in every variant and under stock integrators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import mesh, sensor
from numpy.testing import assert_allclose

pytestmark = pytest.mark.usefixtures("variant")

in_variants = pytest.mark.parametrize(
    "variant",
    ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_mono_polarized", "scalar_rgb"],
    indirect=True,
)

POSITION = (1.0, -2.0, 3.0)


def light(**parameters: Any) -> mi.Emitter:
    return mi.load_dict({"type": "mrt_light", "position": list(POSITION), **parameters})


def point_at(p: Any) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = mi.Point3f(*map(float, p))
    si.time = 0.25
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(450, 500, 550, 600)
    return si


def spectrum(value: Any) -> np.ndarray:
    return np.ravel(mi.unpolarized_spectrum(value))


def stock_spectrum(intensity: Any) -> np.ndarray:
    """Return what a stock point light of that intensity sends over unit distance, in the current mode."""
    stock = mi.load_dict({"type": "point", "position": [0, 0, 1], "intensity": intensity})
    return spectrum(stock.sample_direction(point_at((0, 0, 0)), mi.Point2f(0.5))[1])


@in_variants
def test_colour_does_not_depend_on_the_distance(variant):
    towards = np.array([2, 3, 6]) / 7
    it = light(position=[0, 0, 0], intensity=2.5)
    for distance in (1e-6, 1, 1e6):
        one = point_at(-distance * towards)
        ds, weight = it.sample_direction(one, mi.Point2f(0.5))
        for value in (weight, it.eval_direction(one, ds)):
            assert_allclose(spectrum(value), stock_spectrum(2.5), rtol=1e-6)
        assert_allclose(np.ravel(ds.d), towards, rtol=1e-6)
        assert_allclose(np.ravel(ds.n), -towards, rtol=1e-6)
        assert np.array(ds.dist) == pytest.approx(distance, rel=1e-6)
        assert (np.array(ds.pdf), np.array(ds.time)) == (1, 0.25)
    assert (spectrum(it.eval_direction(one, ds, False)) == 0).all()
    ds, _ = it.sample_direction(point_at((0, 0, 0)), mi.Point2f(0.5))
    assert np.linalg.norm(np.ravel(ds.d)) == pytest.approx(1)  # there is none, and any will do


def test_light_tracing_is_refused_where_there_is_one():
    """Dr.Jit asks all lights of the process: other scenes could not be rendered while one was there."""
    box = mi.cornell_box()
    tracer = mi.load_dict({"type": "ptracer"})
    other = light()
    box["sensor"]["film"] |= {"width": 4, "height": 4}
    assert mi.render(mi.load_dict(box), integrator=tracer, spp=4).numpy().mean() > 0
    with pytest.raises(NotImplementedError, match="light tracing needs a finite emitted power"):
        tracer.render(mi.load_dict(box | {"other": other}), spp=4)


def upright(kind: str) -> Callable[[float], dict[str, Any]]:
    ends = ("apex", "base_center") if kind == "cone" else ("p0", "p1")
    return lambda s: {"type": f"mrt_{kind}", ends[0]: [0, s, 0], ends[1]: [0, 0, 0], "radius": s}


def wedge(s: float) -> dict[str, Any]:
    corners = s * np.array([(-1, 0, 1), (1, 0, 1), (0, 1, 0), (0, 0, -1)])
    return mesh(corners, [(0, 1, 2), (1, 3, 2), (3, 0, 2)])


def ball(s: float) -> dict[str, Any]:
    return {"type": "sphere", "radius": s}


def leaning(s: float) -> dict[str, Any]:
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], -60).scale(s)
    return {"type": "rectangle", "to_world": turned}


@dataclass(frozen=True)
class Surface:
    """A surface with a light on it."""

    shape: Callable[[float], dict[str, Any]]  #: of a size
    light: list[float]  #: place on the shape of size 1
    out: list[float]  #: direction off the surface there


SURFACES = {
    "sphere": Surface(ball, [-0.26726124, -0.53452248, -0.80178373], [-0.27, -0.53, -0.8]),
    "plane": Surface(ball, [2, -2, 1], [0, 1, 0]),
}
SURFACES["cone apex"] = Surface(upright("cone"), [0, 1, 0], [0, 1, 0])
SURFACES["cone side"] = Surface(upright("cone"), [-0.3, 0.5, -0.4], [-0.42, 0.71, -0.57])
SURFACES["cylinder side"] = Surface(upright("cylinder"), [-0.6, 0.5, -0.8], [-0.6, 0, -0.8])
SURFACES["rectangle"] = Surface(leaning, [0.3, 0.1, 3**0.5 * -0.1], [0, 0.75**0.5, 0.5])
SURFACES["triangle"] = Surface(wedge, [0.1, 0.4, 0.6], [0, 0.71, 0.71])
SURFACES["corner"] = Surface(wedge, [0, 1, 0], [0, 1, 0])


def lit_from_a_surface(name: str, s: float, lift: float = 0.0) -> np.ndarray:
    """Where it is lit: a shape over a floor, before two walls; its light is on it, or so many sizes above."""
    surface = SURFACES[name]
    clips = {"near_clip": 0.01 * s, "far_clip": 1e4 * s}
    place = s * (np.array(surface.light) + lift * np.array(surface.out))
    nodes = {"type": "scene", "shape": surface.shape(s)}
    nodes["sensor"] = sensor([2 * s, 3 * s, 6 * s], [0, 0.3 * s, 0], (96, 72), fov=40, **clips)
    nodes["integrator"] = {"type": "mrt_whitted", "max_depth": 1}
    nodes["light"] = {"type": "mrt_light", "position": place.tolist()}
    nodes["floor"] = {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 2 * s}
    nodes["wall"] = {"type": "mrt_plane", "normal": [1, 0, 0], "distance": 4 * s}
    nodes["back"] = {"type": "mrt_plane", "normal": [0, 0, 1], "distance": 4 * s}
    return np.array(mi.render(mi.load_dict(nodes), spp=1)) > 1e-3


@pytest.mark.parametrize("name", SURFACES)
def test_a_light_on_a_surface_shines_at_every_scale(name):
    """Both sides are lit, as by one a thousandth above and one below, without speckles, in any unit."""
    image, above, below = (lit_from_a_surface(name, 1.0, lift) for lift in (0.0, 1e-3, -1e-3))
    assert 0.1 < image.mean() < 0.95
    for scale in (0.37, 1e-4, 7e5):
        other = lit_from_a_surface(name, scale)
        assert (other != image).any(axis=-1).mean() < 1e-3  # a pixel at a shadow's edge
    # From that much higher, the sphere's horizon is 0.045 radii away
    assert (above | below != image).any(axis=-1).mean() < 0.03
