"""``check_scene`` and ``mrt check``: every plugin of a scene, its pixels, and the laws of emitters."""

from __future__ import annotations

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from unit.specimens import changed_bsdf, exceeded

import mrt_mitsuba as mrt
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.validation.laws import emitter as emitters
from mrt_mitsuba.validation.laws import scene as checks
from mrt_mitsuba.validation.laws.page import Check

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


def poisoned():
    """Register a diffuse BSDF that is no number where it is seen at less than 6 degrees from the normal."""

    def poison(value, ctx, wi, wo):
        return dr.select((wi.z > 0.995) & (value != 0), dr.nan, value)

    mi.register_bsdf("poisoned", changed_bsdf("eval", poison))


@pytest.fixture
def scene(tmp_path):
    """Writes the scene with a BSDF on its ball."""
    inside = {"diffuse": "", "poisoned": '<bsdf type="diffuse" name="nested"/>'}

    def write(bsdf):
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(bsdf=f'<bsdf type="{bsdf}" id="paint">{inside[bsdf]}</bsdf>'))
        return str(path)

    return write


def test_a_sound_scene(scene, capsys, tmp_path):
    assert cli.main(["check", f"scene={scene('diffuse')}", "quick=1", f"out={tmp_path / 'out'}"]) == 0
    printed = capsys.readouterr().out
    for name in ("BSDF SmoothDiffuse paint", "shape Sphere ball", "emitter ConstantBackgroundEmitter sky"):
        assert f"{name} in llvm_ad_rgb: passed" in printed
    assert "every pixel is finite" in printed
    assert "SmoothDiffuse paint" in (tmp_path / "out" / "index.html").read_text()


def test_the_pixel_is_found(scene, capsys, monkeypatch):
    poisoned()
    path = scene("poisoned")
    found = mrt.check_scene(path, quick=True)
    assert set(found.failed) == {"BSDF Changed paint: finite", "pixels"}, str(found)
    count, x, y = map(int, re.findall(r"\d+", found.fault))
    assert count and abs(x - 12) <= 2 and abs(y - 8) <= 2  # the middle is seen along the normal
    assert found.fault in str(found)
    monkeypatch.setattr(mrt, "check_scene", lambda *_, **__: found)
    assert cli.main(["check", path, "quick=1"]) == 1
    assert found.fault in capsys.readouterr().out
    assert found.fault in found._repr_html_()


SUN = np.random.default_rng(0).random((32, 64, 3), np.float32)
SUN[10, 20] = 1e4


@pytest.fixture
def lights_only(monkeypatch):
    """The square below the light has been checked elsewhere."""
    for name in ("check_bsdf", "check_shape"):
        monkeypatch.setattr(checks, name, lambda *_, **__: Check("", "", {}, 0.0))


@pytest.mark.usefixtures("lights_only")
def test_a_scene_is_checked_as_it_is_rendered(monkeypatch):
    """Options are those of ``render``."""
    seen = []

    def bad_pixels(scene, integrator, sensor, *_):
        seen.append((integrator.class_name(), list(sensor.film().size())))
        return ""

    monkeypatch.setattr(checks, "_bad_pixels", bad_pixels)
    monkeypatch.setattr(checks, "check_emitter", lambda *_, **__: Check("", "", {}, 0.0))
    ball = {"type": "scene", "ball": {"type": "sphere"}, "sensor": {"type": "perspective"}}
    mrt.check_scene(ball, integrator="direct", width=20, height=30)
    assert seen == [("DirectIntegrator", [20, 30])]
    with pytest.raises(TypeError, match="widht"):
        mrt.check_scene(3, widht=80)


def lamp(members):
    """Register a lamp that shines with 3 to its front, with faulty members."""

    class Lamp(mi.Emitter):
        brighter = 1.0  # as it is seen
        denser = 1.0  # than its samples are

        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.m_flags = mi.EmitterFlags.Surface

        def eval(self, si, active=True):
            return mi.Spectrum(dr.select(active & (si.wi.z > 0), 3 * self.brighter, 0))

        def sample_direction(self, it, sample, active=True):
            ds = self.get_shape().sample_direction(it, sample, active)
            ds.pdf *= self.denser
            ds.emitter = mi.EmitterPtr(self)
            lit = active & (dr.dot(ds.d, ds.n) < 0) & (ds.pdf > 0)
            return ds, mi.Spectrum(dr.select(lit, 3 / ds.pdf, 0))

        def pdf_direction(self, it, ds, active=True):
            return self.denser * self.get_shape().pdf_direction(it, ds, active)

        def eval_direction(self, it, ds, active=True):
            return mi.Spectrum(dr.select(active & (dr.dot(ds.d, ds.n) < 0), 3, 0))

        def to_string(self):
            return "Lamp"

    mi.register_emitter("lamp", type("Faulty", (Lamp,), members))
    return {"type": "lamp"}


