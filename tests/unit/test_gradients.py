"""Derivatives of ``mi.render`` under ``mrt_whitted`` at ``max_depth`` 1, against finite differences.

Each render has a scene and an integrator of its own: what one has kept must not serve another.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from nodes import AXIAL, group, radius, rgb, sensor

from mrt_mitsuba.plugins.table import Plugin

pytestmark = pytest.mark.usefixtures("variant")

# Finite differences are taken over the rays that the derivatives are: Mitsuba draws others for the picture
RAYS = {"spp": 16, "seed": 2}
WITH_GRADIENTS = {"spp": 16, "seed": 1, "seed_grad": 2}


@pytest.fixture(autouse=True)
def four_threads(variant: str) -> Iterator[None]:
    """With which a quarter of a derivative through mirrors came out in most runs, as a branch gave back the
    same object each time, into which Dr.Jit had written its result."""
    before = dr.thread_count()
    dr.set_thread_count(4)
    yield
    dr.set_thread_count(before)


MATERIAL = {
    "type": "mrt_bsdf",
    "alpha": 0.3,
    "int_ior": 1.6,
    "diffuse_reflectance": rgb(0.2, 0.3, 0.4),
    "specular_reflectance": rgb(0.5, 0.6, 0.7),
}


def scene(**more: Any) -> mi.Scene:
    """A sphere that fills the picture, so that no silhouette moves in it, and one behind the camera."""
    nodes: dict[str, Any] = {"type": "scene", "integrator": {"type": "mrt_whitted", "max_depth": 1}}
    nodes["sensor"] = sensor([0, 0.5, 3], [0, 0, 0], (16, 12), fov=25)
    nodes["light"] = {"type": "mrt_light", "position": [2, 3, 5], "intensity": rgb(1.1, 1.0, 0.9)}
    nodes["lamp"] = {"type": "point", "position": [-2, 2, 4], "intensity": rgb(5, 4, 3)}
    nodes["sky"] = {"type": "constant", "radiance": 0.3}
    nodes["ball"] = {"type": "sphere", "bsdf": MATERIAL}
    nodes["other"] = {"type": "sphere", "center": [0, 0, 9], "radius": 0.1, "bsdf": {"type": "mrt_bsdf"}}
    return mi.load_dict(nodes | more)


def moved(parameters: Any, keys: str, by: Any) -> None:
    """Add a number to parameters, to the first component of a vector or colour, or to the x of a place."""
    for key in keys.split():
        value = parameters[key]
        if key.endswith("to_world"):
            parameters[key] = mi.Transform4f().translate(mi.Vector3f(by, 0, 0)) @ mi.Transform4f(value)
        elif dr.depth_v(value) > 1:
            parameters[key] = type(value)(value[0] + by, *list(value)[1:])
        else:
            parameters[key] = value + by
    parameters.update()


def mean(image: Any) -> float:
    return float(np.array(image, np.float64).mean())


def difference(key: str, step: float, **more: Any) -> float:
    means = []
    for sign in (1, -1):
        loaded = scene(**more)
        parameters = mi.traverse(loaded)
        moved(parameters, key, sign * step)
        means.append(mean(mi.render(loaded, **RAYS)))
    return (means[0] - means[1]) / (2 * step)


def derivative(way: str, key: str, **more: Any) -> float:
    """By a number that moves the parameter; perhaps of another parameter as well."""
    loaded = scene(**more)
    parameters = mi.traverse(loaded)
    by = mi.Float(0)
    dr.enable_grad(by)
    if way == "backward of two":
        other = "ball.bsdf.alpha" if key.startswith("light.intensity") else "light.intensity.value"
        dr.enable_grad(parameters[other])
    moved(parameters, key, by)
    image = mi.render(loaded, parameters, **WITH_GRADIENTS)
    if way == "forward":
        dr.forward(by)
        return mean(dr.grad(image))
    dr.backward(dr.mean(image.array))
    return float(dr.grad(by)[0])


def material(**change: Any) -> dict[str, Any]:
    return {"ball": {"type": "sphere", "bsdf": MATERIAL | change}}


def exact_shape(row: Plugin) -> tuple[str, float, dict[str, Any]]:
    """Its surface is exact: derivatives of a cone's mesh, which other integrators see, are a third off."""
    first, second = row.sample
    ball = {"type": row.name, first: [0, 4, 0], second: [0, -4, 0], "segments": 8}
    ball["radius"] = 1 / radius(row.name.removeprefix("mrt_"), 0.5)  # 1 in the middle
    return f"ball.radius ball.{first} ball.{second}", 1e-2, {"ball": {**ball, "bsdf": MATERIAL}}


