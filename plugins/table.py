"""The plugins of this folder, a row each: whatever lists them takes them from here.

Registration, the reasons of the kernel plan, messages, the pages of the documentation and the lists of tests
come from this table. A new plugin is a module with its class, and a row. The table imports none of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Plugin:
    """One plugin; its class in a variant is ``plugin(row.module)``'s ``row.class_name``."""

    name: str  #: what follows "type" in dicts and XML
    module: str
    class_name: str
    kind: str  #: what it is to Mitsuba: "bsdf", "emitter", "integrator", "sampler", "shape", "texture", ...
    package: str = __package__  #: where the module lies
    #: parameters of a small example: those without defaults, and what lets every number show in tests; arrays
    #: stand for bitmaps
    sample: Mapping[str, Any] = field(default_factory=dict)
    #: the table of the kernels of ``mrt_whitted`` that its numbers go into: "lights", "materials", "planes",
    #: "quadrics", or "" for none
    table: str = ""


PLUGINS = (
    Plugin(
        name="mrt_bsdf",
        module="bsdf",
        class_name="MrtBSDF",
        kind="bsdf",
        table="materials",
    ),
    Plugin(
        name="mrt_cone",
        module="axial",
        class_name="MrtCone",
        kind="shape",
        sample={"apex": [0, 1, 0], "base_center": [0, 0, 0]},
        table="quadrics",
    ),
    Plugin(
        name="mrt_cylinder",
        module="axial",
        class_name="MrtCylinder",
        kind="shape",
        sample={"p0": [0, 1, 0], "p1": [0, 0, 0]},
        table="quadrics",
    ),
    Plugin(
        name="mrt_group",
        module="group",
        class_name="MrtGroup",
        kind="shape",
        sample={"numbers": np.array([[0, 0, 0, 1]], np.float32)},
        table="quadrics",
    ),
    Plugin(
        name="mrt_light",
        module="light",
        class_name="MrtLight",
        kind="emitter",
        table="lights",
    ),
    Plugin(
        name="mrt_mesh",
        module="mesh",
        class_name="MrtMesh",
        kind="shape",
        sample={
            "positions": np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32),
            "faces": np.array([[[0, 1, 2]]], np.uint32),
        },
    ),
    Plugin(
        name="mrt_plane",
        module="plane",
        class_name="MrtPlane",
        kind="shape",
        sample={"normal": [0, 1, 0]},
        table="planes",
    ),
    Plugin(
        name="mrt_texture",
        module="texture",
        class_name="MrtTexture",
        kind="texture",
        sample={"bitmap": np.full((2, 2, 3), 0.5, np.float32)},
    ),
    Plugin(
        name="mrt_whitted",
        module="whitted.integrator",
        class_name="MrtWhitted",
        kind="integrator",
    ),
)


def names_in(table: str) -> str:
    """Return the names of the plugins in a table of the kernels, with commas."""
    return ", ".join(plugin.name for plugin in PLUGINS if plugin.table == table)
