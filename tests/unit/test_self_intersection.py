"""Surfaces are not in their own shadow, however far the camera."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import group, mesh, sensor

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.rendering.api import render

WHITTED = {"type": "mrt_whitted"}


@pytest.mark.parametrize("beneath", [None, "rectangle", "mrt_plane"])
@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_large_surfaces_near_the_origin_have_no_dark_spots(variant, kind, beneath):
    """What a hit is off by goes with the coordinates of the shape, not with its own, which are near zero; nor
    with what a flat shape beneath it would be off by."""
    numbers = {"sphere": [[0, -1000, 0, 1000]], "cylinder": [[-900, -1000, 0, 900, -1000, 0, 1000]]}[kind]
    scene = {"type": "scene", "integrator": WHITTED, "large": group(numbers, kind=kind)}
    scene["sensor"] = sensor([0.3, 2, 3], [0, 0, 0], (160, 120), fov=20)
    scene["light"] = {"type": "mrt_light", "position": [0.3, 2, 3]}
    if beneath == "rectangle":
        turn = mi.ScalarTransform4f().translate([0, -0.1, 0]).rotate([1, 0, 0], -90)
        scene["beneath"] = floor(beneath, 2.0, turn)
    elif beneath:
        scene["beneath"] = {"type": beneath, "normal": [0, 1, 0], "distance": 0.1}
    assert (render(scene, aa=1, lattice="report").image > 0.02).all()


def floor(kind: str, half: float, turn: mi.ScalarTransform4f) -> dict[str, Any]:
    if kind == "rectangle":
        return {"type": "rectangle", "to_world": turn.scale([half, half, 1])}
    corners = half * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    return mesh(corners, [(0, 1, 2), (0, 2, 3)]) | {"to_world": turn}


@pytest.mark.parametrize("kind", ["rectangle", "mesh"])
@pytest.mark.parametrize(("place", "half"), [((0, 0, 0), 1.0), ((3, 2, 1), 1.0), ((3, 2, 1), 1e4)])
def test_a_grain_on_a_wide_floor_has_its_shadow(variant, kind, place, half):
    """A ball of radius 0.005, as ``direct`` draws it."""
    turn = mi.ScalarTransform4f().translate(list(place)).rotate([1, 0, 0], -90)
    steps = [[0.05, 0.06, 0.05], [0, 0.005, 0], [0.3, 0.5, -0.2]]
    eye, center, lamp = np.add(place, steps).tolist()
    nodes = {"type": "scene", "integrator": WHITTED, "floor": floor(kind, half, turn)}
    nodes["grain"] = {"type": "sphere", "center": center, "radius": 0.005}
    nodes["sensor"] = sensor(eye, center, (160, 120), fov=25, near_clip=1e-3)
    nodes["light"] = {"type": "point", "position": lamp}
    scene = mi.load_dict(nodes)

    def draw(**integrator: Any) -> np.ndarray:
        return np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=1))

    ours = draw(type="mrt_whitted", max_depth=1, clamp=False, min_contribution=0.0)
    direct = draw(type="direct")
    dark = [(image < 1e-3 * direct.max()).all(axis=-1) for image in (ours, direct)]
    assert 700 < dark[1].sum() < 900
    # Rays of ``direct`` start 9e-5 (1 + |p|) off, 2 to 8 % of the ball's radius, and the rim moves with them
    assert (dark[0] != dark[1]).sum() < 60


@pytest.mark.parametrize("kind", ["rectangle", "mesh"])
def test_a_small_floor_far_from_the_origin_has_no_dark_spots(variant, kind):
    """However it is turned, and a lamp lights it from the side."""
    for k, place in enumerate(np.random.default_rng(5).normal(scale=1000, size=(6, 3)).tolist()):
        turn = mi.ScalarTransform4f().translate(place).rotate([0.6, 0, 0.8], 50 + 60 * k)
        eye, lamp = (list(turn @ mi.ScalarPoint3f(*at)) for at in ((1, 0, 1), (2, 0, 0.02)))
        nodes = {"type": "scene", "integrator": WHITTED, "floor": floor(kind, 4.0, turn)}
        nodes["sensor"] = sensor(eye, place, (160, 120), up=turn @ mi.ScalarVector3f(0, 1, 0), fov=60)
        nodes["light"] = {"type": "point", "position": lamp}
        assert (np.array(mi.render(mi.load_dict(nodes), spp=1)) > 0).all()


@pytest.mark.parametrize("size", [1e-9, 1e11])
def test_meshes_that_rays_cannot_meet_are_refused(variant, size):
    scene = {"type": "scene", "integrator": WHITTED, "sensor": sensor([0, 0, 6 * size], [0, 0, 0], (4, 3))}
    scene["floor"] = floor("mesh", 0.5 * size, mi.ScalarTransform4f())
    with pytest.raises(SceneError, match=r'the mesh "floor" is .* across .*: scale the scene'):
        render(scene, aa=1)


def test_a_mesh_in_a_group_is_refused_once_it_has_grown(variant):
    """What instances show is looked at again when it has changed."""
    nodes: dict[str, Any] = {"type": "scene", "integrator": {"type": "mrt_whitted"}}
    nodes["sensor"] = sensor([0, 0, 6], [0, 0, 0], (4, 3))
    nodes["group"] = {"type": "shapegroup", "floor": floor("mesh", 0.5, mi.ScalarTransform4f())}
    nodes["instance"] = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    scene = mi.load_dict(nodes)
    render(scene, aa=1)
    parameters = mi.traverse(scene)
    (key,) = (key for key, _ in parameters if key.endswith("vertex_positions"))
    parameters[key] = parameters[key] * 1e11
    parameters.update()
    with pytest.raises(SceneError, match=r"the mesh .* is .* across .*: scale the scene"):
        render(scene, aa=1)
