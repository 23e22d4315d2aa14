"""The numbered scenes, read from the tables in ``assets/scenes.json``: 0 to 4 and 9 are the report's.

Scenes 5 to 8 stand in for the original's, whose models are not free; theirs are OBJ files in ``assets``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.options import check, choice
from mrt_mitsuba.scene.model import (
    FLAVORS,
    FRESNEL,
    OBJECTS,
    SIDE,
    Camera,
    Light,
    Material,
    Mesh,
    Node,
    Scene,
    Sphere,
)

NUMBERS = tuple(range(10))
_ASSETS = Path(__file__).parent / "assets"


def report_scene(number: int) -> Scene:
    """Return the scene of a number, always the same object. Raises ``UsageError`` for any other number."""
    if number not in NUMBERS:
        raise UsageError(f"there is no scene {number!r}: choose one of {', '.join(map(str, NUMBERS))}")
    return _read(number)


def scene_dict(
    scene: int | Scene, *, width: int = 800, height: int = 600, fresnel: str = "schlick", flavor: str = "mrt"
) -> Node:
    """Return a scene as a plain Mitsuba dict; ``mi.load_dict`` takes it (after ``mrt.register()``).

    ``flavor``: "mrt" for this project's plugins; "stock" for the nearest equivalents among Mitsuba's, which
    any Mitsuba program opens: ``roughplastic`` for the material, ``point`` lights as bright at the camera's
    target, finite squares for planes, ``bitmap`` for a texture, and ``path`` with few bounces. Cones,
    cylinders and meshes have one in files only: see ``export.write_xml``.

    Raises ``UsageError`` for an unknown scene, flavor or formula and for a size out of range, ``SceneError``
    for a scene without a stock flavor.
    """
    check("flavor", choice(*FLAVORS), flavor)
    width = check("width", SIDE, width)
    height = check("height", SIDE, height)
    fresnel = check("fresnel", FRESNEL, fresnel)
    from mrt_mitsuba import runtime

    runtime.use()
    terms = scene if isinstance(scene, Scene) else report_scene(scene)
    result = terms.to_dict(width=width, height=height, fresnel=fresnel)
    if flavor == "mrt":
        return result
    from mrt_mitsuba.scene.stock import stock

    return stock(result, terms)


@cache
def _read(number: int) -> Scene:
    table = _tuples(json.loads((_ASSETS / "scenes.json").read_text(encoding="utf-8")))["scenes"][number]
    materials = {name: Material(*values) for name, values in table["materials"].items()}
    objects: dict[str, Any] = {
        f"{kind}s": tuple(_object(make, materials, *row) for row in table.get(f"{kind}s", ()))
        for kind, make in OBJECTS.items()
    }
    if "random_spheres" in table:
        objects["spheres"] = tuple(_random_spheres(table["random_spheres"], [*materials.values()]))
    fields = {
        name: table[name] for name in ("title", "sky", "focal_distance", "focal_range") if name in table
    }
    return Scene(
        camera=Camera(**table["camera"]),
        lights=tuple(Light(*row) for row in table["lights"]),
        meshes=_meshes(table["model"]) if "model" in table else (),
        **fields,
        **objects,
    )


def _tuples(value: Any) -> Any:
    """Return a value of JSON with tuples in place of lists."""
    if isinstance(value, dict):
        return {name: _tuples(each) for name, each in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _object(make: type, materials: Mapping[str, Material], *row: Any) -> Any:
    """Make an object of a row: its numbers, the name of its material, and perhaps what of that differs."""
    changes: dict[str, Any] = {}
    if isinstance(row[-1], dict):
        *row, changes = row  # type: ignore[assignment]
    *numbers, name = row
    return make(*numbers, replace(materials[name], **changes))


def _random_spheres(number: int, materials: list[Material]) -> Iterator[Sphere]:
    """Yield the spheres of scene 4, of ten materials, by random numbers in the original's order."""
    numbers = c_rand()
    for _ in range(number):
        material = materials[next(numbers) % 10]
        radius = 0.05 + next(numbers) % 200 / 1000
        z = 1 + next(numbers) % 650 / 100
        y = next(numbers) % 650 / 100
        x = 1 + next(numbers) % 650 / 100
        yield Sphere((x, y, z), radius, material)


def _meshes(model: str) -> tuple[Mesh, ...]:
    from mrt_mitsuba.scene.obj import read_obj  # with numpy, which the other scenes do without

    meshes, _ = read_obj(_ASSETS / model)
    return meshes


def c_rand() -> Iterator[int]:
    """Yield the numbers of the GNU C library's ``rand()`` from the seed 1: an additive feedback generator.

    Source: the polynomial x³¹ + x³ + 1 of its manual page, started by a Lehmer generator (multiplier 16807),
    without the first 310 numbers.
    """
    words = [1]
    for _ in range(30):
        words.append(16807 * words[-1] % 0x7FFFFFFF)
    words += words[:3]
    for i in count(34):
        words.append((words[i - 31] + words[i - 3]) & 0xFFFFFFFF)
        if i >= 344:
            yield words[-1] >> 1
