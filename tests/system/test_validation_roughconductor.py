"""The comparison with ``roughconductor`` and the laws of the BSDF: they pass, and mistakes make them fail."""

from __future__ import annotations

import functools
import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba import plugins
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.plugins import lobes
from mrt_mitsuba.validation import cli
from mrt_mitsuba.validation.studies import bsdf_laws, metals, roughconductor
from mrt_mitsuba.validation.tools.study import findings

for needed in cli.EXTRAS:
    pytest.importorskip(needed)

pytestmark = pytest.mark.usefixtures("variant")

Break = Callable[[pytest.MonkeyPatch], None]
SMALL: dict[str, Any] = {"size": 32, "spp": 8, "renders": 32, "pairs": 2000}


# ------------------------------ Mistakes made on purpose ------------------------------


Lobes = lobes.Lobes
value, alpha, fresnel_of = Lobes.value, Lobes.alpha.func, Lobes.fresnel


def radiance(patch: pytest.MonkeyPatch) -> None:
    """× 1.02 of every value."""
    patch.setattr(Lobes, "value", lambda *arguments: 1.02 * value(*arguments))


def roughness(patch: pytest.MonkeyPatch) -> None:
    """× 1.05."""
    patch.setattr(Lobes, "alpha", property(lambda self: 1.05 * alpha(self)))


def fresnel(patch: pytest.MonkeyPatch) -> None:
    """Schlick where the exact form was asked for."""

    def schlick(self: Any, *angle: Any) -> Any:
        form, self.form = self.form, {"dielectric": "schlick"}.get(self.form, self.form)
        try:
            return fresnel_of(self, *angle)
        finally:
            self.form = form

    patch.setattr(Lobes, "fresnel", schlick)


def flipped(patch: pytest.MonkeyPatch) -> None:
    """The normal points to the other side."""
    kind = plugins.plugin("bsdf").MrtBSDF
    for name in ("eval", "pdf", "eval_pdf"):
        method = getattr(kind, name)

        @functools.wraps(method)
        def other(self: Any, ctx: Any, si: Any, wo: Any, active: Any = True, method: Any = method) -> Any:
            turned = type(si)(si)
            turned.wi = -si.wi
            return method(self, ctx, turned, -wo, active)

        patch.setattr(kind, name, other)


def clamp(patch: pytest.MonkeyPatch) -> None:
    """Values of a negative roughness are left negative."""
    arrays = types.ModuleType("drjit")
    arrays.__dict__.update(vars(dr), maximum=lambda value, least: value)
    patch.setattr(lobes, "dr", arrays)


MISTAKES = (radiance, roughness, fresnel, flipped, clamp)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_command_fails_where_the_bsdf_is_broken(mistake: Break, monkeypatch, tmp_path: Path, capsys) -> None:
    mistake(monkeypatch)
    # what divides by a density of zero is the mistake's doing, and shall not break off the study
    with np.errstate(all="ignore"):
        assert cli.main(["laws", "--quick", "--out", str(tmp_path)]) == 1
    laws = json.loads((tmp_path / "summary.json").read_text())["studies"]["laws"]
    assert laws["verdict"] == "missed", laws["failure"]
    assert "MISSED" in capsys.readouterr().out


@pytest.mark.slow
def test_command_passes(tmp_path: Path) -> None:
    assert cli.main(["laws", "roughconductor", "--quick", "--out", str(tmp_path)]) == 0


@pytest.mark.parametrize("mistake", [radiance, roughness, flipped])
def test_values_are_not_roughconductors_where_the_bsdf_is_broken(mistake: Break, monkeypatch) -> None:
    monkeypatch.setattr(roughconductor.runtime, "usable_variants", lambda: ["llvm_ad_rgb"])
    assert not findings(roughconductor.pointwise, quick=True).missed
    mistake(monkeypatch)
    assert any(name.startswith("value") for name in findings(roughconductor.pointwise, quick=True).missed)


@pytest.mark.parametrize(
    ("mistake", "part", "names"),
    [
        (
            fresnel,
            bsdf_laws.dielectric_terms,
            {"F against Mitsuba's, relative", "reflection against Mitsuba's, relative"},
        ),
        (fresnel, bsdf_laws.published, {"published albedos, relative"}),
        (radiance, bsdf_laws.published, {"published albedos, relative"}),
        (clamp, bsdf_laws.never_negative, {"least value of any lobe, negative roughness included"}),
    ],
)
def test_the_law_that_is_broken_is_named(mistake: Break, part, names: set[str], monkeypatch) -> None:
    mistake(monkeypatch)
    assert findings(part, quick=True).missed == names


