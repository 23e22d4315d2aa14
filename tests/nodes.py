"""Nodes of Mitsuba scenes that tests are made of."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mrt_mitsuba.plugins import class_of
from mrt_mitsuba.plugins.table import PLUGINS, Plugin
from mrt_mitsuba.scene.model import OBJECTS
from mrt_mitsuba.validation.oracles.reference import PROFILES

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
SENSOR = "<sensor type='perspective'><film type='hdrfilm'>{}</film></sensor>"
SMALL = SENSOR.format("<integer name='width' value='4'/><integer name='height' value='3'/>")

AXIAL = [row for row in PLUGINS if row.module == "axial"]  # quadrics between two points


def radius(kind: str, z: Any) -> Any:
    """The radius of the side of such a quadric in its unit frame, as the float64 tracer has it."""
    flat, linear, square = PROFILES[OBJECTS[kind]]
    return (flat + linear * z + square * z**2) ** 0.5


def scene_xml(inside: str, sensor: str = SMALL) -> str:
    return f"<scene version='3.0.0'>{sensor}{inside}</scene>"


def rgb(*values: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(values)}


def mesh(positions: Any, faces: Any, **more: Any) -> dict[str, Any]:
    """Triangles, and ``texcoords`` or ``normals`` of their corners."""
    arrays = {name: mi.Bitmap(np.float32([a])) for name, a in {"positions": positions, **more}.items()}
    return {"type": "mrt_mesh", "faces": mi.Bitmap(np.uint32([faces])), **arrays}


def group(numbers: Any, **more: Any) -> dict[str, Any]:
    return {"type": "mrt_group", "numbers": mi.Bitmap(np.float32(numbers)), **more}


def sensor(
    origin: Sequence[float],
    target: Sequence[float],
    size: tuple[int, int],
    *,
    up: Sequence[float] = (0, 1, 0),
    rfilter: str = "box",
    **more: Any,
) -> dict[str, Any]:
    """A camera, and a film of width and height."""
    look = mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "component_format": "float32"}
    return {"type": "perspective", "to_world": look, "film": {**film, "rfilter": {"type": rfilter}}, **more}


def example(row: Plugin, **more: Any) -> dict[str, Any]:
    """A plugin of the table with the parameters of its sample."""
    values = {k: mi.Bitmap(v) if isinstance(v, np.ndarray) else v for k, v in row.sample.items()}
    return {"type": row.name, **values, **more}


def documented(row: Plugin) -> dict[str, str]:
    """The parameters of a plugin, and the first word of the type of each, from its class's docstring."""
    _, *tables, _ = re.split(r"^ *=+ =.*$", class_of(row).__doc__ or "", flags=re.MULTILINE)
    return dict(re.findall(r"^ *``(\w+)`` +`*(\w+)", "".join(tables), flags=re.MULTILINE))
