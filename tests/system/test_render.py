"""``mrt.render`` end to end: what it traces and leaves out, and that the picture does not depend on how."""

from __future__ import annotations

import gc
import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import Cases
from numpy.testing import assert_allclose

import mrt_mitsuba as mrt
from mrt_mitsuba.files import LAYERS

SMALL = {"width": 80, "height": 60}


pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("number", [0, 3])
def test_none_traces_the_whole_lattice_in_few_kernels(number):
    mrt.render(number, **SMALL, aa=3, aamode="none", focaldist=0)
    result = mrt.render(number, **SMALL, aa=3, aamode="none", focaldist=0, count_rays=True)
    assert result.rays["primary"] == 80 * 60 * 9
    # one kernel for all rays, one for the means; loading a scene may fill small tables
    assert result.kernel_launches <= 6
    assert np.isfinite(result.image).all()


def test_rays_are_counted_as_the_scene_tells():
    """One sphere, one light, nothing reflective: shadow rays only where the light is in front."""
    nodes = mrt.scene_dict(0, **SMALL)
    kept = {name: nodes[name] for name in ("type", "integrator", "sensor", "sky", "light_0")}
    ball = {**nodes["sphere_0"], "bsdf": {"type": "mrt_bsdf", "specular_reflectance": 0.0}}
    result = mrt.render({**kept, "ball": ball}, aa=1, aamode="none", count_rays=True, layers=["depth"])
    hits = np.isfinite(result.layers["depth.Z"]).sum()
    assert result.rays["mirror"] == 0
    assert 0 < result.rays["shadow"] < hits


def test_rendering_leaves_no_scene_behind():
    """Integrator and scene must not own each other: Mitsuba's shapes would pile up in every later kernel."""

    ids = []
    for _ in range(3):
        gc.collect()  # and what earlier tests left
        scene = mi.load_dict(mrt.scene_dict(0, width=16, height=12))
        mrt.render(scene, aa=1, aamode="none")
        ids.append(int(np.max(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))))
        del scene
    assert ids[0] == ids[2]


MOVING = {"motion": (0.1, 0, 0), "motionsamples": 4}
counted = Cases()
counted({"spp": 60, "integrator": "path"}, name="film")  # of which its sampler makes 64
counted({"aamode": "none", "aa": 3, "spp": 2, "lattice": "report"}, name="lattice")
counted({"aamode": "luma", "aa": 2, "lattice": "report"}, name="refined")
counted({"aamode": "luma", "aa": 2, "spp": 2, "integrator": "path"}, name="film, refined")
counted({"aamode": "luma", "aa": 2, "lattice": "report", **MOVING}, name="frames")
counted({"aamode": "none", "aa": 1, "lattice": "report", **MOVING}, name="moments")
counted({"spp": 4, "integrator": "ptracer"}, name="whole")
counted({"spp": 16, "aamode": "noise", "integrator": "path"}, name="adaptive")


@pytest.mark.parametrize("options", counted)
def test_samples_counts_the_rays_of_each_pixel(options):
    nodes = mrt.scene_dict(0, width=24, height=18, flavor="stock")
    nodes["sensor"]["film"]["rfilter"] = {"type": "box"}
    nodes["sensor"]["sampler"] = {"type": "stratified"}
    nodes["lamp"] = {"type": "sphere", "center": [0, 9, 0], "emitter": {"type": "area"}}
    result = mrt.render(nodes, **{"layers": ["samples"], "focaldist": 0, **options})
    assert result.layers["samples.Y"].sum() == result.rays["primary"]


@pytest.mark.parametrize("other_variant", ["llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_mono_polarized"])
def test_other_variants_show_the_same_scene(other_variant):
    """Spectral rendering upsamples colours and draws wavelengths: luminance agrees to a few percent."""
    options = {"width": 32, "height": 24, "aa": 4, "aamode": "none", "focaldist": 0}
    rgb, other = (mrt.render(0, **options, variant=each).image for each in ("llvm_ad_rgb", other_variant))
    weights = [0.2126, 0.7152, 0.0722]
    assert (other @ weights).mean() == pytest.approx((rgb @ weights).mean(), rel=0.05)


layers = Cases()
layers({}, {"error", "variance"})
layers({"aamode": "none"}, {"error", "variance", "edges"})
layers({"target": 0.1}, {"edges"})
layers({"aamode": "noise", "lattice": "film", "spp": 16}, {"edges"})
layers({"integrator": "direct"}, {"error", "variance", "direct", "reflection", "bounces"})


@pytest.mark.parametrize(
    ("options", "missing"),
    layers,
    ids=lambda x: ",".join(sorted(x)),
)
def test_all_layers_are_those_that_can_be_made(options, missing):
    missing = missing | {"noisy", "denoised"}  # of denoise=True alone
    result = mrt.render(3, width=16, height=12, layers="all", **options)
    assert {channel.split(".")[0] for channel in result.layers} == LAYERS.keys() - missing
    assert LAYERS.keys() - set(result.options["layers"]) == missing


def test_pictures_that_a_numbered_scene_shows_are_inputs_each_time():
    """None may be overwritten."""
    for _ in range(2):
        inputs = mrt.render(8, width=16, height=12, aa=1).inputs
        assert [os.path.basename(path) for path in inputs] == ["block.png"]


def test_layers_belong_together():
    layers = ["direct", "reflection", "bounces", "normal", "albedo"]
    channels = mrt.render(3, **SMALL, aa=2, aamode="none", layers=layers).layers
    total = np.stack([channels[f"direct.{c}"] + channels[f"reflection.{c}"] for c in "RGB"], -1)
    unblurred = mrt.render(3, **SMALL, aa=2, aamode="none", focaldist=0).image
    assert_allclose(total, unblurred, atol=1e-6)
    length = np.sqrt(sum(channels[f"normal.{c}"] ** 2 for c in "XYZ"))
    hit = np.isfinite(channels["depth.Z"])
    assert_allclose(length[hit], 1, atol=1e-6)
    assert np.all(length[~hit] == 0)
    assert channels["bounces.Y"].max() > 1


def test_depth_is_the_distance_from_the_eye():
    """The middle of scene 0 looks from (3, 1, 0) at (0, 0.3, 0), over the spheres, and meets y = 0."""
    result = mrt.render(0, width=101, height=75, aa=1, aamode="none", layers=["depth"])
    descent = 0.7 / np.hypot(3, 0.7)  # for each unit along the ray
    # the eye is one unit up; float32 camera rays are good to a few 1e-7
    depth = result.layers["depth.Z"]
    assert depth[37, 50] == pytest.approx(1 / descent, rel=1e-6)
    assert np.isinf(depth[0]).all()  # the sky


@pytest.mark.parametrize("aa", [2, 3, 4])
def test_samples_of_the_centered_lattice_are_the_centres_of_smaller_pixels(aa):
    options = {"aamode": "none", "lattice": "centered", "focaldist": 0}
    coarse = mrt.render(1, width=40, height=30, aa=aa, **options).image
    fine = mrt.render(1, width=40 * aa, height=30 * aa, aa=1, **options).image
    expected = fine.reshape(30, aa, 40, aa, 3).mean((1, 3))
    # the same rays, but for roundings that move one across an edge here and there
    assert np.quantile(np.abs(coarse - expected), 0.99) < 1e-4
