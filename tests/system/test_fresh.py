"""A picture is that of the scene as it is: to the bit that of a scene made anew by the same edits."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import edits
import mitsuba as mi
import numpy as np
import pytest
from nodes import group, rgb, sensor
from numpy.testing import assert_allclose, assert_array_equal

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")

ROUNDS = int(os.environ.get("MRT_ATTACK_ROUNDS", "0"))  # of 504 pictures: 5,040 by make attack

COLORS = rgb(0.8, 0.1, 0.1), rgb(0.1, 0.8, 0.1)
RED, GREEN = ({"type": "mrt_bsdf", "diffuse_reflectance": color} for color in COLORS)


def content(fresnel: str) -> dict[str, Any]:
    nodes: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "sensor": sensor([0, 2, 7], [0, 0.5, 0], (12, 9)),
    }
    nodes["light"] = {"type": "mrt_light", "position": [3, 5, 4]}
    nodes["sky"] = {"type": "constant", "radiance": 0.3}
    for k in range(4):
        paint = {**(GREEN if k % 2 else RED), "fresnel": fresnel}
        nodes[f"s{k}"] = {"type": "sphere", "center": [1.2 * k - 2, 0.5, 0], "radius": 0.5, "bsdf": paint}
    nodes["cone"] = {"type": "mrt_cone", "apex": [0, 2, -1], "base_center": [0, 0, -1], "bsdf": GREEN}
    nodes["group"] = {"type": "shapegroup", "box": {"type": "cube"}}
    nodes["instance"] = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    nodes["floor"] = {"type": "mrt_plane", "normal": [0, 1, 0], "bsdf": {**RED, "fresnel": fresnel}}
    return nodes


def picture(scene: mi.Scene, integrator: Any) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, spp=1, seed=1))


@pytest.fixture
def quiet() -> Iterator[None]:
    """Let Mitsuba print errors alone."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    yield
    mi.set_log_level(level)


@pytest.mark.parametrize(
    "part", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.attack)]
)
def test_edited_scenes_are_drawn_as_scenes_made_anew(part, quiet, variant, tmp_path):
    """To the bit, and those made anew in another process."""
    first = 20 + 1000 * part
    count = (2, 14, 72 * ROUNDS)[part]
    path = tmp_path / "anew.npz"
    pictures = {
        number: list(edits.live(content, done)) for number, content, done in edits.stories(first, count)
    }
    words = [sys.executable, edits.__file__, str(first), str(count), str(path)]
    other = subprocess.run(words, capture_output=True, text=True, timeout=300 + 10 * count, check=False)
    assert other.returncode == 0, other.stderr  # it had the kernels that were compiled above
    with np.load(path) as anew:
        for number, content, done in edits.stories(first, count):
            for step, (live, fresh) in enumerate(zip(pictures[number], anew[str(number)], strict=True)):
                where = f"story {number}, after {[kind for kind, _ in done[:step]]}: {list(content)}"
                assert_array_equal(live, fresh, err_msg=where)


def test_an_integrator_may_serve_several_scenes():
    """Of the same loaded objects, or alike but for a property that is no array."""
    integrator = mi.load_dict({"type": "mrt_whitted"})
    schlick, exact = (mi.load_dict(content(name)) for name in ("schlick", "dielectric"))
    both = {f"shape{k}": shape for k, shape in enumerate(exact.shapes()) if shape.class_name() == "Sphere"}
    again = mi.load_dict({"type": "scene", "sensor": exact.sensors()[0], "sky": exact.environment(), **both})
    for scene in (schlick, exact, again, exact, schlick, again):
        expected = picture(scene, mi.load_dict({"type": "mrt_whitted"}))
        assert_array_equal(picture(scene, integrator), expected)


SIZE = {"width": 16, "height": 12}


@pytest.mark.parametrize("loaded", [True, False])
def test_a_prepared_scene_gives_what_render_gives(loaded):
    options = {**SIZE, "aa": 1 if loaded else 2, "aamode": "none"}
    nodes = mrt.scene_dict(3)
    again = mrt.prepare(mi.load_dict(nodes), **options)
    other = mi.load_dict(nodes)
    parameters = mi.traverse(other)
    keys = [key for key in parameters.keys() if key.endswith("reflectance.value")]  # noqa: SIM118
    for seed, value in ((0, 0.0), (0, 0.3), (1, 0.4), (2, 0.9)):
        for key in keys:
            again.params[key] = parameters[key] = mi.Color3f(value, 0.5 * value, 0.2 * value)
        parameters.update()
        found, expected = again(seed=seed), mrt.render(other, seed=seed, **options)
        assert_array_equal(found.image, expected.image)
        assert str(found.plan) == str(expected.plan)  # its kernels have mirrors where these do


