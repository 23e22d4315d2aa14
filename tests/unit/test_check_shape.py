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
from mrt_mitsuba.validation.studies.power import ChangedShape

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


# ----------------------------------------------- Mistakes -------------------------------------------------


class Wrapped:
    """A cube whose answers are changed."""

    def __init__(self, **changes: Callable[..., Any]) -> None:
        self.scene = mi.load_dict({"type": "scene", "shape": {"type": "cube"}})
        self.changes = changes

    def ray_intersect(self, ray: Any) -> Any:
        si = self.scene.ray_intersect(ray)
        return self.changes["hit"](si, ray) if "hit" in self.changes else si

    def ray_test(self, ray: Any) -> Any:
        return self.changes.get("test", lambda found, ray: found)(self.scene.ray_test(ray), ray)

    def bbox(self) -> Any:
        return self.changes.get("bbox", lambda box: box)(self.scene.bbox())


def changed(**values: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    def change(si: Any, ray: Any) -> Any:
        for name, value in values.items():
            setattr(si, name, value(si))
        return si

    return change


def flipped(si: Any, ray: Any) -> Any:
    si.n, si.sh_frame.n = -si.n, -si.sh_frame.n
    return si


def deaf_to_its_limit(si: Any, ray: Any) -> Any:
    return Wrapped().scene.ray_intersect(mi.Ray3f(ray.o, ray.d))


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


def nan_along_z(si: Any, ray: Any) -> Any:
    si.t = dr.select((ray.d.x == 0) & (ray.d.y == 0), dr.nan, si.t)
    return si


def from_outside(si: Any, ray: Any) -> Any:
    si.t = dr.select(dr.dot(si.n, ray.d) > 0, dr.inf, si.t)
    return si


def not_near(si: Any, ray: Any) -> Any:
    """Hits are lost within a fixed distance."""
    si.t = dr.select(si.t < 0.02, dr.inf, si.t)
    return si


MISTAKES: dict[str, tuple[dict[str, Callable[..., Any]], set[str]]] = {
    "none": ({}, set()),
    "flipped normal": ({"hit": flipped}, {"normals"}),
    "normal of another length": ({"hit": changed(n=lambda si: 1.01 * si.n)}, {"normals"}),
    "tilted normal": (
        {"hit": changed(n=lambda si: dr.normalize(si.n + mi.Normal3f(0.1, 0.05, -0.1)))},
        {"normals"},
    ),
    "wrong derivative": ({"hit": changed(dp_du=lambda si: 1.5 * si.dp_du)}, {"normals"}),
    "normal towards the ray": ({"hit": facing}, {"normals"}),
    # of which ray_test knows nothing
    "met from outside only": ({"hit": from_outside}, {"hits", "watertight"}),
    "a fixed least distance": ({"hit": not_near}, {"hits", "surface", "watertight"}),
    "a box that is too small": ({"bbox": half}, {"bbox"}),
    "ray_test unlike ray_intersect": ({"test": lambda found, ray: found & (ray.d.x < 0.7)}, {"hits"}),
    "ray_test blind from near by": (
        {"test": lambda found, ray: found & (dr.max(abs(ray.o)) > 1.5)},
        {"hits"},
    ),
    "NaN for a distance along an axis": ({"hit": nan_along_z}, {"finite"}),
    "maxt ignored": ({"hit": deaf_to_its_limit, "test": lambda found, ray: found | (ray.maxt < 0)}, {"hits"}),
    "hit point below the surface": ({"hit": changed(p=lambda si: si.p - 2e-3 * si.n)}, {"surface"}),
    "NaN along an axis": (
        {"hit": lambda si, ray: changed(uv=lambda si: dr.select(ray.d.x == 0, dr.nan, si.uv))(si, ray)},
        {"finite"},
    ),
    "digits lost": ({"hit": rounded}, {"surface", "normals"}),  # differences of hit points suffer as well
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_fails_its_own_laws(mistake: str) -> None:
    changes, laws = MISTAKES[mistake]
    check = mrt.check_shape(Wrapped(**changes), quick=True)
    assert set(check.failed) == laws, str(check)
    assert "loaded object" in check.laws["scale"].skipped


def tilted(si: Any, ray: Any) -> Any:
    si.sh_frame.n = dr.normalize(si.sh_frame.n + mi.Normal3f(0.006, 0.005, 0.006))
    return si


def too_far(si: Any, ray: Any) -> Any:
    si.t, si.p = si.t + 1e-5, si.p + 1e-5 * ray.d
    return si


@pytest.mark.parametrize(
    ("changes", "law"),
    [
        ({}, None),
        ({"area": 1.02}, "sampling"),
        ({"first": 1.03, "given": {"type": "rectangle"}}, "sampling"),
        ({"hit": tilted}, "normals"),
        ({"hit": changed(p=lambda si: si.p + 1e-5 * si.n)}, "surface"),
        ({"hit": too_far}, "surface"),
    ],
    ids=["none", "area", "crowded", "shading", "point", "distance"],
)
def test_small_faults_are_found_in_full(changes: dict[str, Any], law: str | None) -> None:
    only = [law] if law else ["sampling", "normals", "surface"]
    assert mrt.check_shape(ChangedShape(**changes), only=only).failed == ([law] if law else [])


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
