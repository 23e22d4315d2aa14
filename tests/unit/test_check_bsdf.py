"""``check_bsdf``: sound BSDFs pass, each mistake fails its own laws, and results say why."""

from __future__ import annotations

import gc
import json
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import but_slow
from nodes import rgb
from scipy import stats
from unit.specimens import changed_bsdf, exceeded, faulty_bsdf, unchanged

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.validation.laws import bsdf_samples
from mrt_mitsuba.validation.laws.bsdf import LAWS
from mrt_mitsuba.validation.laws.faults import GLOSS

pytestmark = pytest.mark.usefixtures("variant")


def holds(check):
    assert check.passed, str(check)


def run(snippet):
    """A snippet is a program by itself."""
    before = mi.variant()
    try:
        exec(compile(snippet, "snippet", "exec"), {})
    finally:
        runtime.use(before)


def test_a_sound_bsdf_passes_as_a_dict_and_loaded():
    given = faulty_bsdf(GLOSS, value=unchanged)
    holds(mrt.check_bsdf(given, quick=True))
    check = mrt.check_bsdf(mi.load_dict(given), quick=True, seed=1)
    holds(check)
    assert "loaded object" in check.laws["variants"].skipped
    assert not check.laws["switch"].skipped


# What each of them fails is explained in docs/check_your_plugin.md
STOCK = {
    "diffuse": ({"reflectance": {"type": "checkerboard"}}, set()),
    "dielectric": ({}, set()),
    "thindielectric": ({}, set()),
    "conductor": ({"material": "Au"}, set()),
    "plastic": ({}, {"gradients"}),
    "roughdielectric": ({"alpha": 0.2}, set()),
    "roughconductor": ({"distribution": "ggx"}, set()),
    "roughplastic": ({}, {"sampling", "finite", "gradients"}),
    "twosided": ({"nested": {"type": "diffuse"}}, {"components"}),
    "mask": ({"opacity": {"type": "checkerboard"}, "nested": {"type": "roughconductor", "alpha": 0.3}},
             {"components"}),
    "blendbsdf": ({"weight": 0.3, "a": {"type": "diffuse"}, "b": {"type": "dielectric"}},
                  {"weights", "gradients", "components"}),
}  # fmt: skip


@pytest.mark.parametrize("name", but_slow(STOCK, {"roughplastic"}))
def test_stock_bsdfs_fail_what_is_known(name, capsys):
    parameters, known = STOCK[name]
    check = mrt.check_bsdf({"type": name, **parameters}, quick=True)
    by_chance = {"variants"} if name == "roughplastic" else set()  # where its NaN is among few pairs
    assert set(check.failed) - by_chance == known, str(check)
    assert not check.laws["sampling"].notes  # quadrature resolves every lobe
    for law in check.laws.values():
        for part in law.parts:
            if not part.holds or name == "dielectric":  # every snippet of one
                run(part.snippet)


@pytest.mark.parametrize(
    "bsdf",
    [
        pytest.param({"type": "roughconductor", "alpha": 1e-4}, marks=pytest.mark.slow),
        {"type": "mrt_bsdf", "alpha": 1e-8, "diffuse_reflectance": 0.0, "fresnel": "unity"},
    ],
)
def test_a_lobe_at_the_least_roughness(bsdf):
    """Mitsuba raises alpha to 1e-4, a kink; ours to 1e-8. Along the normal, lobes are cut by all azimuths."""
    holds(mrt.check_bsdf(bsdf, quick=True, seed=2))
    holds(mrt.check_bsdf(bsdf, only=["weights"]))  # at 89 degrees, where a lobe is 60 times as narrow


def test_no_energy_is_gained_where_light_grazes_a_rarer_medium_and_passes():
    """It would be in the mode of radiance, which transmission scales by the squared index."""
    glass = {"type": "dielectric", "int_ior": 1.3, "ext_ior": 1.307}  # reflects all from 84 degrees on
    holds(mrt.check_bsdf(glass, quick=True, only=["energy"]))


def test_a_texture_that_loading_uses_up():
    bumps = mi.TensorXf(np.random.default_rng(0).random((8, 8, 1)).astype(np.float32))
    bumpy = {"type": "bumpmap", "texture": {"type": "bitmap", "raw": True, "data": bumps}, "scale": 0.02}
    # shading normals break reciprocity whoever computes them (Veach 1997, § 5.3)
    only = ["weights", "components", "variants", "switch"]
    holds(mrt.check_bsdf({**bumpy, "bsdf": {"type": "diffuse"}}, quick=True, only=only))


@pytest.mark.parametrize(
    ("variant", "bsdf"),
    [
        ("scalar_rgb", {"type": "diffuse"}),  # in which Mitsuba leaves ``active`` out
        # a lobe 500 times as long as wide, of which so few samples and cells tell little
        pytest.param(
            "scalar_rgb",
            {"type": "roughconductor", "alpha_u": 0.001, "alpha_v": 0.5},
            marks=pytest.mark.slow,
        ),
        ("llvm_ad_mono_polarized", {"type": "mrt_bsdf", "alpha": 0.3}),
        # three coefficients of sizes far apart, and numbers that are wavelengths
        ("llvm_ad_spectral", {"type": "mrt_bsdf", "diffuse_reflectance": rgb(0.7, 0.1, 0.3)}),
        pytest.param(
            "llvm_ad_spectral", {"type": "roughconductor", "material": "Cu"}, marks=pytest.mark.slow
        ),
    ],
    indirect=["variant"],
)
def test_other_variants(variant, bsdf):
    check = mrt.check_bsdf(bsdf, quick=True)
    holds(check)
    assert check.variant == variant == mi.variant()


