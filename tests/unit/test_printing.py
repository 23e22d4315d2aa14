"""Every plugin can be printed, alone and in a scene; results are a line."""

from __future__ import annotations

import mitsuba as mi
import pytest
from nodes import example

import mrt_mitsuba as mrt
from mrt_mitsuba.plugins.table import PLUGINS

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("row", PLUGINS, ids=lambda row: row.name)
def test_every_plugin_can_be_printed(variant, row):
    made = mi.load_dict(example(row))
    assert str(made).startswith(f"{row.class_name}[")
    if isinstance(made, mi.Texture):
        made = mi.load_dict({"type": "diffuse", "reflectance": made})
    if isinstance(made, mi.BSDF):
        made = mi.load_dict({"type": "sphere", "bsdf": made})
    assert f"{row.class_name}[" in str(mi.load_dict({"type": "scene", "made": made}))


def test_results_are_printed_in_a_line_each():
    result = mrt.render(0, width=8, height=6, target=10)
    assert repr(result).startswith("<Result of scene 0: 8x6, layers error.Y, ")
    assert f", error {result.error}, " in repr(result)
    assert repr(result.timings).startswith(f"<Timings: {result.timings.total:.3g} s: load ")
    for shown in (result, result.timings, result.error, result.rounds[-1]):
        assert len(repr(shown).splitlines()) == 1 and len(repr(shown)) < 200
