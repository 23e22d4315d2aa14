"""The study of cones: its bounds hold, and they would not for a wrong cone."""

from __future__ import annotations

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.validation.studies import objects
from mrt_mitsuba.validation.tools.study import Study, Table


@pytest.fixture(autouse=True)
def vectorised() -> None:
    problem = runtime.obstacle(runtime.FAST)
    if problem:
        pytest.skip(problem)


def run() -> Study:
    study = Study("objects", objects.TITLE)
    objects.run(study, quick=True)
    return study


def test_every_bound_holds() -> None:
    study = run()
    assert study.passed, [str(bound) for bound in study.bounds if not bound.holds]
    (table,) = (part for part in study.parts if isinstance(part, Table))
    errors = [float(row[2]) for row in table.rows]
    assert [row[0] for row in table.rows] == list(objects.SEGMENTS) and errors == sorted(errors, reverse=True)


def test_a_mesh_of_a_wider_cone_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """One part in a thousand: the error no longer falls with the sides."""
    right = objects.search
    wider = {"radius": 1.001 * objects.CONE["radius"]}
    monkeypatch.setattr(objects, "search", lambda cone, ray: right({**cone, **wider}, ray))
    failed = [bound.name for bound in run().bounds if not bound.holds]
    assert "slope of the error of a mesh cone: |exponent - 2|" in failed


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda depth: depth * 1.00001, "close"),
        (lambda depth: np.roll(depth, 1, axis=1), "astray"),
        (lambda depth: np.where(np.isinf(depth), 1e5, depth), "astray"),
    ],
)
def test_wrong_depths_are_rejected(change, fault: str) -> None:
    ours = mrt.render(9, width=160, height=120, aa=1, layers=["depth"]).layers["depth.Z"].copy()
    ours[:10] = np.inf  # as above a horizon
    assert objects.depth_errors(ours, ours.astype(float)) == objects.DepthErrors(1.0, 0.0)
    errors = objects.depth_errors(change(ours), ours.astype(float))
    assert errors.close < 0.995 if fault == "close" else errors.astray > 2e-4


def test_crowds_differ_in_kind_only() -> None:
    spheres, cones = objects.crowd(50)
    assert (len(spheres.spheres), len(spheres.cones), len(cones.spheres), len(cones.cones)) == (50, 0, 0, 50)
    for sphere, cone in zip(spheres.spheres, cones.cones, strict=True):
        ends = np.array([cone.apex, cone.base_center])
        np.testing.assert_allclose(ends.mean(axis=0), sphere.center)
        assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(2 * sphere.radius)
        assert (cone.radius, cone.material) == (sphere.radius, sphere.material)


def test_cones_are_compared_with_spheres() -> None:
    study = Study("objects", objects.TITLE)
    objects.compare_with_spheres(study, width=40, height=30, samples=(1,))
    (table,) = (part for part in study.parts if isinstance(part, Table))
    assert len(table.rows) == 1 and table.rows[0][3] > 0
