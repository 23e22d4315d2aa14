"""``check_bsdf``: sound BSDFs pass, each mistake fails its own laws, and results say why."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from nodes import rgb
from unit import specimens
from unit.specimens import exceeded

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime
from mrt_mitsuba.validation.checks.bsdf import LAWS
from mrt_mitsuba.validation.studies import power

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def registered(variant: str) -> None:
    """The specimen of a BSDF, in both kinds of variants."""
    for name in (runtime.SLOW, variant):
        mi.set_variant(name)
        specimens.register()


def holds(check: Any) -> None:
    assert check.passed, str(check)


def run(snippet: str) -> None:
    """A snippet is a program by itself."""
    before = mi.variant()
    try:
        exec(compile(snippet, "snippet", "exec"), {})
    finally:
        mi.set_variant(before)


def test_a_sound_bsdf_passes_as_a_dict_and_loaded(registered) -> None:
    given = {"type": "changed", "change": "", "nested": specimens.GLOSS}
    holds(mrt.check_bsdf(given, quick=True))
    check = mrt.check_bsdf(mi.load_dict(given), quick=True, seed=1)
    holds(check)
    assert "loaded object" in check.laws["variants"].skipped
    assert not check.laws["switch"].skipped


@pytest.mark.parametrize("name", specimens.CHANGES)
def test_each_mistake_exceeds_its_own_figures(name: str, registered, capsys) -> None:
    nested, kind, _, figures = specimens.CHANGES[name]
    plugin = {"type": "changed", "change": name, "nested": nested}
    given = {"type": "stale"} if kind == "stale" else plugin
    # reciprocity and components cost least, and fail for many mistakes by mistake
    only = {"reciprocity", "components", *(figure.split(".")[0] for figure in figures)}
    check = mrt.check_bsdf(given, quick=True, only=only)
    assert exceeded(check) == figures, str(check)
    for law in (check.laws[name] for name in check.failed):
        assert law.why and law.note and not law.skipped
        run(law.snippet)
        assert capsys.readouterr().out
    if name == "detached gradient":
        assert "nested.alpha.value (detached)" in check.laws["gradients"].note


@pytest.mark.parametrize("fault", power.FAULTS, ids=[fault.what for fault in power.FAULTS])
def test_faults_three_times_as_large_as_documented_are_found(fault: power.Fault, variant: str) -> None:
    power.register(runtime.SLOW, variant)
    quick = np.isfinite(fault.quick)
    found = fault.check(3 * (fault.quick if quick else fault.full), quick=quick)
    assert fault.figure in exceeded(found), str(found)


def test_each_figure_has_a_specimen() -> None:
    known = set().union(*(figures for *_, figures in specimens.CHANGES.values()))
    known |= {fault.figure for fault in power.FAULTS if fault.kind != "shape"}
    assert known == {f"{name}.{figure}" for name, law in LAWS.items() for figure in vars(law)["figures"]}


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


@pytest.mark.parametrize("name", STOCK)
def test_stock_bsdfs_fail_what_is_known(name: str, capsys) -> None:
    parameters, known = STOCK[name]
    check = mrt.check_bsdf({"type": name, **parameters}, quick=True)
    assert set(check.failed) == known, str(check)
    assert not check.laws["sampling"].notes  # quadrature resolves every lobe
    for law in check.laws.values():
        for part in law.parts:
            if not part.holds or name == "dielectric":  # every snippet of one
                run(part.snippet)


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "roughconductor", "alpha": 1e-4},
        {"type": "mrt_bsdf", "alpha": 1e-8, "diffuse_reflectance": 0.0, "fresnel": "unity"},
    ],
)
def test_a_lobe_at_the_least_roughness(bsdf: dict[str, Any]) -> None:
    """Mitsuba raises alpha to 1e-4, a kink; ours to 1e-8. Along the normal, lobes are cut by all azimuths."""
    holds(mrt.check_bsdf(bsdf, quick=True, seed=2))
    holds(mrt.check_bsdf(bsdf, only=["weights"]))  # at 89 degrees, where a lobe is 60 times as narrow


def test_a_texture_that_loading_uses_up() -> None:
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
        ("scalar_rgb", {"type": "roughconductor", "alpha_u": 0.001, "alpha_v": 0.5}),
        ("llvm_ad_mono_polarized", {"type": "mrt_bsdf", "alpha": 0.3}),
        # three coefficients of sizes far apart, and numbers that are wavelengths
        ("llvm_ad_spectral", {"type": "mrt_bsdf", "diffuse_reflectance": rgb(0.7, 0.1, 0.3)}),
        ("llvm_ad_spectral", {"type": "roughconductor", "material": "Cu"}),
    ],
    indirect=["variant"],
)
def test_other_variants(variant: str, bsdf: dict[str, Any]) -> None:
    check = mrt.check_bsdf(bsdf, quick=True)
    holds(check)
    assert check.variant == variant == mi.variant()


def test_kernels_do_not_depend_on_numbers() -> None:
    """Of cells, samples or their places in memory: a check by another seed finds every kernel compiled."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for seed in range(2):
            dr.kernel_history_clear()
            mrt.check_bsdf({"type": "roughconductor"}, quick=True, seed=seed)
            launched = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
            compiled = [k for k in launched if not k["cache_hit"] or k["cache_disk"]]
            assert len(launched) > 200 and (seed == 0 or not compiled)


