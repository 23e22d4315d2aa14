"""The stability study: it passes, and it misses its bounds once a formula or a renderer loses its care."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mrt_mitsuba import filters as mrt_filters
from mrt_mitsuba import plugins
from mrt_mitsuba.plugins import fresnel, intersect, microfacet
from mrt_mitsuba.validation.studies import stability
from mrt_mitsuba.validation.studies.stability import (
    bsdf,
    cases,
    filters,
    finite,
    formulas,
    geometry,
    shapes,
    transport,
)
from mrt_mitsuba.validation.tools.study import Plot, Study, Table

pytestmark = pytest.mark.usefixtures("variant")


def run(part: ModuleType) -> Study:
    study = Study("stability", stability.TITLE)
    part.run(study, quick=True)
    return study


def missed(study: Study) -> set[str]:
    return {bound.name for bound in study.bounds if not bound.holds}


@pytest.fixture(scope="module")
def whole() -> Iterator[Study]:
    from mrt_mitsuba import runtime

    runtime.use(runtime.FAST)
    yield run(stability)


# ----------------------------------------------- The study ------------------------------------------------


def test_every_bound_holds(whole: Study) -> None:
    assert missed(whole) == set()
    assert len(whole.bounds) > 200


def test_every_case_is_a_row_with_a_mark(whole: Study) -> None:
    tables = [p for p in whole.parts if isinstance(p, Table) and tuple(p.columns) == cases.COLUMNS]
    assert [t.title for t in tables] == [
        "Reflectance",
        "Geometry",
        "Light transport",
        "Filters",
        "Finite and not negative",
    ]
    rows = [row for table in tables for row in table.rows]
    assert {row[-1] for row in rows} == {"ok", "cannot hold"}
    assert sum(row[-1] == "ok" for row in rows) == len(whole.bounds)
    # what cannot hold says why
    assert all(len(row[2]) > 30 for row in rows if row[-1] == "cannot hold")


def test_there_are_heat_maps_of_three_formulas(whole: Study) -> None:
    plots = [p for p in whole.parts if isinstance(p, Plot)]
    assert {p.name for p in plots} == {
        "bsdf-cosine",
        "bsdf-steepness",
        "fresnel",
    }
    for plot in plots:
        titles = [panel.get_title() for panel in plot.figure.axes[:3]]
        assert titles == ["report", "roughconductor", "mrt_bsdf"]


def test_worst_cases_can_be_read_back(whole: Study) -> None:
    """The hexadecimal inputs of the worst D give the error of the table."""
    table = next(p for p in whole.parts if isinstance(p, Table) and p.name == "bsdf-worst")
    title, error, steepness, inputs = table.rows[0]
    numbers = [float.fromhex(word) for word in re.findall(r"-?0x[0-9a-f.]+p[+-]\d+", inputs)]
    assert title == "D" and len(numbers) == 8
    wi, wo, (alpha, ior) = np.array(numbers[:3]), np.array(numbers[3:6]), numbers[6:]
    h = wi + wo
    tan2 = (h[0] ** 2 + h[1] ** 2) / h[2] ** 2
    assert tan2 / alpha**2 == pytest.approx(steepness, rel=1e-12)
    terms = formulas.Ours().terms(
        *(mi.Vector3f(v.tolist()) for v in (wi, wo)), mi.Float(alpha), mi.Float(ior)
    )
    assert abs(terms.d[0] / microfacet.beckmann_d(tan2, alpha) - 1) == pytest.approx(error, rel=1e-4)


# ------------------------------------ What must not go unnoticed ------------------------------------------


@pytest.mark.parametrize(
    ("name", "formula", "expected"),
    [
        ("tan2_theta", formulas.report_tan2_theta, "D"),
        ("tan2_theta", formulas.report_tan2_theta, "BSDF cos"),
        ("fresnel_dielectric", formulas.report_fresnel, "F"),
    ],
)
def test_the_formulas_of_the_report_miss_the_bounds(
    monkeypatch: pytest.MonkeyPatch, name: str, formula: Callable[..., Any], expected: str
) -> None:
    """Put in place of ours, in the functions and in the plugin."""
    for module in (microfacet, fresnel, plugins.plugin("bsdf")):
        if hasattr(module, name):
            monkeypatch.setattr(module, name, formula)
    found = missed(run(bsdf))
    assert f"Reflectance: {expected}, largest" in found
    assert f"Reflectance: {expected}, cells worse than roughconductor" in found or expected == "BSDF cos"


def test_the_plugin_itself_is_what_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the report's form in the plugin alone, the whole misses its bounds, the functions do not."""
    monkeypatch.setattr(plugins.plugin("bsdf"), "tan2_theta", formulas.report_tan2_theta)
    found = missed(run(bsdf))
    assert {
        "Reflectance: BSDF cos, p99.9",
        "Reflectance: pdf, p99.9",
        "Reflectance: gradient in alpha, p99.9",
    } <= found
    assert "Reflectance: D, p99.9" not in found


