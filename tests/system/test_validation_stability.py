"""The stability study: it passes, and it misses its bounds once a formula or a renderer loses its care."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from cases import Cases

from mrt_mitsuba import filters
from mrt_mitsuba.plugins import fresnel, lobes, microfacet
from mrt_mitsuba.plugins.whitted import hit_errors
from mrt_mitsuba.validation.studies import stability
from mrt_mitsuba.validation.study import findings

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.slow
def test_every_case_holds_and_is_a_row_with_a_mark():
    whole = findings(stability.run, quick=True)
    assert whole.missed == set()
    assert len(whole.bounds) > 110
    axes = whole.tables.pop("roundings")  # has a bound for each axis
    titles = ["Reflectance", "Geometry", "Light transport", "Filters", "Finite and not negative"]
    assert [table["title"] for table in whole.tables.values()] == titles
    rows = [row for table in whole.tables.values() for row in table["rows"]]
    assert {row[-1] for row in rows} == {"ok", "cannot hold"}
    assert sum(row[-1] == "ok" for row in rows) == len(whole.bounds) - len(axes["rows"])
    # what cannot hold says why
    assert all(len(row[2]) > 30 for row in rows if row[-1] == "cannot hold")


beckmann_d = microfacet.Beckmann.d
blur = filters.gaussian_dof
density = lobes.Lobes.density
schlick = fresnel.fresnel_schlick
dielectric = fresnel.fresnel_dielectric


def report_tan2_theta(v: Any) -> Any:
    """From the cosine of the vector made one unit long, as in the report."""
    c2 = dr.square(dr.normalize(v).z)
    return (1 - c2) / c2


def rounded(cos_theta: Any, f0: Any) -> Any:
    return schlick(cos_theta + 8 - 8, f0)


def steep(cos_theta: Any, *iors: Any) -> Any:
    return dielectric(dr.sqrt(1 - dr.square(dr.sqrt(1 - dr.square(cos_theta)))), *iors)


def steep_gradient(self: Any, tan2_theta: Any, alpha: Any) -> Any:
    return beckmann_d(self, tan2_theta, dr.detach(alpha) + 1.0001 * (alpha - dr.detach(alpha)))


def spreading(image: Any, depth: Any, **options: Any) -> Any:
    out = np.array(blur(image, depth, **options))
    out[np.roll(np.isnan(out).any(axis=-1), 1, axis=0)] = np.nan
    return out


def dense(self: Any, context: Any, pair: Any) -> Any:
    """A density that is negative where the direction is almost horizontal."""
    return dr.select((pair.wo.z > 0) & (pair.wo.z < 2e-12), -1, density(self, context, pair))


losses = Cases()
Change = tuple[Any, str, Any]  # of a module, or a class: a name and what it becomes


def loss(name: str, part: str, *changes: Change, missed: list[str]) -> None:
    """Add changes that lose digits, and the bounds of a part of the study that they must miss."""
    losses(part, changes, missed, name=name, slow=part == "geometry" or name == "tan θ")


loss("tan θ", "bsdf", (microfacet, "tan2_theta", report_tan2_theta), missed=["D, largest"])
# with the report's form in the plugin alone, the whole misses its bounds
whole = ["BSDF cos, p99.9", "pdf, p99.9", "BSDF cos, largest"]
loss("tan θ in the plugin", "bsdf", (lobes, "tan2_theta", report_tan2_theta), missed=whole)
at_grazing = ["F, largest", "F at the critical angle"]
loss("Fresnel", "bsdf", (fresnel, "fresnel_dielectric", steep), missed=at_grazing)
loss("Schlick", "bsdf", (fresnel, "fresnel_schlick", rounded), missed=["Schlick, F0 = 0.04"])
by_itself = (microfacet.Beckmann, "d", steep_gradient)
loss("gradient", "bsdf", by_itself, missed=["gradient in alpha, p99.9"])
shadows = ["spheres, shadow rays", "cones, shadow rays"]
loss("offset", "geometry", (hit_errors, "CURVED", 0.0), missed=shadows)
damaged = [f"nan or inf in a picture, blur ({variant}_rgb)" for variant in ("llvm_ad", "scalar")]
loss("damage", "filters", (filters, "gaussian_dof", spreading), missed=damaged)
behind = (lobes, "COS_MIN", 1e-13)
negative = ["mrt_bsdf, schlick, visible normals"]
loss("negative", "finite", (lobes.Lobes, "density", dense), behind, missed=negative)


@pytest.mark.parametrize(("part", "changes", "expected"), losses)
def test_a_loss_of_care_misses_its_bounds(monkeypatch, part, changes, expected):
    for place, name, value in changes:
        monkeypatch.setattr(place, name, value)
    monkeypatch.setattr(stability, "PARTS", {part: stability.PARTS[part]})
    monkeypatch.setattr(stability.curves, "AXES", ())
    missed = findings(stability.run, quick=True).missed
    assert {f"{stability.PARTS[part][0]}: {name}" for name in expected} <= missed