def test_a_plugin_of_one_variant_only_that_never_ends_and_changes_flags() -> None:
    endless: list[bool] = []

    def answer(value: Any, *_: Any) -> Any:
        dr.set_flag(dr.JitFlag.SymbolicCalls, False)
        while endless:
            time.sleep(0.001)
        return value

    mi.register_bsdf("once", power.changed_bsdf({"": ({}, "eval", answer)}))
    once = {"type": "once", "change": "", "nested": {"type": "diffuse"}}
    law = mrt.check_bsdf(once, quick=True, only=["variants"]).laws["variants"]
    assert "does not know the plugin" in law.skipped
    assert dr.flag(dr.JitFlag.SymbolicCalls)
    endless.append(True)
    check = mrt.check_bsdf(once, quick=True, only=["weights", "finite"], timeout=0.2)
    assert check.failed == ["weights"] and "took longer than 0.2 s" in check.laws["weights"].note
    assert "a law before it took longer" in check.laws["finite"].skipped
    assert dr.flag(dr.JitFlag.SymbolicCalls)


@pytest.mark.parametrize(
    ("check", "kind", "options", "message"),
    [
        (mrt.check_bsdf, "sphere", None, "is not a BSDF"),
        (mrt.check_shape, "diffuse", None, "is not a shape"),
        (mrt.check_bsdf, "diffuse", {"only": ["colour"]}, "unknown law 'colour'"),
        (mrt.check_bsdf, "nonsense", {}, 'cannot load the nonsense: .* "nonsense" not found'),
        (mrt.check_shape, "mrt_cone", {}, 'cannot load the mrt_cone: .*"apex" is missing'),
    ],
)
def test_wrong_usage(check: Any, kind: str, options: dict[str, Any] | None, message: str) -> None:
    given = mi.load_dict({"type": kind}) if options is None else {"type": kind}
    with pytest.raises(mrt.SceneError if options == {} else mrt.UsageError, match=message):
        check(given, **options or {})


def test_what_a_check_leaves(tmp_path: Path) -> None:
    check = mrt.check_bsdf({"type": "twosided", "nested": {"type": "diffuse"}}, quick=True)
    check.save(tmp_path)
    assert list(check.laws) == list(LAWS) and check.failed == ["components"]
    page, html = (tmp_path / "index.html").read_text(), check._repr_html_()
    assert all(name in page and name in html for name in LAWS)
    assert "mi.load_dict" in page and "mi.load_dict" in html
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["passed"] is False
    assert {path.suffix for path in tmp_path.iterdir()} >= {".html", ".json", ".csv"}
