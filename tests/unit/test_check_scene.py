"""``check_scene`` and ``mrt check``: every plugin of a scene, its pixels, and the laws of emitters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.validation.checks import scene as checks
from mrt_mitsuba.validation.checks.law import Check
from mrt_mitsuba.validation.studies.power import changed_bsdf, put

pytestmark = pytest.mark.usefixtures("variant")

SCENE = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="24"/><integer name="height" value="16"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant" id="sky"/>
    <shape type="sphere" id="ball">{bsdf}</shape>
</scene>"""


def poisoned() -> None:
    """Register a diffuse BSDF that is no number where it is seen at less than 6 degrees from the normal."""

    def poison(value: Any, ctx: Any, wi: Any, wo: Any) -> Any:
        return dr.select((wi.z > 0.995) & (value != 0), dr.nan, value)

    changes = {"poison": ({"type": "diffuse"}, "eval", poison)}
    mi.register_bsdf("poisoned", changed_bsdf(changes))


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    """Writes the scene with a BSDF on its ball."""
    poison = '<string name="change" value="poison"/><bsdf type="diffuse" name="nested"/>'
    inside = {"diffuse": "", "poisoned": poison}

    def write(bsdf: str) -> str:
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(bsdf=f'<bsdf type="{bsdf}" id="paint">{inside[bsdf]}</bsdf>'))
        return str(path)

    return write


def test_a_sound_scene(scene, capsys, tmp_path: Path) -> None:
    assert cli.main(["check", f"scene={scene('diffuse')}", "quick=1", f"out={tmp_path / 'out'}"]) == 0
    printed = capsys.readouterr().out
    for name in ("BSDF SmoothDiffuse paint", "shape Sphere ball", "emitter ConstantBackgroundEmitter sky"):
        assert f"{name} in llvm_ad_rgb: passed" in printed
    assert "every pixel is finite" in printed
    assert "SmoothDiffuse paint" in (tmp_path / "out" / "index.html").read_text()


def test_the_pixel_and_its_object_are_found(scene, capsys) -> None:
    poisoned()
    path = scene("poisoned")
    found = mrt.check_scene(path, quick=True)
    assert set(found.failed) == {"BSDF Changed paint: finite", "pixels"}, str(found)
    assert found.fault.crop[2:] == (1, 1)
    assert found.fault.culprit == "the BSDF Changed 'paint', on Sphere 'ball'"
    x, y = found.fault.crop[:2]
    assert abs(x - 12) <= 2 and abs(y - 8) <= 2  # the middle of the picture is seen along the normal
    assert cli.main(["check", path, "quick=1"]) == 1
    assert "the smallest crop: 1x1" in capsys.readouterr().out
    assert "Made by the BSDF" in found._repr_html_()


def test_a_light_that_is_no_number_and_instances() -> None:
    group = {"type": "shapegroup", "a": {"type": "sphere"}}
    place = mi.ScalarTransform4f().translate([0, 0, -3])
    nodes = {
        "type": "scene",
        "integrator": {"type": "direct"},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "group": group,
        "one": {"type": "instance", "to_world": place, "g": {"type": "ref", "id": "group"}},
        "ball": {"type": "sphere", "center": [0, 0, 4]},
        "lamp": {"type": "point", "intensity": {"type": "rgb", "value": float("nan")}},
    }
    found = mrt.check_scene(mi.load_dict(nodes), quick=True)
    assert found.failed == ["emitter PointLight lamp: finite", "pixels"], str(found)
    assert found.fault.culprit == "the emitter PointLight 'lamp'"
    assert found.left_out == ("1 instances are not checked: give a dict of one with its group",)
    instance = {"type": "instance", "to_world": place, "g": group}
    assert mrt.check_shape(instance, quick=True).failed == ["scale"]


SUN = np.random.default_rng(0).random((32, 64, 3), np.float32)
SUN[10, 20] = 1e4
STOCK: dict[str, dict[str, Any]] = {
    "point": {"position": [1, 2, 3]},
    "spot": {"cutoff_angle": 40.0},
    "directional": {"direction": [0, 0, -1]},
    "constant": {},
    "envmap": {"bitmap": SUN},
    "sunsky": {"sun_direction": [0.3, 0.9, 0.1]},
    "mrt_light": {"position": [1, 2, 3]},
}


