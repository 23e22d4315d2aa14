"""Every plugin can be printed, alone and in a scene."""

from __future__ import annotations

import mitsuba as mi
import pytest
from nodes import example

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
