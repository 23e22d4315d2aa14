"""Savings of the render plan: everything it leaves out, forced into scenes that do not need it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Cone, Plane, Scene, Sphere
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.tools.knobs import load
from mrt_mitsuba.validation.tools.scenery import with_materials
from mrt_mitsuba.validation.tools.study import Study
from mrt_mitsuba.validation.tools.warm import ratio

# Half a step of an 8-bit picture, which is what the cut-off promises; the rest changes nothing
INVISIBLE = 0.5 / 255

LAYERS = ("depth", "normal", "albedo", "direct", "reflection", "bounces")


def _same(nodes: dict[str, Any]) -> dict[str, Any]:
    return nodes


@dataclass(frozen=True)
class Forced:
    """A scene that does not need something, and how it is forced in."""

    what: str
    scene: Scene
    holding: Scene | None = None  # the scene that needs it; by default the same
    change: Callable[[dict[str, Any]], dict[str, Any]] = _same  # of the dict of the scene that needs it
    shared: dict[str, Any] = field(default_factory=dict)  # options of both renders
    more: dict[str, Any] = field(default_factory=dict)  # options of the second


def table(study: Study, *, size: tuple[int, int], aa: int, repeats: int) -> None:
    """Add the table of what is left out, and hold the pictures to be the same."""
    rows = [_row(case, size, aa, repeats) for case in study.each("What the plan saves", forced())]
    title = f"What the plan saves on a scene that does not need it, {size[0]}x{size[1]}, aa={aa}"
    note = "Scene 0 without what is named, and with it forced in, in turn; medians of ratios."
    study.records("plan", title, rows, note)
    what = "plan: largest change of the picture by what is left out"
    why = "half a step of an 8-bit picture; a lamp that is left out changes hundreds"
    study.at_most(what, max(row["change of the picture"] for row in rows), INVISIBLE, why)


def renders(case: Forced, size: tuple[int, int], aa: int) -> list[Callable[..., Any]]:
    """Return the render that leaves out, and the one into which it is forced."""
    options = {"aa": aa, "aamode": "none", **case.shared}
    nodes = [s.to_dict(width=size[0], height=size[1]) for s in (case.scene, case.holding or case.scene)]
    scenes = [load(nodes[0]), load(case.change(nodes[1]))]
    more: list[dict[str, Any]] = [{}, case.more]
    return [partial(mrt.render, scene, **{**options, **m}) for scene, m in zip(scenes, more, strict=True)]


def _row(case: Forced, size: tuple[int, int], aa: int, repeats: int) -> dict[str, Any]:
    without, forced_in = renders(case, size, aa)
    change = float(np.abs(without().image - forced_in().image).max())
    time = ratio(forced_in, without, repeats=repeats)
    return {
        "left out": case.what,
        "s without": time.other_seconds,
        "s with": time.seconds,
        "saves, s": time.seconds - time.other_seconds,
        "with / without": time.median,
        "quartiles": f"{time.low:.3g} to {time.high:.3g}",
        "change of the picture": change,
    }


def forced() -> list[Forced]:
    """Return every kind of thing that a plan leaves out."""
    plain = report_scene(0)
    dull = with_materials(plain, lambda m: dataclasses.replace(m, specular=(0, 0, 0)))  # nothing reflects
    stuff = plain.spheres[0].material
    all_paths = {"integrator": {"type": "mrt_whitted", "min_contribution": 0.0}}
    dark = dataclasses.replace(plain, lights=())
    # with a cut-off of zero, a light too dim to be seen still gets its shadow rays
    dim = dataclasses.replace(
        plain, lights=tuple(dataclasses.replace(light, color=(1e-9,) * 3) for light in plain.lights)
    )
    # out of sight, and yet something that reflects
    mirror = dataclasses.replace(dull, spheres=(*dull.spheres, Sphere((1e3, 1, 0), 0.1, stuff)))
    far_cone = dataclasses.replace(plain, cones=(Cone((1e3, 1, 0), (1e3, 0, 0), 0.1, stuff),))
    far_plane = dataclasses.replace(plain, planes=(*plain.planes, Plane((0, 1, 0), 1e4, stuff)))
    # without a sky in sight, nothing is out of focus
    inside = dataclasses.replace(plain, planes=(*plain.planes, Plane((1, 0, 0), 20, stuff)))
    return [
        Forced("bounce loop (nothing reflects)", dull, mirror),
        Forced("shadow rays (no light)", dark, dim, shared=all_paths),
        Forced("shadow rays and paths that cannot matter", plain, more=all_paths),
        Forced("cone code (no cone)", plain, far_cone),
        Forced("a plane", plain, far_plane),
        Forced("texture code (uniform colours)", plain, change=_textured),
        Forced("depth of field (all in focus)", inside, more={"focaldist": 1.0, "focalrange": 1e6}),
        Forced("edge pass (aa=1)", plain, shared={"aa": 1}, more={"aamode": "sobel", "layers": ["edges"]}),
        Forced("layers (not asked for)", plain, more={"layers": list(LAYERS)}),
    ]


def _textured(description: dict[str, Any]) -> dict[str, Any]:
    """Return the same colours, each as a picture of one colour."""
    for node in description.values():
        if isinstance(node, dict) and node.get("type") == "mrt_bsdf":
            colour = np.full((2, 2, 3), node["diffuse_reflectance"]["value"], np.float32)
            node["diffuse_reflectance"] = {"type": "bitmap", "bitmap": mi.Bitmap(colour), "raw": True}
    return description
