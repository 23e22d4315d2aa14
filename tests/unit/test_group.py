"""``mrt_group``: the same pictures as single shapes, materials by object, and large scenes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from nodes import group
from numpy.testing import assert_allclose

from mrt_mitsuba.plugins.quadric_kinds import CLOSED, KINDS
from mrt_mitsuba.scene import model as scene
from mrt_mitsuba.scene.model import OBJECTS, Camera, Light, Material, Plane, Scene, Sphere

pytestmark = pytest.mark.usefixtures("variant")


def crowd(kind: str, count: int, materials: int) -> Scene:
    """Objects of one kind over a glossy plane, of as many materials."""
    rng = np.random.default_rng(1)
    numbers = rng.uniform(0.1, 0.9, (materials, 8)).tolist()
    table = [Material(1 + ior, alpha, tuple(rest[:3]), tuple(rest[3:])) for ior, alpha, *rest in numbers]
    places = rng.uniform(-2, 2, (count, 3)) + np.array([0, 2.2, 0])
    ends = places + rng.normal(size=(count, 3)) * 0.3
    points = np.stack([places, ends])[: KINDS[kind].points]
    objects = tuple(OBJECTS[kind](*points[:, k].tolist(), 0.2, table[k % materials]) for k in range(count))
    floor = Plane((0, 1, 0), 0, table[0])
    view = Camera((6, 4, 5), (0, 1.5, 0))
    sun = Light((3, 8, 1), (1.5, 1.5, 1.5))
    return Scene(view, (0.2, 0.3, 0.7), (sun,), planes=(floor,), **{f"{kind}s": objects})


def picture(content: Scene) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(content.to_dict(width=120, height=90)), spp=1, seed=0))


@pytest.mark.parametrize(("kind", "materials"), [("sphere", 1), *((kind, 7) for kind in CLOSED)])
def test_a_group_looks_like_its_members(monkeypatch, kind, materials):
    """Equal rays give equal pictures, but for roundings that move a silhouette or a shadow's edge."""
    content = crowd(kind, 40, materials)
    single = picture(content)
    monkeypatch.setitem(scene.MAX_SINGLE, kind, 0)
    nodes = content.to_dict()
    assert nodes[f"{kind}s"]["type"] == "mrt_group"
    assert f"{kind}_0" not in nodes
    grouped = picture(content)
    difference = np.abs(single - grouped).max(axis=2)
    assert np.mean(difference > 1e-4) < 2e-3
    assert single.std() > 0.05


def test_textured_members_stay_single(monkeypatch, tmp_path):
    from PIL import Image

    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "red.png")
    content = crowd("sphere", 3, 3)
    red = Material(1.5, 0.1, (0, 0, 0), (1, 1, 1), str(tmp_path / "red.png"))
    spheres = (*content.spheres, Sphere((0, 1, 0), 0.5, red))
    monkeypatch.setitem(scene.MAX_SINGLE, "sphere", 2)
    nodes = Scene(camera=content.camera, sky=(0, 0, 0), lights=content.lights, spheres=spheres).to_dict()
    assert nodes["sphere_0"]["center"] == [0, 1, 0]
    assert len(np.array(nodes["spheres"]["numbers"])) == 3


def test_ten_thousand_materials_take_one_bsdf():
    content = crowd("sphere", 10_000, 10_000)
    loaded = mi.load_dict(content.to_dict())
    assert len(loaded.shapes()) == 2
    assert len({id(s.bsdf()) for s in loaded.shapes()}) == 2
    assert loaded.integrator().prepare(loaded).quadrics.count == 10_000


def test_texture_coordinates_of_a_sphere_are_mitsubas():
    rng = np.random.default_rng(3)
    d = rng.normal(size=(3, 500))
    ray = mi.Ray3f(mi.Point3f(-5 * d), mi.Vector3f(d))
    scene = mi.load_dict({"type": "scene", "group": group([[0.1, 0.2, 0.3, 1]])})
    hit = mi.load_dict({"type": "mrt_whitted"}).trace(scene, None, ray).hit
    sphere = mi.load_dict({"type": "scene", "sphere": {"type": "sphere", "center": [0.1, 0.2, 0.3]}})
    met = np.array(hit.found)
    assert met.mean() > 0.9
    expected = sphere.ray_intersect(ray)
    assert_allclose(np.array(hit.si.uv)[:, met], np.array(expected.uv)[:, met], atol=1e-3)