TEXTURE = {"type": "checkerboard", "color0": 0.2, "color1": 0.4}


slopes = Cases()
slopes("ball.bsdf.alpha", 1e-2, {})
slopes("ball.bsdf.int_ior", 2e-2, {})
slopes("ball.bsdf.diffuse_reflectance.value", 2e-2, {})
slopes("light.intensity.value", 2e-2, {})
slopes("light.position", 5e-2, {})
slopes("lamp.position", 5e-2, {})
slopes("ball.to_world", 1e-2, {})
slopes("ball.bsdf.int_ior", 4e-3, material(fresnel="dielectric"))
slopes("ball.bsdf.f0.value", 4e-3, material(f0=rgb(0.5, 0.4, 0.3)))
slopes("ball.bsdf.alpha.color0.value", 4e-3, material(alpha=TEXTURE))
for row in AXIAL:
    slopes(*exact_shape(row), slow=True)
# Light that goes to and fro between the ball and a room of mirrors
DEEP = {"type": "mrt_whitted", "max_depth": 6, "bounce_budget": "plain", "clamp": False}
ROOM = {"type": "sphere", "radius": 20.0, "flip_normals": True}
ROOM["bsdf"] = {"type": "mrt_bsdf", "fresnel": "unity", "diffuse_reflectance": 0.1}
FACING = {"integrator": DEEP, "room": ROOM, **material(fresnel="unity")}
slopes("ball.bsdf.specular_reflectance.value", 5e-3, FACING, slow=True)
slopes("light.intensity.value", 2e-2, FACING)
# Next to quadrics that stand before it in the tables, and behind the camera
GROUP = group([[x, 1, 9, x, 0, 9, 0.1] for x in range(3)], kind="cone")
CONE = {"type": "mrt_cone", "apex": [0, 4, 0], "base_center": [0, -4, 0], "radius": 2.0, "segments": 8}
slopes("cone.radius", 1e-2, {"ball": GROUP, "cone": {**CONE, "bsdf": MATERIAL}}, slow=True)
# More lights than a kernel has code of their own for, without derivatives
MANY = {f"light{i}": {"type": "mrt_light", "position": [i, 2, 5], "intensity": 0.05} for i in range(8)}
slopes("light3.intensity.value", 2e-2, MANY)
slopes("ball.bsdf.diffuse_reflectance.value", 2e-2, MANY)


@pytest.mark.parametrize(("key", "step", "more"), slopes)
def test_derivatives_are_those_of_finite_differences(key, step, more):
    exact = difference(key, step, **more)
    assert abs(exact) > 1e-4
    for way in ("forward", "backward", "backward of two"):
        # The error of a central difference falls with the square of the step: below 0.5 % here
        assert derivative(way, key, **more) == pytest.approx(exact, rel=1e-2)


@pytest.mark.parametrize("update", [True, False])
def test_derivatives_by_enable_grad(update):
    """Enabled in place, with and without an update of the parameters, after a render without derivatives."""
    loaded = scene()
    parameters = mi.traverse(loaded)
    mi.render(loaded, spp=1)
    alpha = parameters["ball.bsdf.alpha"]
    dr.enable_grad(alpha)
    if update:
        parameters.update()
    dr.backward(dr.mean(mi.render(loaded, parameters, **WITH_GRADIENTS).array))
    assert float(dr.grad(alpha)[0]) == pytest.approx(difference("ball.bsdf.alpha", 1e-2), rel=1e-2)
