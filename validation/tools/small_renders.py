"""Seconds of renders that are over in an instant, printed as JSON: ``python small_renders.py CASE ...``.

A script that knows nothing but the public names, so that it also measures an earlier version of the project:
``PYTHONPATH=CHECKOUT python small_renders.py CASE ...``. The bench runs it for both, in turns.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import mrt_mitsuba as mrt

SIZE: dict[str, Any] = {"width": 64, "height": 48}
ONE_RAY: dict[str, Any] = {"aamode": "none", "aa": 1, "lattice": "report", "focaldist": 0}
FILTERS: dict[str, Any] = {
    "lattice": "report",
    "focaldist": 2.0,
}  # as scene 3 by its number: sobel, depth of field
RENDERS = 100
LIGHTS = 1000

Render = Callable[[], Any]


def loaded(number: int = 3) -> Any:
    """Return one of the report's scenes, loaded by Mitsuba."""
    import mitsuba as mi

    return mi.load_dict(mrt.scene_dict(number, **SIZE))


def from_scene(options: dict[str, Any]) -> Render:
    """Return a render of a loaded scene."""
    scene = loaded()
    return lambda: mrt.render(scene, **options)


def from_number(options: dict[str, Any]) -> Render:
    """Return a render of a scene from its number."""
    return lambda: mrt.render(3, **SIZE, **options)


def with_update(options: dict[str, Any]) -> Render:
    """Return a render of a loaded scene of which a colour changes before."""
    import mitsuba as mi

    scene = loaded()
    parameters = mi.traverse(scene)
    names = list(parameters.keys())
    key = next(name for name in names if name.endswith("diffuse_reflectance.value"))
    turn = iter(range(10**9))

    def render() -> Any:
        parameters[key] = mi.Color3f(0.3 + 0.001 * (next(turn) % 100), 0.2, 0.1)
        parameters.update()
        return mrt.render(scene, **options)

    return render


def by_mitsuba() -> Render:
    """Return Mitsuba's own way to a picture by the scene's integrator, ``mrt_whitted``."""
    import mitsuba as mi
    import numpy as np

    scene = loaded()
    return lambda: np.array(mi.render(scene, spp=1))


def many_lights() -> Render:
    """Return a render of scene 4 with its light from a thousand points above, each of its own brightness."""
    import mitsuba as mi

    nodes = mrt.scene_dict(4, width=160, height=120)
    for name in [name for name in nodes if name.startswith("light_")]:
        del nodes[name]
    for i in range(LIGHTS):
        a, b, c = (i * 0.754877666 % 1, i * 0.569840296 % 1, i * 0.362378 % 1)  # evenly in the room
        nodes[f"light_{i}"] = {
            "type": "mrt_light",
            "position": [10 * a, 4 + 16 * b, 10 * c],
            "intensity": {"type": "rgb", "value": (6 / LIGHTS) * (0.5 + a)},
        }
    scene = mi.load_dict(nodes)
    return lambda: mrt.render(scene, **ONE_RAY)


CASES: dict[str, tuple[Callable[[], Render], int]] = {
    "loaded": (lambda: from_scene(ONE_RAY), RENDERS),
    "loaded, with an update": (lambda: with_update(ONE_RAY), RENDERS),
    "from its number": (lambda: from_number(ONE_RAY), RENDERS),
    "loaded, film": (lambda: from_scene({"aamode": "none", "aa": 1}), RENDERS),
    "loaded, filters": (lambda: from_scene(FILTERS), RENDERS),
    "loaded, with an update, filters": (lambda: with_update(FILTERS), RENDERS),
    "from its number, filters": (lambda: from_number({}), RENDERS),
    "mi.render": (by_mitsuba, RENDERS),
    f"{LIGHTS} lights": (many_lights, 1),
}


def seconds(name: str) -> float:
    """Return the mean seconds of warm renders of a case."""
    make, count = CASES[name]
    render = make()
    for _ in range(3):
        render()
    start = time.perf_counter()
    for _ in range(count):
        render()
    return (time.perf_counter() - start) / count


if __name__ == "__main__":
    mrt.register()
    print(json.dumps({name: seconds(name) for name in sys.argv[1:] or CASES}))