@pytest.fixture
def lights_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The square below the light has been checked elsewhere."""
    for name in ("check_bsdf", "check_shape"):
        monkeypatch.setattr(checks, name, lambda *_, **__: Check("", "", {}, 0.0))


def failed(light: dict[str, Any]) -> set[str]:
    """Return the laws that a light fails over a square, as part of a scene."""
    view = mi.ScalarTransform4f().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 6}
    sensor = {"type": "perspective", "to_world": view, "film": film}
    nodes = {"integrator": {"type": "direct"}, "sensor": sensor, "square": {"type": "rectangle"}}
    found = mrt.check_scene({"type": "scene", **nodes, "light": light}, quick=True)
    return {name.split(": ")[1] for name in found.failed if name.startswith("emitter")}


@pytest.mark.usefixtures("lights_only")
@pytest.mark.parametrize(
    ("name", "variant"),
    [*((name, "llvm_ad_rgb") for name in STOCK), ("envmap", "scalar_rgb"), ("envmap", "llvm_ad_spectral")],
    indirect=["variant"],
)
def test_stock_emitters_and_ours(name: str, variant: str) -> None:
    given = {k: mi.Bitmap(v) if k == "bitmap" else v for k, v in STOCK[name].items()}
    assert not failed({"type": name, **given})


def upwards(d: Any) -> Any:
    return mi.Vector3f(d.x, d.y, abs(d.z))


# Changes of a sky: of the "direction" and "weight" of its samples, and of other answers; the laws they break
MISTAKES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "none": ({}, set()),
    "density x 1.01": ({"direction": lambda ds, u: put(ds, pdf=1.01 * ds.pdf)}, {"density", "weights"}),
    "pdf_direction x 1.1": ({"pdf": lambda pdf: 1.1 * pdf}, {"density", "sampling"}),
    "weight x 1.01": ({"weight": lambda weight, u: 1.01 * weight}, {"weights"}),
    "seen 0.99 times as bright": ({"seen": lambda light: 0.99 * light}, {"weights"}),
    "eval_direction x 0.99": ({"value": lambda light: 0.99 * light}, {"weights"}),
    "half of the sky": (
        {"direction": lambda ds, u: put(ds, p=ds.p + ds.dist * (upwards(ds.d) - ds.d), d=upwards(ds.d))},
        {"sampling"},
    ),
    "wrong distance": ({"direction": lambda ds, u: put(ds, dist=0.995 * ds.dist)}, {"sampling"}),
    "direction too long": ({"direction": lambda ds, u: put(ds, d=1.0005 * ds.d)}, {"sampling", "finite"}),
    "NaN": ({"weight": lambda weight, u: dr.select(u.x > 0.99, dr.nan, weight)}, {"finite"}),
    "negative": ({"weight": lambda weight, u: -weight}, {"finite", "weights"}),
}  # fmt: skip


@pytest.mark.usefixtures("lights_only")
@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_fails_its_own_laws(mistake: str) -> None:
    changes, laws = MISTAKES[mistake]

    def changed(kind: str, value: Any, *more: Any) -> Any:
        return changes[kind](value, *more) if kind in changes else value

    class Sky(mi.Emitter):
        def __init__(self, props: Any) -> None:
            mi.Emitter.__init__(self, props)
            self.m_flags, self.sound = mi.EmitterFlags.Infinite, mi.load_dict({"type": "constant"})

        def eval(self, si: Any, active: Any = True) -> Any:
            return changed("seen", self.sound.eval(si, active))

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            ds, weight = self.sound.sample_direction(it, sample, active)
            ds.emitter = mi.EmitterPtr(self)
            return changed("direction", ds, sample), changed("weight", weight, sample)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return changed("pdf", self.sound.pdf_direction(it, ds, active))

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return changed("value", self.sound.eval_direction(it, ds, active))

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return "Sky"

    mi.register_emitter("sky", Sky)
    assert failed({"type": "sky"}) == laws
