"""``check_shape``: sound shapes pass, each mistake fails its own laws."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.checks.shape import LAWS
from mrt_mitsuba.validation.studies.power import ChangedShape, moved, tilted

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


def half(box: Any) -> Any:
    return mi.BoundingBox3f(0.5 * box.min, 0.5 * box.max)


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
    return {"hit": moved(t=lambda si, ray: dr.select(where(si, ray), value, si.t))}


MISTAKES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "none": ({}, set()),
    "flipped normal": ({"hit": flipped}, {"normals"}),
    "normal of another length": ({"hit": moved(n=lambda si, ray: 1.01 * si.n)}, {"normals"}),
    "tilted normal": ({"hit": moved(n=lambda si, ray: tilted(si.n, 0.15))}, {"normals"}),
    "wrong derivative": ({"hit": moved(dp_du=lambda si, ray: 1.5 * si.dp_du)}, {"normals"}),
    "normal towards the ray": ({"hit": facing}, {"normals"}),
    # ray_test knows nothing of these two
    "met from outside only": (lost(lambda si, ray: dr.dot(si.n, ray.d) > 0), {"hits", "watertight"}),
    "a fixed least distance": (lost(lambda si, ray: si.t < 0.02), {"hits", "surface", "watertight"}),
    "a box that is too small": ({"bbox": half}, {"bbox"}),
    "ray_test unlike ray_intersect": ({"test": lambda found, ray: found & (ray.d.x < 0.7)}, {"hits"}),
    "ray_test blind from near by": (
        {"test": lambda found, ray: found & (dr.max(abs(ray.o)) > 1.5)},
        {"hits"},
    ),
    "NaN for a distance along an axis": (
        lost(lambda si, ray: (ray.d.x == 0) & (ray.d.y == 0), dr.nan),
        {"finite"},
    ),
    "maxt ignored": ({"hit": deaf_to_its_limit, "test": lambda found, ray: found | (ray.maxt < 0)}, {"hits"}),
    "hit point below the surface": ({"hit": moved(p=lambda si, ray: si.p - 2e-3 * si.n)}, {"surface"}),
    "NaN along an axis": (
        {"hit": moved(uv=lambda si, ray: dr.select(ray.d.x == 0, dr.nan, si.uv))},
        {"finite"},
    ),
    "digits lost": ({"hit": rounded}, {"surface", "normals"}),  # differences of hit points suffer as well
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_fails_its_own_laws(mistake: str) -> None:
    changes, laws = MISTAKES[mistake]
    check = mrt.check_shape(ChangedShape(**changes), quick=True, only=set(LAWS) - {"sampling"})
    assert set(check.failed) == laws, str(check)
    assert "loaded object" in check.laws["scale"].skipped


TOO_FAR = moved(t=lambda si, ray: si.t + 1e-5, p=lambda si, ray: si.p + 1e-5 * ray.d)


@pytest.mark.parametrize(
    ("changes", "failed"),
    [
        ({"area": 1.02}, ["sampling"]),
        ({"first": 1.03, "given": {"type": "rectangle"}}, ["sampling"]),
        ({"hit": moved(shading=lambda si, ray: tilted(si.sh_frame.n, 0.01))}, ["normals"]),
        ({"hit": moved(p=lambda si, ray: si.p + 1e-5 * si.n)}, ["surface"]),
        ({"hit": TOO_FAR}, ["surface"]),
        ({}, []),
    ],
    ids=["area", "crowded", "shading", "point", "distance", "none"],
)
def test_small_faults_are_found_in_full(changes: dict[str, Any], failed: list[str]) -> None:
    only = failed or ["sampling", "normals", "surface"]
    assert mrt.check_shape(ChangedShape(**changes), only=only).failed == failed


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


def test_snippets_are_programs(capsys, tmp_path: Path) -> None:
    check = mrt.check_shape({"type": "cylinder"}, quick=True)
    for law in check.laws.values():
        for part in law.parts:
            exec(compile(part.snippet, "snippet", "exec"), {})
            assert capsys.readouterr().out
    check.save(tmp_path)
    assert "far" in (tmp_path / "index.html").read_text()


def test_wrong_usage() -> None:
    with pytest.raises(mrt.SceneError, match=r'cannot load the mrt_cone: .*"apex" is missing'):
        mrt.check_shape({"type": "mrt_cone"})
    with pytest.raises(mrt.UsageError, match="is not a shape"):
        mrt.check_shape(mi.load_dict({"type": "diffuse"}))
