"""The study of cones: its bounds hold, and they would not for a wrong cone."""

from __future__ import annotations

import numpy as np
import pytest

from mrt_mitsuba.validation.studies import objects
from mrt_mitsuba.validation.tools.study import findings


def test_every_bound_holds(variant) -> None:
    study = findings(objects.run, quick=True)
    assert study.passed, study.missed
    (table,) = study.tables.values()
    errors = [row[2] for row in table.rows]
    assert [row[0] for row in table.rows] == list(objects.SEGMENTS) and errors == sorted(errors, reverse=True)


@pytest.mark.parametrize(
    ("wrong", "bound"),
    [({"radius": 1.001 * objects.CONE["radius"]}, "slope"), ({"segments": 128}, "mean error"),
     ({"capped": False}, "another part")],
)  # fmt: skip
def test_a_wrong_mesh_is_rejected(wrong, bound, variant, monkeypatch: pytest.MonkeyPatch) -> None:
    right = objects.search
    monkeypatch.setattr(objects, "search", lambda cone, ray: right({**cone, **wrong}, ray))
    assert any(bound in name for name in findings(objects.run, quick=True).missed)


def test_cones_are_compared_with_spheres_of_their_size(variant) -> None:
    spheres, cones = objects.crowd(50)
    assert (len(spheres.spheres), len(spheres.cones), len(cones.spheres), len(cones.cones)) == (50, 0, 0, 50)
    for sphere, cone in zip(spheres.spheres, cones.cones, strict=True):
        ends = np.array([cone.apex, cone.base_center])
        np.testing.assert_allclose(ends.mean(axis=0), sphere.center)
        assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(2 * sphere.radius)
        assert (cone.radius, cone.material) == (sphere.radius, sphere.material)
    found = findings(objects.compare_with_spheres, width=40, height=30, samples=(1,))
    (table,) = found.tables.values()
    assert len(table.rows) == 1 and table.rows[0][3] > 0
