"""Opening scenes of every kind that ``render`` takes."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, SupportsIndex

import mitsuba as mi

from mrt_mitsuba.adaptive.target import AdaptiveIntegrator, Goal, Target
from mrt_mitsuba.errors import SceneError, UsageError, one_line, warn
from mrt_mitsuba.options import Values, is_obj, is_path
from mrt_mitsuba.plugins.variants import text_of
from mrt_mitsuba.scene.loading import load_dict, load_file
from mrt_mitsuba.scene.model import FOCAL_RANGE, MODEL_OPTIONS, Scene
from mrt_mitsuba.scene.report import report_scene

MAX_FILTER_RADIUS = 1024  # pixels


@dataclass(frozen=True)
class Source:
    """A loaded Mitsuba scene, how to look at it, and the focus it suggests."""

    name: str
    scene: mi.Scene
    sensor: mi.Sensor
    integrator: mi.Integrator
    width: int
    height: int
    focal_distance: float | None = None
    focal_range: float = FOCAL_RANGE
    fresnel: str | None = None  #: Fresnel formula of the report's scenes
    own: bool = False  #: True for a user's scene, whose film and sampler count
    goal: Goal | None = None  #: adaptive goal of its integrator, if it has one
    inputs: frozenset[str] = frozenset()  #: paths of the files that it was read from


def open_scene(scene: object, **given: Any) -> Source:
    """Load a scene by the options of ``render`` that are given; see there for what it may be.

    The values of options are those of parameters of an XML file that have the same names. Raises
    ``SceneError`` or ``UsageError``.
    """
    params = given.pop("params", None) or {}
    integrator = given.get("integrator")
    fresnel = given.get("fresnel")
    size = {name: given[name] for name in ("width", "height") if given.get(name)}
    model = {name: given[name] for name in MODEL_OPTIONS if name in given}
    if isinstance(model.get("target"), Target):
        del model["target"]  # of the error
    terms = in_terms(scene, model)
    names = [key for key in params if "." not in key]
    if names and not is_path(scene, ".xml"):
        raise UsageError(
            f"params: {names[0]} is not a key of mi.traverse, and only an XML file declares names"
        )
    inputs: set[str] = set()
    if terms is not None:
        inputs |= terms.files
        fresnel = fresnel or "schlick"
        name = terms.title or "a scene"
        if isinstance(scene, SupportsIndex):
            name = str(operator.index(scene))
        # its meshes have a material each: kept apart, they stay in order, and a file has the same layers
        loaded = load_dict(terms.to_dict(**size, fresnel=fresnel), name, inputs, merge=False, keys=params)
        distance = terms.focal_distance
        reach = terms.focal_range
    else:
        if fresnel is not None:
            raise UsageError(
                "fresnel is for the report's scenes; in a scene of your own, it is a parameter of mrt_bsdf"
            )
        name, loaded, values = _loaded(scene, inputs, params, given)
        distance = _number(values, "focaldist", None)
        reach = _number(values, "focalrange", FOCAL_RANGE)
    view = _sensor(name, loaded, given.get("sensor", 0))
    return replace(
        opened(name, loaded, view, _integrator(name, integrator, loaded)),
        **size,
        focal_distance=distance,
        focal_range=reach,
        fresnel=fresnel,
        own=terms is None,
        inputs=frozenset(inputs),
    )


def in_terms(scene: Any, model: Values) -> Scene | None:
    """Return a number, a ``Scene`` or the path of an OBJ file as a ``Scene``; None for anything else.

    ``model``: options of ``obj_scene``. Raises ``UsageError`` where they are of no use.
    """
    if is_obj(scene, model):
        from mrt_mitsuba.scene.obj import obj_scene  # with numpy

        return obj_scene(scene, **model)
    if isinstance(scene, SupportsIndex):
        return report_scene(operator.index(scene))
    return scene if isinstance(scene, Scene) else None


@contextmanager
def sized(source: Source) -> Iterator[None]:
    """Give the film the source's size within the block; a film of another size loses its crop window."""
    size = [source.width, source.height]
    before = {}
    if list(source.sensor.film().crop_size()) != size:
        parameters = mi.traverse(source.sensor)
        changes = {"film.size": size, "film.crop_size": size, "film.crop_offset": [0, 0]}
        before = {name: list(parameters[name]) for name in changes}
        parameters.update(changes)
    try:
        yield
    finally:
        if before:
            parameters.update(before)