@pytest.mark.parametrize(("name", "value"), [("max_depth", 2), ("clamp", False), ("min_contribution", 0.3)])
def test_a_prepared_scene_follows_its_integrator(name, value):
    options = {**SIZE, "aa": 1, "aamode": "none"}
    scene = mi.load_dict(mrt.scene_dict(3))
    again = mrt.prepare(scene, **options)
    before = again().image
    setattr(scene.integrator(), name, value)
    after = again().image
    assert (after != before).any()
    assert_array_equal(after, mrt.render(scene, **options).image)


def test_lists_around_the_eye_follow_the_camera():
    """Whichever camera looks and however it moves, the picture is that of a search; trees are made once."""
    ends = np.random.default_rng(2).uniform(-1, 1, (80, 6))
    nodes = {name: node for name, node in content("schlick").items() if name in ("light", "sky", "floor")}
    nodes["crowd"] = group(np.column_stack([ends, np.full(80, 0.2)]), kind="cone", bsdf=GREEN)
    size: dict[str, Any] = {"width": 12, "height": 9, "aa": 1, "aamode": "none", "integrator": "mrt_whitted"}
    views = sensor([0, 1, 4], [0, 0, 0], (12, 9)), sensor([3, 2, 3], [0, 0, 0], (12, 9))
    scene = mi.load_dict({"type": "scene", "first": views[0], "other": views[1], **nodes})
    lists, search = (mi.load_dict({"type": "mrt_whitted", "max_depth": 1}) for _ in range(2))
    search.kernel_plan = lambda facts: replace(lists.kernel_plan(facts), eye_buffer=False)
    trees = lists.prepare(scene).quadrics
    again = mrt.prepare(scene, **size)
    parameters = mi.traverse(scene)
    for x in (0, 0.1, 3):
        parameters["first.to_world"] = mi.Transform4f().look_at([x, 1, 4], [0, 0, 0], [0, 1, 0])
        parameters.update()
        for view in (0, 1, 0):
            pictures = [mi.render(scene, integrator=way, sensor=view, spp=4) for way in (lists, search)]
            assert_array_equal(*map(np.array, pictures))
        data = lists.prepare(scene)
        assert data.quadrics is trees
        assert_allclose(np.ravel(data.eye_buffers[0][0].place), (x, 1, 4))
        assert_array_equal(again().image, mrt.render(scene, **size).image)


SIZES = {
    "size": {"film.size": [20, 10]},
    "crop window": {"film.crop_size": [8, 6], "film.crop_offset": [2, 3]},
}


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("options", [{"aa": 1, "aamode": "none"}, {}, {"spp": 2}], ids=str)
@pytest.mark.parametrize("change", SIZES)
def test_a_prepared_scene_follows_the_size_of_its_film(variant, options, change):
    nodes = {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "ball": {"type": "sphere"},
        "sky": {"type": "constant"},
    }
    scene = mi.load_dict(nodes | {"eye": sensor([0, 1, 6], [0, 0, 0], (16, 12), fov=25)})
    again = mrt.prepare(scene, **options)
    before = again()
    for name, value in SIZES[change].items():
        again.params[f"eye.{name}"] = value
    after = again()
    expected = mrt.render(scene, **options)
    assert after.image.shape == expected.image.shape != before.image.shape
    assert (after.plan.width, after.plan.height) == (expected.plan.width, expected.plan.height)
    assert_array_equal(after.image, expected.image)
    assert_array_equal(again(seed=3).image, mrt.render(scene, seed=3, **options).image)


@pytest.mark.parametrize(
    ("options", "size", "says"),
    [({}, [9, 0], "give it one pixel at least"), (SIZE, [20, 10], "width or height was given to prepare")],
)
def test_a_size_of_the_film_that_cannot_be(variant, options, size, says):
    """A film without pixels, and one of another size than was asked for by an option."""
    again = mrt.prepare(mi.load_dict(mrt.scene_dict(3, **SIZE)), aa=1, aamode="none", **options)
    before = again().image
    known = list(again.params["sensor.film.size"])
    again.params["sensor.film.size"] = size
    with pytest.raises(mrt.MrtError, match=says):
        again()
    again.params["sensor.film.size"] = known
    assert_array_equal(again().image, before)


def test_a_prepared_scene_leaves_the_variant(variant):
    again = mrt.prepare(mi.load_dict(mrt.scene_dict(3)), width=8, height=6, aa=1, aamode="none")
    before = again().image
    mi.set_variant("scalar_rgb")
    assert_array_equal(again().image, before)
    assert mi.variant() == "scalar_rgb"