def test_a_slightly_wrong_gradient_misses_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    d = microfacet.beckmann_d
    monkeypatch.setattr(
        microfacet, "beckmann_d", lambda t, a: d(t, dr.detach(a) + 1.0001 * (a - dr.detach(a)))
    )
    assert "Reflectance: gradient in alpha, p99.9" in missed(run(bsdf))


def _textbook_roots(a: Any, half_b: Any, c: Any, discriminant: Any) -> tuple[Any, Any]:
    """The quadratic formula as school teaches it."""
    root = dr.sqrt(dr.maximum(half_b * half_b - a * c, 0))
    return (-half_b - root) / a, (root - half_b) / a


def test_textbook_quadratics_miss_the_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intersect, "_roots", _textbook_roots)
    study = Study("x", "x")
    table = cases.Cases(study, "x", "Geometry")
    shapes.shape_cases(table, [], quick=True)
    table.close()
    assert any(name.startswith("Geometry: c") for name in missed(study))  # cone or cylinder


def test_an_absolute_offset_is_no_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    """The original's constant 1e-4 in place of one relative to the coordinates."""
    prepared = plugins.plugin("whitted").Prepared

    def off_surface(hit: Any, d: Any) -> Any:
        return hit.si.p + d * 1e-4

    monkeypatch.setattr(prepared, "_off_surface", staticmethod(off_surface))
    found = missed(run(geometry))
    assert {
        "Geometry: sphere, shadow rays",
        "Geometry: scene 0 times 1e-06",
        "Geometry: scene 3 times 1e-06",
    } <= found


def test_a_lost_bounce_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    whitted = plugins.plugin("whitted").MrtWhitted
    continues = whitted._continues
    monkeypatch.setattr(whitted, "_continues", lambda self, p, t, depth: continues(self, p, t, depth + 1))
    found = missed(run(transport))
    assert "Light transport: facing mirrors" in found
    assert "Light transport: one to ten bounces, Ks 0.999, clamp on" in found


def test_damage_that_spreads_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def spreading(image: Any, depth: Any, **options: Any) -> Any:
        out = np.array(blur(image, depth, **options))
        bad = np.isnan(out).any(axis=-1)
        out[np.roll(bad, 1, axis=0)] = np.nan
        return out

    blur = mrt_filters.gaussian_dof
    monkeypatch.setattr(mrt_filters, "gaussian_dof", spreading)
    found = missed(run(filters))
    assert {"Filters: NaN in a picture, blur", "Filters: focal distance 0"} <= found


def test_one_bad_value_in_a_million_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A density that is negative where the direction is almost horizontal, and a refusal that is none."""
    plugin = plugins.plugin("bsdf")
    density = plugin.MrtBSDF._density

    def negative(self: Any, context: Any, point: Any, pair: Any) -> Any:
        return dr.select((pair.wo.z > 0) & (pair.wo.z < 2e-12), -1, density(self, context, point, pair))

    monkeypatch.setattr(plugin.MrtBSDF, "_density", negative)
    monkeypatch.setattr(plugin, "COS_MIN", 1e-13)
    monkeypatch.setattr(finite, "REFUSED", [({"type": "mrt_bsdf"}, "alpha", (0.5,))])
    found = missed(run(finite))
    assert {"Finite and not negative: mrt_bsdf, schlick", "Finite and not negative: mrt_bsdf, alpha"} <= found
