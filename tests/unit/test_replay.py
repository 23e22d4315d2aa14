"""Renders that launch recorded kernels: the pictures are those of code that is recorded anew, to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")

SIZE = {"width": 16, "height": 12}
PLAIN: dict[str, Any] = {"aa": 1, "aamode": "none", "lattice": "report", "focaldist": 0}


def loaded(number: int = 3) -> mi.Scene:
    return mi.load_dict(mrt.scene_dict(number, **SIZE))


def picture(scene: Any, **options: Any) -> np.ndarray:
    """A picture and its layers, as they are rendered by default."""
    result = mrt.render(scene, **{**PLAIN, **options})
    return np.dstack([result.image, *result.layers.values()])


def anew(scene: Any, **options: Any) -> np.ndarray:
    """The same without recordings."""
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        return picture(scene, **options)


def update(scene: mi.Scene, ending: str, value: Any) -> None:
    parameters = mi.traverse(scene)
    key = next(key for key in list(parameters.keys()) if key.endswith(ending))
    parameters[key] = type(parameters[key])(value)
    parameters.update()


class Calls:
    """Counts how often the code of ``mrt_whitted`` runs.

    That is twice for a picture that is rendered again and again: the second time is recorded.
    """

    count = 0


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> Iterator[Calls]:
    kind, calls = type(mi.load_dict({"type": "mrt_whitted"})), Calls()
    trace = kind.trace

    def counting(*arguments: Any, **options: Any) -> Any:
        calls.count += 1
        return trace(*arguments, **options)

    monkeypatch.setattr(kind, "trace", counting)
    yield calls


# A camera at (0, 2, 8) that looks along -z, and a smaller ball elsewhere, row by row
CAMERA = [[-1, 0, 0, 0], [0, 1, 0, 2], [0, 0, -1, 8], [0, 0, 0, 1]]
BALL = [[0.2, 0, 0, 2], [0, 0.2, 0, 0.4], [0, 0, 0.2, 2], [0, 0, 0, 1]]
UPDATES = {
    "colour": ("diffuse_reflectance.value", [0.1, 0.9, 0.3]),
    "roughness": ("alpha", 0.3),
    "index": ("int_ior", 1.9),
    "black": ("specular_reflectance.value", [0, 0, 0]),
    "light": ("light_1.position", [0, 5, 3]),
    "brightness": ("light_2.intensity.value", [0.2, 0.1, 0.4]),
    "no light": ("light_0.intensity.value", [0, 0, 0]),
    "sky": ("sky.radiance.value", [3, 2, 1]),
    "sphere": ("sphere_2.to_world", BALL),
    "camera": ("sensor.to_world", CAMERA),
    "view": ("x_fov", 35.0),
    "near": ("near_clip", 4.0),
    "far": ("far_clip", 5.0),
}


@pytest.mark.parametrize("what", UPDATES)
def test_an_update_shows_from_cold_and_warm(what: str, traced: Calls) -> None:
    scene, key = loaded(), UPDATES[what]
    before = [picture(scene) for _ in range(3)]
    assert traced.count == 2 and np.array_equal(*before[:2]) and np.array_equal(*before[1:])
    update(scene, *key)
    after = [picture(scene) for _ in range(3)]
    if what in ("colour", "roughness", "light", "brightness", "camera", "view"):
        assert traced.count == 2  # numbers of the same kernel
    cold = loaded()
    update(cold, *key)
    assert np.array_equal(after[0], anew(cold))
    assert np.array_equal(*after[:2]) and np.array_equal(*after[1:])
    assert not np.array_equal(before[0], after[0])


def test_spheres_that_move_in_a_scene_of_their_own_are_seen(traced: Calls) -> None:
    """Rays are traced in the loaded scene itself, which builds its tree anew."""
    nodes = mrt.scene_dict(3, **SIZE)
    scene = mi.load_dict({name: node for name, node in nodes.items() if not name.startswith("plane")})
    for k in range(6):
        turned = mi.ScalarTransform4f().translate([0.1 * k, 0.4, 0]).rotate([0, 1, 1], 20 * k).scale(0.5)
        update(scene, "sphere_2.to_world", turned.matrix)
        assert np.array_equal(picture(scene), anew(scene))
    assert traced.count == 8


def test_many_objects_are_recorded_without_a_look_at_each(traced: Calls) -> None:
    """Dr.Jit looks at all objects of all scenes where a scene, or a pointer, is among what a kernel reads."""
    scene = loaded(4)
    assert np.array_equal(*(picture(scene) for _ in range(2))) and traced.count == 2
    arrays = scene.integrator().prepare(scene).arrays(scene)
    assert not any(isinstance(a, mi.Scene | mi.ShapePtr) for a in arrays)


def test_many_updates_in_a_row_are_each_seen(traced: Calls) -> None:
    """Dr.Jit gives the indices of arrays that are gone to new ones, so equal indices prove nothing."""
    scene, seen = loaded(), set()
    for k in range(12):
        update(scene, "sky.radiance.value", [k % 4, 1, k])
        update(scene, "light_1.intensity.value", [2 * k, 1, 1])
        seen.add(picture(scene).tobytes())
    assert len(seen) == 12 and traced.count <= 4


def test_sizes_options_scenes_and_variants_do_not_mix() -> None:
    scenes = {number: loaded(number) for number in (0, 3)}
    cases: list[tuple[int, dict[str, Any]]] = [
        (number, options)
        for number in scenes
        for options in (
            {},
            {"width": 13, "height": 7},
            {"layers": ["depth", "normal"]},
            {"layers": ["albedo", "shape"]},
            {"aa": 2},
            {"aa": 2, "lattice": "centered"},
            {"aa": 3, "lattice": "centered"},
            {"region": [3, 2, 8, 5]},
            {"aa": 2, "aamode": "sobel", "focaldist": 2.0, "layers": ["samples", "blur"]},
            {"integrator": {"type": "mrt_whitted", "max_depth": 2}},
            {"motion": [0.3, 0, 0], "motionsamples": 3},
            {"count_rays": True, "layers": ["bounces"]},
            {"lattice": "film"},
            {"lattice": "film", "aa": 2, "seed": 5},
            {"lattice": "film", "aa": 2, "aamode": "sobel", "layers": ["direct", "depth"]},
        )
    ]
    truth = [anew(scenes[number], **options) for number, options in cases]
    order = np.random.default_rng(0).permutation(4 * len(cases)) % len(cases)
    for index in order:
        number, options = cases[index]
        assert np.array_equal(picture(scenes[number], **options), truth[index]), cases[index]
    spectral = picture(3, variant="llvm_ad_spectral", **SIZE)
    for _ in range(2):
        assert np.array_equal(picture(3, variant="llvm_ad_spectral", **SIZE), spectral)
        assert np.array_equal(picture(3, variant="llvm_ad_rgb", **SIZE), anew(3, **SIZE))


def test_derivatives_are_recorded_anew(traced: Calls) -> None:
    scene = loaded()
    plain = picture(scene)
    assert np.array_equal(picture(scene), plain) and traced.count == 2
    parameters = mi.traverse(scene)
    key = "light_1.position"
    dr.enable_grad(parameters[key])
    parameters.set_dirty(key)
    parameters.update()
    assert np.array_equal(picture(scene), plain) and np.array_equal(picture(scene), plain)
    assert traced.count == 4
    dr.disable_grad(parameters[key])
    parameters.set_dirty(key)
    parameters.update()
    assert np.array_equal(picture(scene), plain) and np.array_equal(picture(scene), plain)
    assert traced.count == 4


def test_nothing_piles_up(capfd: pytest.CaptureFixture[str]) -> None:
    """Neither arrays nor recordings, whatever is updated between renders."""
    scene = loaded()

    def arrays() -> int:
        for k in range(20):
            update(scene, "alpha", 0.1 + 0.01 * k)
            picture(scene, aa=2, aamode="sobel", focaldist=2.0)
        capfd.readouterr()
        dr.whos()
        return len(capfd.readouterr().out.splitlines())

    first = arrays()
    assert first > 50 and arrays() <= first + 2