def seen_from_behind(self, si, active=True):
    return mi.Spectrum(3)


def infinite_at_grazing_angles(self, si, active=True):
    bright = dr.select(si.wi.z < 0.02, dr.inf, 3)
    return mi.Spectrum(dr.select(si.wi.z > 0, bright, 0))


LAMPS: dict[str, tuple[dict[str, Any], set[str]]] = {
    "sound": ({}, set()),
    "seen 1.5 times as bright": ({"brighter": 1.5}, {"sampling.light", "weights.seen"}),
    "seen from behind": ({"eval": seen_from_behind}, {"weights.seen"}),
    "half of the density": ({"denser": 0.5}, {"sampling.light"}),
    "1.2 times the density": ({"denser": 1.2}, {"sampling.light"}),
    "infinite at grazing angles": ({"eval": infinite_at_grazing_angles}, {"finite.seen"}),
}


@pytest.mark.parametrize("shape", ["rectangle", "sphere", "disk", ""])
@pytest.mark.parametrize("fault", LAMPS)
def test_lamps_on_surfaces(fault, shape):
    """Also flat ones along an axis, and one that is given without its shape."""
    members, figures = LAMPS[fault]
    light = lamp(members)
    found = mrt.check_emitter({"type": shape, "light": light} if shape else light, quick=True)
    assert figures <= exceeded(found) <= figures | {"sampling.light"}, str(found)
    assert found.passed == (not figures)
    assert not any(law.skipped for law in found.laws.values())


EMITTERS: dict[str, dict[str, Any]] = {
    "point": {"position": [1, 2, 3]},
    "spot": {"cutoff_angle": 40.0},
    "directional": {"direction": [0, 0, -1]},
    "constant": {},
    "envmap": {},
    "sunsky": {"sun_direction": [0.3, 0.9, 0.1]},
    "mrt_light": {"position": [1, 2, 3]},
    "area": {},
    "projector": {},
}


LONG = (("sunsky", "llvm_ad_rgb"), ("envmap", "scalar_rgb"), ("envmap", "llvm_ad_spectral"))


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        *((name, "llvm_ad_rgb") for name in EMITTERS if name != "sunsky"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in LONG),
    ],
    indirect=["variant"],
)
def test_emitters_by_themselves(name, variant, tmp_path):
    parameters = dict(EMITTERS[name])
    if name == "envmap":
        parameters["bitmap"] = mi.Bitmap(SUN)
    if name == "projector":
        parameters["irradiance"] = {"type": "bitmap", "bitmap": mi.Bitmap(SUN), "raw": True}
    check = mrt.check_emitter({"type": name, **parameters}, quick=True)
    known = ["finite"] if name == "projector" else []  # its eval_direction() is negative behind it
    assert check.failed == known, str(check)
    assert list(check.laws) == list(emitters.LAWS)
    assert not check.laws["weights"].skipped  # some of the points are lit
    check.save(tmp_path)
    assert name in (tmp_path / "index.html").read_text()


def test_an_emitter_of_a_loaded_scene():
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "light": {"type": "area"}}})
    (emitter,) = scene.emitters()
    assert mrt.check_emitter(emitter, scene=scene, quick=True).passed
    with pytest.raises(mrt.UsageError, match="give the scene that it belongs to"):
        mrt.check_emitter(emitter, quick=True)


@pytest.mark.parametrize("given", [{"type": "sphere"}, {"type": "diffuse"}, 3])
def test_what_is_no_emitter(given):
    with pytest.raises(mrt.UsageError, match="is not an emitter"):
        mrt.check_emitter(given)


def test_a_scene_without_shapes_is_checked():
    nodes = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    assert mrt.check_scene(nodes | {"integrator": {"type": "path"}}, quick=True).passed


@pytest.mark.parametrize("folder", ["", "laws.csv/x", "a\0"])
def test_a_page_that_cannot_be_written(tmp_path, folder):
    """Whole or not at all, and by one error."""
    (tmp_path / "laws.csv").mkdir()
    found = mrt.check_bsdf({"type": "diffuse"}, quick=True, only=["energy"])
    (tmp_path / "laws.csv" / "x").touch()
    with pytest.raises(OutputError, match=r"cannot (make|write)"):
        found.save(tmp_path / folder)
    assert [path.name for path in tmp_path.iterdir()] == ["laws.csv"]
