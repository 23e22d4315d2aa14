"""Opening what ``render`` is given as a scene."""

from __future__ import annotations

import operator
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.memory import Budget
from mrt_mitsuba.scene.loading import load_dict, load_file
from mrt_mitsuba.scene.model import FOCAL_RANGE, SIZE, Scene, is_obj
from mrt_mitsuba.scene.parameters import set_parameters
from mrt_mitsuba.scene.placement import obj_scene
from mrt_mitsuba.scene.report import report_scene


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
    focal_range: float = FOCAL_RANGE
    fresnel: str | None = None  #: the formula in force, where the scene leaves the choice


def open_scene(
    scene: Any,
    *,
    width: int | None = None,
    height: int | None = None,
    fresnel: str | None = None,
    convention: str = "report",
    integrator: Any = None,
    budget: Budget | None = None,
    params: Mapping[str, Any] | None = None,
) -> Source:
    """Load a scene; see ``render`` for what it may be. Raises ``SceneError`` or ``UsageError``.

    ``budget``: memory from which its textures take theirs.
    """
    name, model = _model(scene, convention)
    if model is None:
        if fresnel is not None:
            raise UsageError(
                "fresnel is for the report's scenes; in a scene of your own, it is a parameter of mrt_bsdf"
            )
        name, loaded, values = _own(scene, budget)
        if params and loaded is scene:
            raise UsageError("params are for scenes to be loaded: change a loaded one by mi.traverse")
        set_parameters(loaded, params or {})
        size = _film_size(name, loaded, width, height)
        focus = _number(values, "focaldist", None), _number(values, "focalrange", FOCAL_RANGE)
        return Source(name, loaded, loaded.sensors()[0], _integrator(integrator, loaded), *size, *focus)
    width, height, fresnel = width or SIZE[0], height or SIZE[1], fresnel or "schlick"
    loaded = load_dict(model.to_dict(width=width, height=height, fresnel=fresnel), name, budget)
    set_parameters(loaded, params or {})
    sensor, integrator = loaded.sensors()[0], _integrator(integrator, loaded)
    focus = model.focal_distance, model.focal_range
    return Source(name, loaded, sensor, integrator, width, height, *focus, fresnel)


def _model(scene: Any, convention: str) -> tuple[str, Scene | None]:
    """Return the name and the model of a scene in the report's terms; no model of any other."""
    if isinstance(scene, Scene):
        return scene.title or "a scene", scene
    if hasattr(scene, "__index__"):
        number = operator.index(scene)
        return str(number), report_scene(number)
    if is_obj(scene):
        model = obj_scene(scene, convention=convention)
        return model.title, model
    return "", None


def _own(scene: Any, budget: Budget | None) -> tuple[str, Any, Mapping[str, str]]:
    """Return the name of someone's own scene, the Mitsuba scene, and the parameters of its file."""
    import mitsuba as mi

    if isinstance(scene, dict):
        return "a dict", load_dict(scene, budget=budget), {}
    if isinstance(scene, str | os.PathLike):
        path = os.fspath(scene)
        return os.path.basename(path), *load_file(path, budget)
    if isinstance(scene, mi.Scene):
        return "a Mitsuba scene", scene, {}
    raise UsageError(f"scene is {scene!r}: give a number, a Scene, a dict, a Mitsuba scene or a path")


def _number(values: Mapping[str, str], name: str, default: Any) -> Any:
    """Return a parameter of a file that ``write_xml`` gives a focus."""
    try:
        return max(0.0, float(values[name]))
    except (KeyError, ValueError):
        return default


def _film_size(name: str, scene: Any, width: int | None, height: int | None) -> tuple[int, int]:
    import mitsuba as mi

    if not isinstance(scene, mi.Scene):
        raise SceneError(f"{name} is a {type(scene).__name__}, not a scene: put it into one, with a sensor")
    if not scene.sensors():
        raise SceneError(f"{name} has no sensor: add one, so that there is something to look through")
    own_width, own_height = (int(n) for n in scene.sensors()[0].film().crop_size())
    if own_width < 1 or own_height < 1:
        raise SceneError(f"{name} brings a film of {own_width}x{own_height}: give it one pixel at least")
    if width not in (None, own_width) or height not in (None, own_height):
        raise UsageError(
            f"{name} brings a film of {own_width}x{own_height}: "
            "change it there, or leave out width and height"
        )
    return own_width, own_height


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
    if isinstance(integrator, mi.CppADIntegrator):
        raise UsageError(
            f"the integrator {type(integrator).__name__} computes derivatives, by mi.render(scene, params): "
            "choose another for a picture, such as path or direct"
        )
    if not isinstance(integrator, mi.SamplingIntegrator):
        raise UsageError(
            f"the integrator is {' '.join(repr(integrator).split())}: "
            "it must be a sampling integrator, such as path or direct"
        )
    return integrator
