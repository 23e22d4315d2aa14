"""``check_shape``: sound shapes pass, each mistake fails its own laws."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import but_slow
from nodes import AXIAL
from unit.specimens import ChangedShape, exceeded

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.laws.faults import put
from mrt_mitsuba.validation.laws.shape import LAWS
from mrt_mitsuba.validation.laws.shape_case import ShapeCase

pytestmark = pytest.mark.usefixtures("variant")

OPEN = {"watertight"}
MIRRORED = {"to_world": [1, -1, 1]}
ELLIPSOIDS = {
    "centers": np.float32([[0, 0, 0], [2, 0, 0]]),
    "scales": np.float32([[0.3, 0.2, 0.4], [0.1, 0.3, 0.2]]),
    "quaternions": np.float32([[0, 0, 0, 1], [0.5, 0.5, 0.5, 0.5]]),
}

# Parameters, laws that are known to fail, and those that make no sense; docs/check_your_plugin.md says why
SHAPES: dict[str, tuple[dict[str, Any], set[str], set[str]]] = {
    "sphere": ({"center": [3, 1, 2], "radius": 0.5}, set(), set()),
    "rectangle": ({}, set(), OPEN),
    "disk": ({}, set(), OPEN),
    "cube": ({}, set(), set()),
    "cylinder": ({}, {"far"}, OPEN),
    "ellipsoidsmesh": (ELLIPSOIDS, {"watertight"}, {"scale"}),
    "mrt_plane": ({"normal": [0, 1, 0]}, set(), OPEN | {"scale"}),
}
for row in AXIAL:
    SHAPES[row.name] = ({**row.sample, "radius": 0.5, **MIRRORED}, {"far"}, set())


@pytest.mark.parametrize("name", but_slow(SHAPES, {"ellipsoidsmesh"}))
def test_stock_shapes_and_ours(name):
    parameters, known, senseless = SHAPES[name]
    if "to_world" in parameters:
        parameters = parameters | {"to_world": mi.ScalarTransform4f().scale(parameters["to_world"])}
    tensors = {key: mi.TensorXf(x) for key, x in parameters.items() if isinstance(x, np.ndarray)}
    check = mrt.check_shape({"type": name, **parameters, **tensors}, quick=True)
    assert set(check.failed) == known, str(check)
    assert {law.name for law in check.laws.values() if law.skipped} == senseless, str(check)
    assert list(check.laws) == list(LAWS)


@pytest.mark.parametrize("variant", ["scalar_rgb"], indirect=True)
def test_scalar_variant(variant):
    check = mrt.check_shape({"type": "sphere"}, quick=True)
    assert check.passed and not check.laws["variants"].skipped, str(check)


def met_slightly_off(si, ray):
    return put(si, t=1.0001 * si.t)


def met_off(si, ray):
    return put(si, t=1.001 * si.t)


def missed_in_some_directions(si, ray):
    return put(si, t=dr.select(ray.d.x > 0.99, dr.inf, si.t))


ELSEWHERE = {
    "scale.answer": missed_in_some_directions,
    "scale.off": met_slightly_off,
    "variants.answer": missed_in_some_directions,
    "variants.off": met_off,
}


@pytest.mark.parametrize("figure", ELSEWHERE)
def test_shapes_that_are_otherwise_elsewhere(figure, monkeypatch):
    """A sphere that is sound but where it is loaded again."""
    given = {"type": "sphere"}

    def scene(_, **more):
        return ChangedShape(given | more, ray_intersect=ELSEWHERE[figure])

    monkeypatch.setattr(ShapeCase, "scene", scene)
    assert exceeded(mrt.check_shape(given, quick=True, only=[figure.split(".")[0]])) == {figure}


def filled(made, vertices, faces):
    params = mi.traverse(made)
    params["vertex_positions"] = mi.Float(vertices)
    params["faces"] = mi.UInt32(np.ascontiguousarray(faces).ravel())
    params.update()
    return made


def scaled_along_x(matrix):
    return np.diag([matrix[0, 0], 1, 1, 1])


def not_turned(matrix):
    turned = matrix.copy()
    turned[:3, :3] = np.diag(np.linalg.norm(matrix[:3, :3], axis=0))
    return turned


@pytest.mark.parametrize("change", [scaled_along_x, not_turned])
def test_a_shape_that_ignores_to_world_fails(change):
    cube = mi.traverse(mi.load_dict({"type": "cube"}))

    class Deaf(mi.Mesh):
        def __init__(self, props):
            matrix = change(np.array(props.get("to_world", mi.ScalarTransform4f()).matrix))
            vertices = np.array(cube["vertex_positions"]).reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
            mi.Mesh.__init__(self, "deaf", len(vertices), len(cube["faces"]) // 3, props)
            filled(self, vertices.ravel(), np.array(cube["faces"]))

    mi.register_shape("deaf", Deaf)
    found = mrt.check_shape({"type": "deaf"}, quick=True, only=["scale", "hits"])
    assert found.failed == ["scale"], str(found)
    assert "and the ray with it" in found.laws["scale"].output


def test_snippets_are_programs(capsys):
    check = mrt.check_shape({"type": "cylinder"}, quick=True)
    for law in check.laws.values():
        for part in law.parts:
            if part.criterion != "reads":
                exec(compile(part.snippet, "snippet", "exec"), {})
                assert capsys.readouterr().out
