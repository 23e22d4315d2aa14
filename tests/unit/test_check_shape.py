"""``check_shape``: sound shapes pass, each mistake fails its own laws."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from unit.specimens import exceeded

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.checks.shape import LAWS, Case
from mrt_mitsuba.validation.studies import power
from mrt_mitsuba.validation.studies.power import ChangedShape, put

pytestmark = pytest.mark.usefixtures("variant")

OPEN = {"watertight"}
MIRRORED = {"to_world": [1, -1, 1]}
CONE = {"apex": [0, 1, 0], "base_center": [0, 0, 0], "radius": 0.5, **MIRRORED}
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
    "mrt_cone": (CONE, {"far"}, set()),
    "mrt_cylinder": ({"p0": [0, 1, 0], "p1": [0, 0, 0], "radius": 0.5, **MIRRORED}, {"far"}, set()),
}


@pytest.mark.parametrize("name", SHAPES)
def test_stock_shapes_and_ours(name: str) -> None:
    parameters, known, senseless = SHAPES[name]
    if "to_world" in parameters:
        parameters = parameters | {"to_world": mi.ScalarTransform4f().scale(parameters["to_world"])}
    tensors = {key: mi.TensorXf(x) for key, x in parameters.items() if isinstance(x, np.ndarray)}
    check = mrt.check_shape({"type": name, **parameters, **tensors}, quick=True)
    assert set(check.failed) == known, str(check)
    assert {law.name for law in check.laws.values() if law.skipped} == senseless, str(check)
    assert list(check.laws) == list(LAWS)


@pytest.mark.parametrize("variant", ["scalar_rgb"], indirect=True)
def test_scalar_variant(variant: str) -> None:
    check = mrt.check_shape({"type": "sphere"}, quick=True)
    assert check.passed and not check.laws["variants"].skipped, str(check)


def flipped(si: Any, ray: Any) -> Any:
    si.n, si.sh_frame.n = -si.n, -si.sh_frame.n
    return si


def deaf_to_its_limit(si: Any, ray: Any) -> Any:
    return ChangedShape().ray_intersect(mi.Ray3f(ray.o, ray.d))


def rounded(si: Any, ray: Any) -> Any:
    """A distance as the difference of two large numbers."""
    si.t = (1000 + si.t) - 1000
    si.p = ray(si.t)
    return si


def facing(si: Any, ray: Any) -> Any:
    """Normals that are the ray's doing."""
    side = dr.select(dr.dot(si.n, ray.d) > 0, mi.Float(-1), 1)
    si.n, si.sh_frame.n = side * si.n, side * si.sh_frame.n
    return si


def lost(where: Callable[[Any, Any], Any], value: float = dr.inf) -> dict[str, Any]:
    """Hits that are missed in some places."""
    return {"ray_intersect": lambda si, ray: put(si, t=dr.select(where(si, ray), value, si.t))}


MISTAKES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "none": ({}, set()),
    "flipped normal": ({"ray_intersect": flipped}, {"normals.outwards"}),
    "normal towards the ray": ({"ray_intersect": facing}, {"normals.turned"}),
    "shading normal on the other side": (
        {"ray_intersect": lambda si, ray: put(si, sh_frame=mi.Frame3f(-si.n))},
        {"normals.side", "normals.shading"}),
    # ray_test knows nothing of these two
    "met from outside only": (lost(lambda si, ray: dr.dot(si.n, ray.d) > 0),
                              {"hits.ray_test", "watertight.blind"}),
    "a fixed least distance": (lost(lambda si, ray: si.t < 0.02),
                               {"hits.ray_test", "surface.missed", "watertight.blind"}),
    "ray_test blind from near by": ({"ray_test": lambda found, ray: found & (dr.max(abs(ray.o)) > 1.5)},
                                    {"hits.ray_test"}),
    "NaN for a distance along an axis": (lost(lambda si, ray: (ray.d.x == 0) & (ray.d.y == 0), dr.nan),
                                         {"finite.bad"}),
    "maxt ignored": (
        {"ray_intersect": deaf_to_its_limit, "ray_test": lambda found, ray: found | (ray.maxt < 0)},
        {"hits.ray_intersect"}),
    "hit point below the surface": ({"ray_intersect": lambda si, ray: put(si, p=si.p - 2e-3 * si.n)},
                                    {"surface.on_ray", "surface.near_by", "surface.again", "surface.missed"}),
    # differences of hit points suffer as well
    "digits lost": ({"ray_intersect": rounded},
                    {"surface.behind", "surface.noise", "normals.slope", "normals.step"}),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_exceeds_its_own_figures(mistake: str) -> None:
    changes, figures = MISTAKES[mistake]
    check = mrt.check_shape(ChangedShape(**changes), quick=True, only=set(LAWS) - {"sampling"})
    assert exceeded(check) == figures, str(check)
    assert "loaded object" in check.laws["scale"].skipped