# ------------------------------ compare_roughconductor ------------------------------


def test_comparison_finds_them_equal(tmp_path: Path) -> None:
    found = mrt.compare_roughconductor(alpha=0.2, **SMALL)
    assert found.equal and not found.test.rejects
    assert 0 < found.errors["value"] < 2e-5
    assert found.errors["pixels that differ, with the same random numbers"] < 5e-3
    assert found.timings["ratio"] == pytest.approx(found.timings["ours"] / found.timings["theirs"])
    assert {image.shape for image in found.images.values()} == {(24, 32, 3)}
    found.save(tmp_path / "both.exr")
    exr = read_exr(tmp_path / "both.exr")
    np.testing.assert_array_equal(exr.image, found.images["ours"])
    difference = exr.image - np.stack([exr.layers[f"theirs.{c}"] for c in "RGB"], axis=-1)
    # the difference was taken in float64
    np.testing.assert_allclose(difference, found.images["difference"], atol=1e-6 * exr.image.max())
    assert "alpha = 0.2: equal" in str(found) and "alpha = 0.2: equal" in found._repr_html_()


@pytest.mark.parametrize("mistake", [radiance, roughness])
def test_comparison_sees_a_broken_bsdf(mistake: Break, monkeypatch) -> None:
    mistake(monkeypatch)
    found = mrt.compare_roughconductor(alpha=0.3, **SMALL)
    assert not found.equal
    assert found.errors["value"] > 0.01
    # the ball is a third of the picture
    assert found.errors["pixels that differ, with the same random numbers"] > 0.1


def test_roughness_out_of_range_is_refused() -> None:
    for alpha in (0, -0.1, 1.5, float("nan")):
        with pytest.raises(mrt.UsageError, match="alpha="):
            mrt.compare_roughconductor(alpha)


def test_fifty_digits_judge_where_densities_differ() -> None:
    """Mitsuba's density of plain D sampling is off at grazing angles; ours is not."""
    found = roughconductor.compare_pointwise(0.001, count=20_000)
    ours, theirs = np.array(found.judged).T
    assert len(ours) == roughconductor.JUDGED
    assert ours.max() < 5e-6 < 2e-5 < theirs.max()


# ------------------------------ Metals ------------------------------


def test_every_preset_is_measured() -> None:
    names = metals.preset_names()
    assert {"Ag", "Al", "Au", "Cu", "Cr", "W"} <= set(names) and len(names) > 40
    assert names == sorted(set(names))


def test_exact_reflectance_of_metals() -> None:
    """Against the textbook's form with complex indices, in float64."""
    gold = metals.measure("Au")
    cos = np.cos(np.radians(metals.ANGLES))[:, None]
    index = gold.eta - 1j * gold.k
    inside = np.sqrt(1 - (1 - cos**2) / index**2)  # cosine of the refracted wave
    s, p = (cos - index * inside) / (cos + index * inside), (index * cos - inside) / (index * cos + inside)
    np.testing.assert_allclose(gold.exact, (abs(s) ** 2 + abs(p) ** 2) / 2, rtol=1e-5)  # float32
    np.testing.assert_allclose(gold.schlick, gold.f0 + (1 - gold.f0) * (1 - cos) ** 5, rtol=1e-5)
    assert gold.f0[0] > 0.9 > 0.4 > gold.f0[2]  # it is yellow


def test_undefined_reflectance_is_that_of_the_limit() -> None:
    """A channel without index and extinction, as RGB gives one to AlSb, reflects everything."""
    compound = metals.measure("AlSb")
    assert (compound.eta[0], compound.k[0]) == (0, 0)
    np.testing.assert_allclose(compound.exact[:, 0], 1)
    assert np.isfinite(compound.error).all()


def test_wrong_fresnel_of_metals_is_seen(monkeypatch) -> None:
    monkeypatch.setattr(metals, "f0_of_conductor", lambda eta, k: ((eta - 1) / (eta + 1)) ** 2)
    monkeypatch.setattr(metals, "preset_names", lambda: ["Au"])
    monkeypatch.setattr(metals, "show_ball", lambda *arguments: None)
    assert findings(metals.run, quick=True).missed == {
        "F₀ of 1 metals against the exact value, relative",
        "Schlick against exact under even light, worst metal",
    }
