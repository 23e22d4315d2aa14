"""``mrt_adaptive`` under ``mi.render``, in files and in the command; every integrator in ``mrt.render``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import Cases

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")

SCENE = """<scene version="3.0.0">
  <integrator type="mrt_adaptive"><float name="target" value="0.02"/>{nested}</integrator>
  <sensor type="perspective">
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/>{film}</film>
  </sensor>
  <shape type="sphere" id="ball"><transform name="to_world"><translate z="4"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7 0.5 0.3"/></bsdf></shape>
  <shape type="rectangle"><emitter type="area"><rgb name="radiance" value="9"/></emitter>
    <transform name="to_world"><rotate x="1" angle="90"/><translate y="3" z="3"/></transform></shape>
</scene>"""
PATH = '<integrator type="path"/>'
PRB = '<integrator type="prb"/>'
AOV = '<integrator type="aov"><string name="aovs" value="far:depth"/><integrator type="path"/></integrator>'
CROP = '<integer name="crop_width" value="9"/><integer name="crop_offset_x" value="7"/>'
RGBA = '<string name="pixel_format" value="rgba"/><rfilter type="box"/>'
GREY = '<string name="pixel_format" value="luminance"/><boolean name="sample_border" value="true"/>'


def scene_with(nested: str = PATH, film: str = "") -> Any:
    return mi.load_string(SCENE.format(nested=nested, film=film))


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


films = Cases()
films(PATH, "", ["R", "G", "B", "error.Y", "samples.Y"])
films(PATH, CROP + GREY, ["Y", "error.Y", "samples.Y"])
films(PATH, RGBA, ["R", "G", "B", "A", "error.Y", "samples.Y"])
films(PRB, "", ["R", "G", "B", "error.Y", "samples.Y"])
films(AOV, CROP + RGBA, None)


@pytest.mark.parametrize(("nested", "film", "channels"), films)
def test_the_film_of_a_scene_is_filled_to_an_error(nested, film, channels):
    scene = scene_with(nested, film)
    adaptive = scene.integrator()
    picture = np.array(mi.render(scene, seed=3))
    bitmap = scene.sensors()[0].film().bitmap()
    names = [field.name for field in bitmap.struct_()]
    assert channels is None or names == channels
    for channel in (0, -1):
        assert np.array_equal(np.atleast_3d(bitmap)[..., channel], picture[..., channel])
    stock = np.array(mi.render(scene, integrator=adaptive.nested, spp=2048))
    kept = stock.shape[-1]
    assert picture.shape == (*stock.shape[:2], kept + 2)
    assert names[-2:] == ["error.Y", "samples.Y"]
    error = picture[..., -2]
    samples = picture[..., -1]
    colors = len([name for name in names[:kept] if name in "RGBY"])
    assert rms(picture[..., :colors] - stock[..., :colors]) < 0.03
    assert 0 < rms(error) < 0.03
    assert kept == colors or rms(picture[..., colors:kept] - stock[..., colors:kept]) < 0.2
    assert samples.mean() > 8


def test_rays_are_bounded_and_seeds_matter():
    scene = scene_with()
    few, more = (np.array(mi.render(scene, spp=spp)) for spp in (16, 128))
    assert 8 <= few[..., -1].mean() <= 16 < more[..., -1].mean() <= 128
    again, other = (np.array(scene.integrator().render(scene, seed=seed, spp=16)) for seed in (0, 1))
    assert np.array_equal(few, again)
    assert not np.array_equal(few, other)
    fixed = mi.load_dict({"type": "mrt_adaptive", "spp": 48, "inner": {"type": "path"}})
    assert 40 <= np.array(mi.render(scene, integrator=fixed))[..., -1].mean() <= 48
    bounded = mi.load_dict({"type": "mrt_adaptive", "target": 1e-3, "max_spp": 16, "inner": {"type": "path"}})
    with pytest.warns(UserWarning, match="maxspp=16 ends the render"):
        assert np.array(mi.render(scene, integrator=bounded, spp=128))[..., -1].mean() <= 16
    with pytest.warns(UserWarning, match="takes 8 spp at least, not spp=4"):
        assert np.array(mi.render(scene, spp=4))[..., -1].mean() == 8


@pytest.mark.filterwarnings("ignore::mrt_mitsuba.MrtWarning")
@pytest.mark.parametrize("nested", [PATH, PRB])
def test_derivatives_are_those_of_the_nested_integrator(nested):
    scene = scene_with(nested)
    key = "ball.bsdf.reflectance.value"
    params = mi.traverse(scene)
    found = []
    for integrator in (scene.integrator(), scene.integrator().nested):
        dr.enable_grad(params[key])
        params.update()
        picture = mi.render(scene, params, integrator=integrator, spp=16, seed=2)
        dr.backward(dr.mean(picture[..., :3]))
        found.append(np.array(dr.grad(params[key])).ravel())
        dr.set_grad(params[key], 0)
    assert np.allclose(*found, rtol=1e-4)
    assert (found[0] > 0).all()


def test_files_and_the_command_know_it(tmp_path, monkeypatch):
    from mrt_mitsuba.command.main import main

    monkeypatch.chdir(tmp_path)
    Path("a.xml").write_text(SCENE.format(nested=PATH, film=""))
    picture = np.array(mi.render(mi.load_file("a.xml"), seed=1))
    result = mrt.render("a.xml", seed=1)
    assert np.allclose(result.image, picture[..., :3], atol=1e-6)
    assert result.error.rmse < 0.03
    assert main(["out", "scene=a.xml"]) == 0
    assert list(mi.Bitmap("out.exr").size()) == [24, 16]


def test_a_target_needs_an_integrator_of_rays():
    """Light tracing has no rays of pixels to share out: it is rendered with spp."""
    for options in ({"target": 0.05}, {"aamode": "noise", "spp": 64}):
        with pytest.raises(mrt.UsageError, match=r"(target=0.05|aamode=noise): .*Particle.* whole pictures"):
            mrt.render(scene_with(), integrator="ptracer", **options)
    with pytest.raises(RuntimeError, match="mrt_adaptive: ParticleTracerIntegrator gives whole pictures"):
        scene_with('<integrator type="ptracer"/>')


@pytest.mark.parametrize("name", ["prb", "prb_basic", "prbvolpath", "direct_projective", "prb_projective"])
def test_every_integrator_gives_pictures_with_their_error(name):
    scene = scene_with()
    integrator = mi.load_dict({"type": name})
    stock = np.array(mi.render(scene, integrator=integrator, spp=1024))[..., :3]
    assert rms(mrt.render(scene, integrator=integrator, spp=256).image - stock) < 0.1
    result = mrt.render(scene, integrator=integrator, target=0.05, maxspp=512)
    assert rms(result.image - stock) < 0.1
    assert 0 < result.error.low < result.error.rmse < 0.08
    assert result.rounds[-1].rmse == result.error.rmse
    assert result.error.high > result.error.rmse
