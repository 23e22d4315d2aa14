"""Opening what ``render`` is given as a scene."""

from __future__ import annotations

import operator
import os
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.scene.loading import load_dict, load_file
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.obj import obj_scene
from mrt_mitsuba.scene.report import report_scene

SIZE = (800, 600)


@dataclass(frozen=True)
class Source:
    """A loaded Mitsuba scene, how to look at it, and the focus it suggests."""

    name: str
    scene: Any
    sensor: Any
    integrator: Any
    width: int
    height: int
    focal_distance: float | None = None
    focal_range: float = 2.0


def open_scene(
    scene: Any,
    *,
    width: int | None = None,
    height: int | None = None,
    fresnel: str | None = None,
    convention: str = "report",
    integrator: Any = None,
) -> Source:
    """Load a scene; see ``render`` for what it may be. Raises ``SceneError`` or ``UsageError``."""
    import mitsuba as mi

    if isinstance(scene, Scene):
        return _report_source(scene.title or "a scene", scene, width, height, fresnel, integrator)
    if hasattr(scene, "__index__"):
        number = operator.index(scene)
        return _report_source(str(number), report_scene(number), width, height, fresnel, integrator)
    if isinstance(scene, str | os.PathLike) and os.fspath(scene).lower().endswith(".obj"):
        model = obj_scene(scene, convention=convention)
        return _report_source(model.title, model, width, height, fresnel, integrator)
    if fresnel is not None:
        raise UsageError(
            "fresnel is for the report's scenes; in a scene of your own, it is a parameter of mrt_bsdf"
        )
    if isinstance(scene, dict):
        return _own_source("a dict", load_dict(scene), width, height, integrator)
    if isinstance(scene, str | os.PathLike):
        path = os.fspath(scene)
        return _own_source(os.path.basename(path), load_file(path), width, height, integrator)
    if isinstance(scene, mi.Scene):
        return _own_source("a Mitsuba scene", scene, width, height, integrator)
    raise UsageError(f"scene is {scene!r}: give a number, a Scene, a dict, a Mitsuba scene or a path")


def _report_source(
    name: str, scene: Scene, width: int | None, height: int | None, fresnel: str | None, integrator: Any
) -> Source:
    width, height = width or SIZE[0], height or SIZE[1]
    loaded = load_dict(scene.to_dict(width=width, height=height, fresnel=fresnel or "schlick"), name)
    return Source(
        name,
        loaded,
        loaded.sensors()[0],
        _integrator(integrator, loaded),
        width,
        height,
        scene.focal_distance,
        scene.focal_range,
    )


def _own_source(name: str, scene: Any, width: int | None, height: int | None, integrator: Any) -> Source:
    import mitsuba as mi

    if not isinstance(scene, mi.Scene):
        raise SceneError(f"{name} is a {type(scene).__name__}, not a scene: put it into one, with a sensor")
    if not scene.sensors():
        raise SceneError(f"{name} has no sensor: add one, so that there is something to look through")
    sensor = scene.sensors()[0]
    own_width, own_height = (int(n) for n in sensor.film().crop_size())
    if own_width < 1 or own_height < 1:
        raise SceneError(f"{name} brings a film of {own_width}x{own_height}: give it one pixel at least")
    if width not in (None, own_width) or height not in (None, own_height):
        raise UsageError(
            f"{name} brings a film of {own_width}x{own_height}: "
            "change it there, or leave out width and height"
        )
    return Source(name, scene, sensor, _integrator(integrator, scene), own_width, own_height)


def _integrator(integrator: Any, scene: Any) -> Any:
    import mitsuba as mi

    if integrator is None:
        integrator = scene.integrator()
    if integrator is None:
        integrator = {"type": "mrt_whitted"}
    if isinstance(integrator, str):
        integrator = {"type": integrator}
    if isinstance(integrator, dict):
        integrator = load_dict(integrator, f"the integrator {integrator.get('type')!r}")
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise UsageError(
            f"the integrator is {' '.join(repr(integrator).split())}: "
            "it must be a sampling integrator, such as path or direct"
        )
    return integrator
