"""``check_shape``: sound shapes pass, each mistake fails its own laws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import but_slow
from nodes import AXIAL
from unit.specimens import exceeded

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.laws.faults import put
from mrt_mitsuba.validation.laws.shape import LAWS
from mrt_mitsuba.validation.laws.shape_case import ShapeCase
from mrt_mitsuba.validation.studies import power
from mrt_mitsuba.validation.studies.power import ChangedShape

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


def deaf_to_its_limit(si, ray):
    return ChangedShape().ray_intersect(mi.Ray3f(ray.o, ray.d))


def deaf_test(found, ray):
    return found | (ray.maxt < 0)


def rounded(si, ray):
    """A distance as the difference of two large numbers."""
    si.t = (1000 + si.t) - 1000
    si.p = ray(si.t)
    return si


def facing(si, ray):
    """Normals that are the ray's doing."""
    side = dr.select(dr.dot(si.n, ray.d) > 0, mi.Float(-1), 1)
    si.n = side * si.n
    si.sh_frame.n = side * si.sh_frame.n
    return si


def shaded_from_below(si, ray):
    return put(si, sh_frame=mi.Frame3f(-si.n))


def below(si, ray):
    return put(si, p=si.p - 2e-3 * si.n)


def met_slightly_off(si, ray):
    return put(si, t=1.0001 * si.t)


def met_off(si, ray):
    return put(si, t=1.001 * si.t)


def lost(where, value=dr.inf):
    """Hits that are missed in some places."""

    def change(si, ray):
        return put(si, t=dr.select(where(si, ray), value, si.t))

    return change


def from_inside(si, ray):
    return dr.dot(si.n, ray.d) > 0


def in_some_directions(si, ray):
    return ray.d.x > 0.99


def beyond_a_table(si, ray):
    index = dr.select(ray.d.x == 0, mi.UInt32(9), 0)
    return put(si, uv=si.uv * dr.gather(mi.Float, mi.Float(1, 1), index))


@dataclass
class Mistake:
    """Changes of the methods of a cube, and the figures that exceed their limits."""

    figures: set[str]
    changes: dict[str, Callable]


def hits_changed(change, *figures):
    return Mistake(set(figures), {"ray_intersect": change})


MISTAKES = {
    "none": Mistake(set(), {}),
    "normal towards the ray": hits_changed(facing, "normals.turned"),
    "shading normal on the other side": hits_changed(shaded_from_below, "normals.side", "normals.shading"),
    # ray_test knows nothing of it
    "met from outside only": hits_changed(lost(from_inside), "hits.ray_test", "watertight.blind"),
    "a read beyond a table": hits_changed(beyond_a_table, "finite.reads"),
    "maxt ignored": Mistake(
        {"hits.ray_intersect"}, {"ray_intersect": deaf_to_its_limit, "ray_test": deaf_test}
    ),
    "hit point below the surface": hits_changed(
        below, "surface.on_ray", "surface.near_by", "surface.again", "surface.missed"
    ),
    # differences of hit points suffer as well
    "digits lost": hits_changed(rounded, "surface.behind", "surface.noise", "normals.slope", "normals.step"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_exceeds_its_own_figures(mistake):
    cube = ChangedShape(**MISTAKES[mistake].changes)
    check = mrt.check_shape(cube, quick=True, only=set(LAWS) - {"sampling"})
    assert exceeded(check) == MISTAKES[mistake].figures, str(check)
    assert "loaded object" in check.laws["scale"].skipped


ELSEWHERE = {
    "scale.answer": lost(in_some_directions),
    "scale.off": met_slightly_off,
    "variants.answer": lost(in_some_directions),
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


def test_each_figure_has_a_specimen():
    known = set().union(*(mistake.figures for mistake in MISTAKES.values()))
    known |= {f"{fault.law}.{fault.criterion}" for fault in power.KINDS["shape"].faults}
    known.update(ELSEWHERE)
    assert known == {f"{name}.{figure}" for name, law in LAWS.items() for figure in law.criteria}


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
    assert "turned, moved" in found.laws["scale"].output


def test_snippets_are_programs(capsys):
    check = mrt.check_shape({"type": "cylinder"}, quick=True)
    for law in check.laws.values():
        for part in law.parts:
            if part.criterion != "reads":
                exec(compile(part.snippet, "snippet", "exec"), {})
                assert capsys.readouterr().out
