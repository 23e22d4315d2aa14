"""The report's scenes as numbers."""

from __future__ import annotations

import hashlib
import json
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba import UsageError
from mrt_mitsuba.scene.model import Material, Scene
from mrt_mitsuba.scene.report import NUMBERS, SCENE_4_MATERIALS, c_rand, report_scene

REPORT = (0, 1, 2, 3, 4, 9)


def test_c_rand_is_the_c_librarys() -> None:
    """The well-known first numbers of glibc's rand() without a seed, a far one, and those of another seed."""
    first = [1804289383, 846930886, 1681692777, 1714636915, 1957747793, 424238335, 719885386, 1649760492]
    assert list(islice(c_rand(), 8)) == first
    assert next(islice(c_rand(), 9_999, None)) == 1908609430
    assert list(islice(c_rand(42), 3)) == [71876166, 708592740, 1483128881]
    assert all(0 <= x < 2**31 for x in islice(c_rand(), 1000))


@pytest.mark.parametrize(
    ("number", "lights", "spheres", "planes", "cones"),
    [
        (0, 2, 4, 1, 0),
        (1, 2, 21, 1, 0),
        (2, 3, 40, 1, 0),
        (3, 3, 6, 3, 0),
        (4, 3, 600, 3, 0),
        (9, 2, 0, 1, 1),
    ],
)
def test_what_is_in_them(number: int, lights: int, spheres: int, planes: int, cones: int) -> None:
    scene = report_scene(number)
    assert (len(scene.lights), len(scene.spheres), len(scene.planes)) == (lights, spheres, planes)
    assert len(scene.cones) == cones
    assert report_scene(number) is scene


def numbers_of(scene: Scene) -> list[float]:
    """Every number of a scene, in a fixed order."""

    def material(m: Material) -> list[float]:
        return [m.ior, m.alpha, *m.specular, *m.diffuse]

    camera = scene.camera
    numbers = [*camera.position, *camera.target, *camera.up, camera.hfov, *scene.sky]
    numbers += [x for light in scene.lights for x in (*light.position, *light.color)]
    numbers += [x for s in scene.spheres for x in (*s.center, s.radius, *material(s.material))]
    numbers += [x for p in scene.planes for x in (*p.normal, p.distance, *material(p.material))]
    numbers += [x for c in scene.cones for x in (*c.apex, *c.base_center, c.radius, *material(c.material))]
    return numbers


CHECKSUMS = {
    0: "a4fed8279d9f45a4",
    1: "59e6d0293dcd62af",
    2: "479f60dbec271721",
    3: "669691de4cc8b866",
    4: "8c1edd15fa716260",
    9: "181e4b35414501f8",
}


@pytest.mark.parametrize("number", REPORT)
def test_no_number_has_changed(number: int) -> None:
    """To nine digits; the checksums were taken when the numbers had been compared with the original's."""
    text = " ".join(f"{x + 0.0:.9g}" for x in numbers_of(report_scene(number)))
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == CHECKSUMS[number]


def test_scene_4_is_drawn_in_the_order_of_the_report() -> None:
    """Material, radius, z, y, x from the C library's numbers; the first two spheres by hand."""
    one, two = report_scene(4).spheres[:2]
    # 1804289383 % 10; 846930886 % 200; 1681692777, 1714636915 and 1957747793 % 650
    assert one.material == SCENE_4_MATERIALS[3]
    assert one.radius == pytest.approx(0.05 + 0.086)
    assert one.center == pytest.approx((1 + 4.43, 6.15, 1 + 4.27))
    # 424238335 % 10; 719885386 % 200; 1649760492, 596516649 and 1189641421 % 650
    assert two.material == SCENE_4_MATERIALS[5]
    assert two.radius == pytest.approx(0.05 + 0.186)
    assert two.center == pytest.approx((1 + 3.71, 5.99, 1 + 0.42))


def test_scene_2_has_negative_roughness() -> None:
    alphas = {s.material.alpha for s in report_scene(2).spheres}
    assert sorted(alphas)[:2] == pytest.approx([-0.0432, -0.0432 + 0.1 / 3])
    assert sum(a < 0 for a in alphas) == 2


def test_defaults_of_the_blur() -> None:
    """Scene 3 is in focus at 2, scene 4 at 0.1 with a range of 3; the others have none."""
    found = {n: (report_scene(n).focal_distance, report_scene(n).focal_range) for n in REPORT}
    assert found == {0: (None, 2), 1: (None, 2), 2: (None, 2), 3: (2, 2), 4: (0.1, 3), 9: (None, 2)}


def test_unknown_number_is_refused() -> None:
    with pytest.raises(UsageError, match="there is no scene 77: choose one of 0, 1, 2, 3, 4"):
        report_scene(77)
    assert set(REPORT) <= set(NUMBERS)


def test_every_number_is_the_originals(original_data: Path) -> None:
    """Against its own file, to the digits it holds."""
    original = json.loads((original_data / "scenes.json").read_text())
    assert {int(key) for key in original} == set(REPORT)
    for number in REPORT:
        theirs, ours = original[str(number)], report_scene(number)
        camera = theirs["camera"]
        expected = [*camera["position"], *camera["target"], *camera["up"], camera["hfov_deg"]]
        expected += theirs["sky"]
        expected += [x for light in theirs["lights"] for x in (*light["position"], *light["color"])]
        for s in theirs["spheres"]:
            expected += [*s["center"], s["radius"], *material_numbers(s["material"])]
        for p in theirs["planes"]:
            expected += [*p["normal"], p["distance"], *material_numbers(p["material"])]
        for c in theirs["cones"]:
            expected += [*c["apex"], *c["base_center"], c["radius"], *material_numbers(c["material"])]
        np.testing.assert_allclose(
            numbers_of(ours), expected, rtol=1e-9, atol=1e-9
        )  # nine digits in the file
        assert theirs["default_focal_distance"] == ours.focal_distance
        assert theirs["default_focal_range"] == ours.focal_range


def material_numbers(m: dict) -> list[float]:
    return [m["ior"], m["roughness"], *m["specular"], *m["diffuse"]]