def test_small_faults_are_found_in_full() -> None:
    spread = next(fault for fault in power.FAULTS if fault.figure == "sampling.spread")
    assert spread.check(0.03, quick=False).failed == ["sampling"]
    sound = ChangedShape({"type": "rectangle"})
    assert mrt.check_shape(sound, only=["sampling", "normals", "surface"]).passed


ELSEWHERE: dict[str, dict[str, Any]] = {
    "scale.answer": lost(lambda si, ray: ray.d.x > 0.99),
    "scale.off": {"ray_intersect": lambda si, ray: put(si, t=1.0001 * si.t)},
    "variants.answer": lost(lambda si, ray: ray.d.x > 0.99),
    "variants.distance": {"ray_intersect": lambda si, ray: put(si, t=1.001 * si.t)},
}


@pytest.mark.parametrize("figure", ELSEWHERE)
def test_shapes_that_are_otherwise_elsewhere(figure: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sphere that is sound but where it is loaded again."""
    given = {"type": "sphere"}
    monkeypatch.setattr(Case, "scene", lambda _, **more: ChangedShape(given | more, **ELSEWHERE[figure]))
    assert exceeded(mrt.check_shape(given, quick=True, only=[figure.split(".")[0]])) == {figure}


def test_each_figure_has_a_specimen() -> None:
    known = set().union(*(figures for _, figures in MISTAKES.values()))
    known |= {fault.figure for fault in power.FAULTS if fault.kind == "shape"}
    known.update(ELSEWHERE)
    assert known == {f"{name}.{figure}" for name, law in LAWS.items() for figure in vars(law)["figures"]}


def mesh(change: Callable[[np.ndarray], np.ndarray]) -> mi.Mesh:
    """A cube of triangles, its faces changed."""
    params = mi.traverse(mi.load_dict({"type": "cube"}))
    faces = change(np.array(params["faces"]).reshape(-1, 3))
    made = mi.Mesh("cube", len(params["vertex_positions"]) // 3, len(faces))
    filled = mi.traverse(made)
    filled["vertex_positions"] = mi.Float(params["vertex_positions"])
    filled["faces"] = mi.UInt32(np.ascontiguousarray(faces).ravel())
    filled.update()
    return made


@pytest.mark.parametrize(
    ("change", "laws"),
    [
        (lambda faces: faces, set()),
        (lambda faces: faces[:, ::-1], {"normals"}),
        (lambda faces: faces[1:], {"watertight"}),
    ],
    ids=["sound", "turned inside out", "a face missing"],
)
def test_meshes(change: Callable[[np.ndarray], np.ndarray], laws: set[str]) -> None:
    check = mrt.check_shape(mesh(change), quick=True)
    assert set(check.failed) == laws, str(check)


def test_snippets_are_programs(capsys) -> None:
    check = mrt.check_shape({"type": "cylinder"}, quick=True)
    for law in check.laws.values():
        for part in law.parts:
            exec(compile(part.snippet, "snippet", "exec"), {})
            assert capsys.readouterr().out
