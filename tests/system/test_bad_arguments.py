"""Bad arguments from Python: typed errors that name the thing, and for plugins the plugin, too."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import BLUE_SKY, Camera, Cone, Cylinder, Material, Mesh, Scene, Sphere

SMALL: dict[str, Any] = {"width": 8, "height": 6, "aa": 1}
MATTE = Material(1.5, 0.1, (0, 0, 0), (0.5, 0.5, 0.5))
EMPTY = Scene(Camera((0, 0, 5), (0, 0, 0)), BLUE_SKY, ())
NAN, INFINITE = math.nan, math.inf


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"scene": 99}, "there is no scene 99: choose one of 0, 1"),
        ({"scene": 1.5}, "scene is 1.5: give a number, a Scene, a dict, a Mitsuba scene or a path"),
        ({"scene": None}, "scene is None: give a number"),
        ({"width": 0}, "width=0: must be a whole number from 1 to 65536"),
        ({"width": 8.0}, "width=8.0: must be a whole number"),
        ({"aa": 0}, "aa=0: must be a whole number from 1 to 64"),
        ({"aamode": "all"}, "aamode='all': must be none, luma, sobel, geometry or noise"),
        ({"layers": None}, "layers=None: must be a comma list"),
        ({"layers": ["depth", "depth"]}, "each once"),
        ({"focaldist": NAN}, "focaldist=nan: must be a finite number, 0 or more"),
        ({"motion": (1, 2)}, "motion=(1, 2): must be three finite numbers"),
        ({"memory": "1X"}, "memory='1X': must be bytes"),
        ({"variant": "scalar_rbg"}, "Did you mean scalar_rgb?"),
        ({"spp": 0}, "spp=0: must be a whole number"),
        ({"aamode": "none", "layers": ["edges"]}, "edges"),
        ({"integrator": 3}, "the integrator is 3: it must be a sampling integrator"),
        ({"integrator": {"type": "ptracer"}}, "it must be a sampling integrator"),
        ({"integrator": "prb"}, "the integrator PRBIntegrator computes derivatives"),
        ({"integrator": "direct_projective"}, "computes derivatives"),
        ({"integrator": "volprim_rf_basic"}, "computes derivatives"),
    ],
)
def test_render_refuses(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(mrt.UsageError, match=re.escape(text)) as caught:
        mrt.render(**{**SMALL, **arguments})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("scene", "text"),
    [
        ("", "cannot read '': there is no such file"),
        ("a\0b.xml", "its name holds a zero byte"),
        (Path("none.obj"), "cannot read none.obj: there is no such file in"),
        ({"type": "scene"}, "a dict has no sensor: add one"),
        ({"type": "potato"}, 'Plugin "potato" not found'),
        ({"type": "sphere"}, "a dict is a Shape, not a scene: put it into one"),
        ({"type": 3}, "type is 3; give the name of a plugin"),
        ({"type": "scene", "ball": {"type": "sphere", "center": None}}, "ball.center is None; give it a"),
        ({"type": "mrt_bsdf", "alpha": "big"}, "mrt_bsdf: \"alpha\" is 'big', but must be a number"),
        (dataclasses.replace(EMPTY, sky=(0, NAN, 0)), "sky is (0, nan, 0), but must be three finite"),
        (dataclasses.replace(EMPTY, texturing="nice"), "texturing is 'nice', but must be report or standard"),
        (dataclasses.replace(EMPTY, camera=Camera((1, 1, 1), (1, 1, 1))), "are the same point"),
        (dataclasses.replace(EMPTY, camera=Camera((0, 5, 0), (0, 0, 0))), "the camera looks along up"),
        (dataclasses.replace(EMPTY, camera=Camera((0, NAN, 0), (0, 0, 0))), "position is (0, nan, 0)"),
        (dataclasses.replace(EMPTY, camera=Camera((0, 0, 5), (0, 0, 0), hfov=180)), "less than 180 degrees"),
        (dataclasses.replace(EMPTY, spheres=(Sphere((0, 0, 0), 0, MATTE),)), "spheres[0] is Sphere("),
        (dataclasses.replace(EMPTY, spheres=(Sphere((0, 0), 1, MATTE),)), "spheres[0] is Sphere("),
        (dataclasses.replace(EMPTY, cones=(Cone((0, 0, INFINITE), (0, 0, 0), 1, MATTE),)), "cones[0] is"),
        (dataclasses.replace(EMPTY, cylinders=(Cylinder((0, 0, 0), (0, 0, 0), 1, MATTE),)), "two points"),
        (
            dataclasses.replace(EMPTY, meshes=(Mesh(np.zeros((3, 3)), np.array([[0, 1, 7]]), MATTE),)),
            '"faces" holds 7, but there are 3 positions',
        ),
    ],
    ids=range(20),
)
def test_scenes_that_cannot_be_drawn(scene: Any, text: str) -> None:
    size = SMALL if isinstance(scene, Scene) else {"aa": 1}
    with pytest.raises(mrt.SceneError, match=re.escape(text)) as caught:
        mrt.render(scene, **size)
    assert "Traceback" not in str(caught.value) and ".cpp:" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"width": 0}, "width=0"),
        ({"fresnel": "exact"}, "fresnel='exact': must be schlick or dielectric"),
        ({"flavor": "vanilla"}, "flavor='vanilla': must be mrt or stock"),
    ],
)
def test_scene_dict_refuses(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(mrt.UsageError, match=re.escape(text)):
        mrt.scene_dict(0, **arguments)


def test_results_are_not_saved_by_another_tone_map(tmp_path: Path) -> None:
    with pytest.raises(mrt.UsageError, match="tonemap='neon': must be report or srgb"):
        mrt.render(0, **SMALL).save(tmp_path / "a.png", tonemap="neon")
    assert list(tmp_path.iterdir()) == []


TRIANGLE = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)


def _mesh(**arrays: np.ndarray) -> dict[str, Any]:
    import mitsuba as mi

    arrays = {"positions": TRIANGLE, "faces": np.array([[[0, 1, 2]]], np.uint32), **arrays}
    return {"type": "mrt_mesh", **{name: mi.Bitmap(array) for name, array in arrays.items()}}


UP = {"type": "mrt_plane", "normal": [0, 1, 0]}
PLUGINS: list[tuple[dict[str, Any], str]] = [
    ({"type": "mrt_bsdf", "alpha": NAN}, '"alpha" is nan, but must be a finite number'),
    ({"type": "mrt_bsdf", "alpha": INFINITE}, '"alpha" is inf'),
    ({"type": "mrt_bsdf", "alpha": 1e39}, '"alpha" is 1e+39, but must be a finite number'),
    ({"type": "mrt_bsdf", "alpha": "rough"}, "\"alpha\" is 'rough', but must be a number"),
    ({"type": "mrt_bsdf", "alpha": True}, '"alpha" is True, but must be a number'),
    ({"type": "mrt_bsdf", "int_ior": 0.0}, '"int_ior" is 0.0, but must be a finite number > 0'),
    ({"type": "mrt_bsdf", "int_ior": -1.5}, '"int_ior" is -1.5'),
    ({"type": "mrt_bsdf", "int_ior": 1e-39}, '"int_ior" is 1e-39, but must be a finite number > 0'),
    ({"type": "mrt_bsdf", "ext_ior": 0.0}, '"ext_ior" is 0.0'),
    ({"type": "mrt_bsdf", "diffuse_reflectance": NAN}, '"diffuse_reflectance" is nan, but must be finite'),
    ({"type": "mrt_bsdf", "diffuse_reflectance": "red"}, "is 'red', but must be a number, a colour"),
    ({"type": "mrt_bsdf", "specular_reflectance": {"type": "rgb", "value": [1, -1, 1]}}, "not negative"),
    ({"type": "mrt_bsdf", "fresnel": {"type": "rgb", "value": 1}}, "one of schlick, dielectric, unity"),
    ({"type": "mrt_bsdf", "fresnel": "exact"}, "\"fresnel\" is 'exact', but must be one of schlick,"),
    ({"type": "mrt_bsdf", "f0": 0.1, "fresnel": "unity"}, '"f0" has no meaning with fresnel="unity"'),
    ({"type": "mrt_bsdf", "sample_visible": 1}, '"sample_visible" is 1, but must be true or false'),
    ({"type": "mrt_bsdf", "aplha": 0.1}, '"aplha"'),
    ({"type": "mrt_light", "intensity": INFINITE}, '"intensity" is inf, but must be finite'),
    ({"type": "mrt_light", "position": [0, 1e39, 0]}, "three finite numbers"),
    ({"type": "mrt_light", "position": [0, NAN, 0]}, '"position" is'),
    ({"type": "mrt_light", "position": [0, INFINITE, 0]}, '"position" is'),
    ({"type": "mrt_light", "position": 3.0}, '"position" is 3.0, but must be three finite numbers'),
    ({"type": "mrt_light", "to_world": 1.0}, '"to_world"'),
    ({"type": "mrt_light", "falloff": True}, '"falloff"'),
    ({"type": "mrt_plane"}, '"normal" is missing; give three numbers'),
    (UP | {"normal": [0, 0, 0]}, '"normal" is [0, 0, 0], but must be a vector of non-zero length'),
    (UP | {"normal": [0, NAN, 0]}, '"normal" is'),
    (UP | {"distance": INFINITE}, '"distance" is inf, but must be a finite number'),
    (UP | {"extent": 0.0}, '"extent" is 0.0, but must be a finite number > 0'),
    (UP | {"radius": 2.0}, '"radius"'),
    (UP | {"to_world": 2.0}, 'mrt_plane: "to_world" is not accepted'),
    ({"type": "mrt_whitted", "sky": -1.0}, '"sky" is -1.0, but must be finite and not negative'),
    ({"type": "mrt_whitted", "max_depth": 1.5}, '"max_depth" is 1.5, but must be an integer from 1 to'),
    ({"type": "mrt_whitted", "max_depth": 2**32}, "but must be an integer from 1 to 4294967295"),
    ({"type": "mrt_texture"}, "give one of"),
    ({"type": "mrt_texture", "filename": "nothing.png"}, "nothing.png"),
    ({"type": "mrt_texture", "filename": 3}, '"filename" is 3, but must be a text that is not empty'),
    ({"type": "mrt_texture", "bitmap": 3}, '"bitmap" is 3, but must be a mi.Bitmap'),
]


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize(("plugin", "text"), PLUGINS, ids=range(len(PLUGINS)))
def test_plugins_name_the_parameter(variant: str, plugin: dict[str, Any], text: str) -> None:
    import mitsuba as mi

    with pytest.raises(RuntimeError, match=re.escape(text)) as caught:
        mi.load_dict(plugin)
    assert plugin["type"] in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"positions": TRIANGLE * np.float32(np.nan)}, '"positions" holds a number that is not finite'),
        ({"positions": TRIANGLE[:, :, :2]}, "must have [1, N, 3]"),
        ({"texcoords": TRIANGLE[:, :2]}, '"texcoords" has 2 entries for 3 positions'),
        ({"faces": np.array([[[0, 1, -2]]], np.float32)}, '"faces" holds -2'),
        ({"faces": np.array([[[0, 1, 0.5]]], np.float32)}, '"faces" holds a number that is not whole'),
    ],
)
def test_meshes_name_the_array(variant: str, arrays: dict[str, np.ndarray], text: str) -> None:
    import mitsuba as mi

    with pytest.raises(RuntimeError, match=re.escape(text)):
        mi.load_dict(_mesh(**arrays))
