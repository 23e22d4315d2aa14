"""A picture is that of the scene as it is: changes that leave every array and every object in its place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import but_slow
from nodes import rgb, sensor
from numpy.testing import assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.plugins import plugin

DOORS: dict[str, Callable[[mi.Scene], np.ndarray]] = {
    "mi.render": lambda scene: np.array(mi.render(scene, spp=1)),
    "mrt.render": lambda scene: mrt.render(scene, aa=1, aamode="none").image,
}
both_doors = pytest.mark.parametrize("door", DOORS)

COLORS = {"diffuse_reflectance": rgb(0.2, 0.5, 0.3), "specular_reflectance": rgb(0.3, 0.6, 0.9)}


def scene(**content: Any) -> mi.Scene:
    """A floor, a ball and a cone under nine lights, which is more than the kernels hold the code of.

    All have an ``mrt_bsdf``: tables are made of lights and materials.
    """
    nodes: dict[str, Any] = {"type": "scene", "integrator": {"type": "mrt_whitted"}}
    nodes["sensor"] = sensor([0, 1, 6], [0, 0, 0], (16, 12))
    nodes["floor"] = {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 1.0, "bsdf": {"type": "mrt_bsdf"}}
    nodes["ball"] = {"type": "sphere", "bsdf": {"type": "mrt_bsdf", "alpha": 0.3} | COLORS}
    ends = {"apex": [2, 1, 0], "base_center": [2, -1, 0]}
    nodes["cone"] = {"type": "mrt_cone", **ends, "radius": 0.8, "bsdf": {"type": "mrt_bsdf"}}
    dim = rgb(0.1, 0.1, 0.1)
    for k in range(9):
        nodes[f"lamp{k}"] = {"type": "mrt_light", "position": [k - 4, 3, 4], "intensity": dim}
    return mi.load_dict(nodes | content)


@both_doors
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
@pytest.mark.parametrize(("before", "after"), [((1, 0, 0), (1, 0, 1)), ((0, 0, 0), (0, 0.5, 0))])
def test_every_channel_of_a_light_is_compared(variant, door, before, after):
    """Its first one stays; the second light was left out as a black one."""

    def of(color: tuple[float, ...]) -> mi.Scene:
        return scene(lamp0={"type": "mrt_light", "position": [0, 3, 4], "intensity": rgb(*color)})

    loaded = of(before)
    render = DOORS[door]
    first = render(loaded)
    parameters = mi.traverse(loaded)
    parameters["lamp0.intensity.value"] = list(after)
    parameters.update()
    changed = render(loaded)
    assert_array_equal(changed, render(of(after)))
    assert abs(changed - first).max() > 0.05


WRITTEN = {  # a key, and its component
    "lamp3.position": "x",
    "lamp3.intensity.value": "y",
    "ball.bsdf.diffuse_reflectance.value": "x",
    "ball.bsdf.specular_reflectance.value": "x",
    "ball.bsdf.alpha": None,
    "cone.radius": None,
    "cone.apex": "y",
}


@both_doors
@pytest.mark.parametrize("key", WRITTEN)
@pytest.mark.parametrize("given", [False, True], ids=["a view", "an array of the caller's"])
def test_numbers_written_where_they_lie(variant, door, key, given):
    """``set_dirty`` and ``update`` say so, and nothing else: the arrays are the same ones."""
    loaded = scene()
    render = DOORS[door]
    parameters = mi.traverse(loaded)
    component = WRITTEN[key]
    value = parameters[key]
    numbers = np.asarray(value if component is None else getattr(value, component))
    if given:
        numbers = numbers.copy()
        own = mi.Float(numbers)
        if component is not None:
            setattr(value, component, own)
        parameters[key] = own if component is None else value
        parameters.update()
        dr.eval(parameters[key])
    before = render(loaded)
    for number in (0.4, 0.7):
        numbers[0] = number
        parameters.set_dirty(key)
        parameters.update()
        after = render(loaded)
        fresh = mi.traverse(other := scene())
        value = fresh[key]
        if component is None:
            fresh[key] = number
        else:
            setattr(value, component, number)
            fresh[key] = value
        fresh.update()
        assert_array_equal(after, render(other))
        assert abs(after - before).max() > 1e-3
        before = after


LEVEL = [0.2]  # read by classes below


def foreign_texture(where: str) -> str:
    """Register a texture of one level, which is kept in a list, a class or a module; return its name."""

    class Level(mi.Texture):
        shared: ClassVar = [0.2]

        def __init__(self, props: mi.Properties) -> None:
            mi.Texture.__init__(self, props)
            self.own = [0.2]

        def level(self) -> float:
            return {"instance": self.own, "class": type(self).shared, "module": LEVEL}[where][0]

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.UnpolarizedSpectrum(self.level())

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return mi.Float(self.level())

        def mean(self) -> Any:
            return mi.Float(self.level())

        def to_string(self) -> str:
            return "Level"

    mi.register_texture(f"level_{where}", Level)
    return f"level_{where}"


def set_level(loaded: mi.Scene, where: str, level: float) -> None:
    def holders(thing: Any) -> list[Any]:
        return [node for node in mi.traverse(thing).hierarchy if hasattr(type(node), "level")]

    sky = loaded.integrator().sky
    parts = [loaded, *loaded.emitters(), *([] if sky is None else [sky])]
    for node in [n for part in parts for n in holders(part)]:
        {"instance": node.own, "class": type(node).shared, "module": LEVEL}[where][0] = level


def foreign_light(where: str) -> str:
    """Register a light that derives from ours, whose numbers are kept in the same places."""

    class Dimmed(plugin("light").MrtLight):  # type: ignore[misc]
        shared: ClassVar = [0.2]

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.own = [0.2]

        def level(self) -> float:
            return {"instance": self.own, "class": type(self).shared, "module": LEVEL}[where][0]

        def sample_direction(self, *given: Any) -> tuple[Any, Any]:
            ds, weight = super().sample_direction(*given)
            return ds, weight * dr.opaque(mi.Float, self.level())

    mi.register_emitter(f"dimmed_{where}", Dimmed)
    return f"dimmed_{where}"


def prepared(loaded: mi.Scene) -> Callable[[mi.Scene], np.ndarray]:
    again = mrt.prepare(loaded, aa=1, aamode="none")
    return lambda scene: again().image


@pytest.mark.parametrize("door", [*DOORS, "prepare"])
@pytest.mark.parametrize("where", ["instance", "class", "module"])
@pytest.mark.parametrize(
    "what", but_slow(["texture", "texture of a light", "light", "sky"], {"texture of a light"})
)
def test_what_others_wrote_in_python_is_asked_each_time(variant, door, what, where):
    LEVEL[0] = 0.2
    level: dict[str, Any] = {"type": foreign_light(where) if what == "light" else foreign_texture(where)}
    lamp = {"type": "mrt_light", "position": [0, 3, 4], "intensity": level}
    content = {
        "texture": {"ball": {"type": "sphere", "bsdf": {"type": "mrt_bsdf", "diffuse_reflectance": level}}},
        "texture of a light": {"lamp0": lamp},
        "light": {f"lamp{k}": {**level, "position": [k - 4, 3, 4]} for k in range(9)},
        "sky": {"integrator": {"type": "mrt_whitted", "sky": level}},
    }[what]
    loaded = scene(**content)
    render = prepared(loaded) if door == "prepare" else DOORS[door]
    first = render(loaded)
    for number in (0.4, 0.0, 0.3):
        set_level(loaded, where, number)
        changed = render(loaded)
        assert abs(changed - first).max() > 1e-2
        other = scene(**content)
        set_level(other, where, number)
        assert_array_equal(changed, DOORS["mrt.render" if door == "prepare" else door](other))
        first = changed


def test_a_class_derived_from_mrt_bsdf_is_called(variant):
    """It has the row of its ancestor, which says nothing about its own ``eval``."""

    class Black(plugin("bsdf").MrtBSDF):  # type: ignore[misc]
        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return mi.Spectrum(0)

    mi.register_bsdf("black", Black)
    grey = {"type": "mrt_bsdf", "specular_reflectance": 0.0}
    floor = {"type": "mrt_plane", "normal": [0, 1, 0], "distance": 1.0, "bsdf": {**grey, "type": "black"}}
    content = {"floor": floor, "ball": {"type": "sphere", "bsdf": {**grey, "type": "black"}}}
    content["cone"] = {"type": "sphere", "bsdf": {**grey, "type": "black"}}
    assert np.array(mi.render(scene(**content), spp=1)).max() == 0


@both_doors
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_materials_may_change_places(variant, door):
    """The same materials on the same shapes, and only which is whose has changed."""
    red, blue = (mi.load_dict({"type": "mrt_bsdf", "diffuse_reflectance": rgb(*c)}) for c in np.eye(3)[::2])
    nodes = {f"s{k}": {"type": "sphere", "center": [3 * k - 3, 0, 0]} for k in range(3)}
    for node, material in zip(nodes.values(), (red, blue, red), strict=True):
        node["bsdf"] = material
    nodes |= {
        "type": "scene",
        "integrator": {"type": "mrt_whitted"},
        "sensor": sensor([0, 0, 9], [0, 0, 0], (48, 8)),
    }
    nodes["light"] = {"type": "mrt_light", "position": [0, 0, 40]}
    loaded = mi.load_dict(nodes)
    middles = np.s_[4, [10, 24, 38]]
    assert (DOORS[door](loaded)[middles].argmax(axis=1) == [0, 2, 0]).all()
    loaded.shapes()[2].set_bsdf(blue)
    assert (DOORS[door](loaded)[middles].argmax(axis=1) == [0, 2, 2]).all()


def test_a_texture_that_does_not_say_that_it_varies(variant):
    """A class in Python inherits from Mitsuba that it is uniform."""

    class Ramp(mi.Texture):
        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.UnpolarizedSpectrum(si.uv.x)

    mi.register_texture("ramp", Ramp)
    skin = {"type": "mrt_bsdf", "specular_reflectance": 0.0, "diffuse_reflectance": {"type": "ramp"}}
    square = {"type": "rectangle", "bsdf": skin}
    view = sensor([0, 0, 4], [0, 0, 0], (8, 4), fov=20)
    lamp = {"type": "mrt_light", "position": [0, 0, 40]}
    picture = mi.render(mi.load_dict({
        "type": "scene", "integrator": {"type": "mrt_whitted"}, "sensor": view, "a": square, "lamp": lamp,
    }), spp=1)  # fmt: skip
    across = np.array(picture)[2, :, 0]
    assert across.std() > 0.02


@pytest.mark.parametrize("key", ["lamp3.position", "ball.bsdf.alpha"])
def test_a_prepared_scene_follows_numbers_written_where_they_lie(variant, key):
    loaded = scene()
    again = mrt.prepare(loaded, aa=1, aamode="none")
    value = again.params[key]
    numbers = np.asarray(value.x if key.endswith("position") else value)
    for number in (0.4, 0.7):
        numbers[0] = number
        again.params.set_dirty(key)
        picture = again().image
        assert_array_equal(picture, mrt.render(loaded, aa=1, aamode="none").image)
