"""Every plugin can be printed, alone and in a scene."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")


def bitmap(values: Any, kind: Any = np.float32) -> mi.Bitmap:
    return mi.Bitmap(np.array([values], dtype=kind))


TRIANGLE = bitmap([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
EXAMPLES: dict[str, dict[str, Any]] = {
    "bsdf": {},
    "cone": {"apex": [0, 1, 0], "base_center": [0, 0, 0], "radius": 1.0},
    "cylinder": {"p0": [0, 1, 0], "p1": [0, 0, 0], "radius": 1.0},
    "group": {"numbers": mi.Bitmap(np.array([(0, 0, 0, 1), (2, 0, 0, 0.5)], dtype=np.float32))},
    "light": {},
    "mesh": {"positions": TRIANGLE, "faces": bitmap([(0, 1, 2)], np.uint32)},
    "plane": {"normal": [0, 1, 0]},
    "texture": {"bitmap": bitmap([(0, 0, 0), (1, 1, 1)])},
    "whitted": {},
}


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("name", EXAMPLES)
def test_every_plugin_can_be_printed(variant: str, name: str) -> None:
    made = mi.load_dict({"type": f"mrt_{name}", **EXAMPLES[name]})
    assert str(made).lower().startswith(f"mrt{name}[")
    if isinstance(made, mi.Texture):
        made = mi.load_dict({"type": "diffuse", "reflectance": made})
    if isinstance(made, mi.BSDF):
        made = mi.load_dict({"type": "sphere", "bsdf": made})
    assert f"mrt{name}[" in str(mi.load_dict({"type": "scene", "made": made})).lower()