def test_kernels_do_not_depend_on_numbers():
    """Of cells, samples or their places in memory: a check by another seed finds every kernel compiled."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for seed in range(2):
            dr.kernel_history_clear()
            mrt.check_bsdf({"type": "roughconductor"}, quick=True, seed=seed)
            launched = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
            compiled = [k for k in launched if not k["cache_hit"] or k["cache_disk"]]
            assert len(launched) > 200 and (seed == 0 or not compiled)


def test_a_plugin_of_one_variant_only():
    mi.register_bsdf("once", changed_bsdf())
    once = {"type": "once", "nested": {"type": "diffuse"}}
    law = mrt.check_bsdf(once, quick=True, only=["variants"]).laws["variants"]
    assert "does not know the plugin" in law.skipped


@pytest.mark.parametrize(
    ("check", "kind", "options", "message"),
    [
        (mrt.check_bsdf, "sphere", None, "is not a BSDF"),
        (mrt.check_bsdf, "diffuse", {"only": ["colour"]}, "unknown law 'colour'"),
        (mrt.check_bsdf, "nonsense", {}, 'cannot load the nonsense: .* "nonsense" not found'),
    ],
)
def test_wrong_usage(check, kind, options, message):
    given = mi.load_dict({"type": kind}) if options is None else {"type": kind}
    with pytest.raises(mrt.SceneError if options == {} else mrt.UsageError, match=message):
        check(given, **options or {})


def test_what_a_check_leaves(tmp_path):
    check = mrt.check_bsdf({"type": "twosided", "nested": {"type": "diffuse"}}, quick=True)
    check.save(tmp_path)
    assert list(check.laws) == list(LAWS) and check.failed == ["components"]
    page = (tmp_path / "index.html").read_text()
    html = check._repr_html_()
    assert all(name in page and name in html for name in LAWS)
    assert "mi.load_dict" in page and "mi.load_dict" in html
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["passed"] is False
    assert {path.suffix for path in tmp_path.iterdir()} >= {".html", ".json", ".csv"}


def test_the_smallest_p_value_is_corrected_for_all_tests(monkeypatch):
    asked = []

    def chi_square(*_):
        asked.append(1)
        return np.tile([30.0, 10.0], (6, 1)), (0.0, 0.1, 0.0, 0.1, 1)

    monkeypatch.setattr(bsdf_samples, "chi_square", chi_square)
    law = mrt.check_bsdf({"type": "diffuse"}, quick=True, only=["sampling"]).laws["sampling"]
    (cells,) = (part for part in law.parts if part.criterion == "cells")
    angles = len(asked)
    least = min(stats.chi2.sf(30, 10), stats.chi2.sf(30 * angles, 10 * angles))  # each angle, and all of them
    assert cells.measured == pytest.approx(1 - (1 - least) ** (6 * (angles + 1)))
    assert f"at {angles} angles" in cells.name


def read_nearest(entries):
    """A change of values by a table over both cosines that is read by the nearest entry."""

    def change(value, ctx, wi, wo):
        index = dr.clip(dr.floor(wi.z * wo.z * entries), 0, entries - 1)
        return value * (0.4 + 0.6 * index / entries)

    return change


@pytest.mark.parametrize("entries", [16, 256, 1024])
def test_a_step_of_a_table_is_no_rounding_error(entries):
    table = faulty_bsdf(value=read_nearest(entries))
    holds(mrt.check_bsdf(table, quick=True, only=["roundoff"]))


def without_active(self, ctx, si, wo):
    return self.nested.eval(ctx, si, wo)


def pair_of_one(self, ctx, si, wo, active=True):
    return self.nested.eval(ctx, si, wo, active), 1.0


def raising(self, ctx, si, wo, active=True):
    raise ValueError("no value")


def too_large(self, ctx, si, wo, active=True):
    return 1.3 * self.nested.eval(ctx, si, wo, active)


ANSWERS = {
    without_active: "takes 4 positional arguments but 5 were given",
    pair_of_one: "eval() returned Color3f, float: it must return Spectrum",
    raising: "ValueError: no value",
    too_large: "weight of a sample",
}


@pytest.mark.parametrize("loaded", [False, True], ids=["dict", "loaded"])
@pytest.mark.parametrize("answer", ANSWERS)
def test_a_checked_plugin_is_named_and_let_go(answer, loaded):
    """Dr.Jit calls every object that is left in each later kernel."""
    made = []

    class Wrong(changed_bsdf()):
        eval = answer

        def __init__(self, props):
            super().__init__(props)
            made.append(weakref.ref(self))

    mi.register_bsdf("wrong", Wrong)
    given = {"type": "wrong", "nested": {"type": "diffuse"}}
    gc.collect()
    gc.disable()
    try:
        check = mrt.check_bsdf(mi.load_dict(given) if loaded else given, quick=True)
        assert ANSWERS[answer] in check.laws["weights"].note
        assert made and not any(reference() for reference in made)
        assert np.isfinite(mrt.render(3, width=8, height=8).image).all()
    finally:
        gc.enable()


def test_a_value_in_lanes_that_eval_alone_does_not_switch_off_is_found():
    class Careless(changed_bsdf()):
        def eval(self, ctx, si, wo, active=True):
            return self.nested.eval(ctx, si, wo)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.nested.eval_pdf(ctx, si, wo, active)

    mi.register_bsdf("careless", Careless)
    given = {"type": "careless", "nested": {"type": "diffuse"}}
    assert exceeded(mrt.check_bsdf(given, quick=True, only=["eval_pdf"])) == {"eval_pdf.inactive"}


def test_a_bsdf_without_a_method_of_its_own_fails():
    class Bare(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

    mi.register_bsdf("bare", Bare)
    assert mrt.check_bsdf({"type": "bare"}, quick=True, only=["weights"]).failed == ["weights"]