def _loaded(
    scene: object, inputs: set[str], params: Values, options: Values
) -> tuple[str, mi.Scene, Mapping[str, str]]:
    """Return the name of a user's scene, the Mitsuba scene, and the parameters of its file; note its files in
    ``inputs``."""
    if isinstance(scene, dict):
        return "a dict", load_dict(scene, inputs=inputs, keys=params), {}
    if isinstance(scene, str | os.PathLike):
        path = os.fspath(scene)
        return os.path.basename(path), *load_file(path, params, inputs, options=options)
    if isinstance(scene, mi.Scene):
        if params:
            raise UsageError("params are for scenes to be loaded: change a loaded one by mi.traverse")
        return "a Mitsuba scene", scene, {}
    _check_variant("scene", scene)
    raise UsageError(f"scene is {text_of(scene)}: give a number, a Scene, a dict, a Mitsuba scene or a path")


def _check_variant(name: str, thing: object) -> None:
    """Raise ``UsageError`` for an object of Mitsuba that was loaded in another variant."""
    variant = thing.variant_name() if hasattr(thing, "variant_name") else mi.variant()
    if variant != mi.variant():
        raise UsageError(
            f"the {name} was loaded in the variant {variant}, and {mi.variant()} is in use: load it again, "
            f"or write variant={variant}"
        )


def _number(values: Mapping[str, str], name: str, default: Any) -> Any:
    """Return a number that an XML file declares, as ``write_xml`` writes it."""
    try:
        return max(0.0, float(values[name]))
    except (KeyError, ValueError):
        return default


def _sensor(name: str, scene: mi.Scene, number: int) -> mi.Sensor:
    if not isinstance(scene, mi.Scene):
        raise SceneError(f"{name} is a {type(scene).__name__}, not a scene: put it into one, with a sensor")
    sensors = scene.sensors()
    if not sensors:
        raise SceneError(f"{name} has no sensor: add one, so that there is something to look through")
    if number >= len(sensors):
        raise UsageError(f"sensor={number}: {name} has {len(sensors)}, counted from 0")
    return sensors[number]


def opened(name: str, scene: mi.Scene, sensor: mi.Sensor, integrator: mi.Integrator) -> Source:
    """Return the source of a loaded scene; raise ``SceneError`` if its sensor sees nothing."""
    parts = [sensor]
    if sensor.class_name() == "BatchSensor":
        parts = mi.traverse(sensor).hierarchy
    for part in parts:
        if part.class_name() == "IrradianceMeter" and part.get_shape() is None:  # Mitsuba would crash
            raise SceneError(f"{name} has an irradiancemeter outside of a shape: put it into one")
    film = sensor.film()
    width, height = film.crop_size()
    radius = film.rfilter().radius()
    if width < 1 or height < 1:
        raise SceneError(f"{name} brings a film of {width}x{height}: give it one pixel at least")
    if not 0 <= radius <= MAX_FILTER_RADIUS:
        raise SceneError(f"{name} has a filter of radius {radius:g}: give at most {MAX_FILTER_RADIUS} pixels")
    goal = None
    if isinstance(integrator, AdaptiveIntegrator):
        goal = integrator.goal
        integrator = integrator.nested
    return Source(name, scene, sensor, integrator, int(width), int(height), own=True, goal=goal)


def _integrator(name: str, integrator: Any, scene: mi.Scene) -> mi.Integrator:
    """Return the integrator asked for, or the scene's; without either, a path tracer, with a warning."""
    if integrator is None:
        integrator = scene.integrator()
    if integrator is None:
        media = any(shape.is_medium_transition() for shape in scene.shapes())
        integrator = "volpath" if media else "path"
        warn(f"{name} has no integrator: it is rendered with integrator={integrator}; write this, or another")
    if isinstance(integrator, str):
        integrator = {"type": integrator}
    if isinstance(integrator, dict):
        integrator = load_dict(integrator, f"the integrator {integrator.get('type')!r}")
    _check_variant("integrator", integrator)
    if not isinstance(integrator, mi.Integrator):
        raise UsageError(f"the integrator is {one_line(text_of(integrator))}: it must be one, such as path")
    return integrator
