"""``mrt_texture`` and ``mrt_mesh``: look-ups as in the report, and meshes from arrays."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from mrt_mitsuba.scene.model import Camera, Material, Scene, Sphere

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def picture(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A PNG file of random colours, 7 wide and 5 high, and its values."""
    values = np.random.default_rng(1).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    Image.fromarray(values).save(tmp_path / "picture.png")
    return tmp_path / "picture.png", values


def look_up(texture, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    si = dr.zeros(mi.SurfaceInteraction3f, len(u))
    si.uv = mi.Point2f(u, v)
    return texture.eval(si).numpy().T


def expected(values: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The report's look-up, as it words it."""
    height, width, _ = values.shape
    x = ((width - 1) * np.clip(u, 0, 1) + 0.5).astype(int) % width
    y = ((height - 1) * np.clip(v, 0, 1) + 0.5).astype(int) % height
    return values[y, x] / 255


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
def test_look_up_is_the_report_s(picture, variant):
    path, values = picture
    count = 10_000 if variant.startswith("llvm") else 20
    places = np.random.default_rng(2).uniform(-0.5, 1.5, (2, count)).astype(np.float32)
    u, v = np.hstack([places, np.float32([[0, 1, 0, 1], [0, 0, 1, 1]])])  # and the corners
    for source in ({"filename": str(path)}, {"bitmap": mi.Bitmap(values)}):
        texture = mi.load_dict({"type": "mrt_texture", **source})
        if variant.startswith("llvm"):
            got = look_up(texture, u, v)
        else:
            si = dr.zeros(mi.SurfaceInteraction3f)
            got = []
            for si.uv in zip(u.tolist(), v.tolist(), strict=True):
                got.append(list(texture.eval(si)))
        # Texels are stored in float32, 1/255 rounded once
        assert_allclose(got, expected(values, u, v), atol=1e-7)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"], indirect=True)
def test_means_are_as_bright_as_pictures(variant):
    """Also above 1, where textures of spectra end."""
    one, two = (mi.Bitmap(np.full((2, 2, 3), value, np.float32)) for value in (1.5, 3))
    means = [mi.load_dict({"type": "mrt_texture", "bitmap": bitmap}).mean() for bitmap in (one, two)]
    assert_allclose(means[1], 2 * np.array(means[0]), rtol=1e-6)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA"])
def test_other_kinds_of_pictures(tmp_path, mode):
    values = np.tile(np.array([[0, 80], [160, 240]], np.uint8)[:, :, None], (1, 1, 3))
    image = Image.fromarray(values).convert(mode)
    image.save(tmp_path / "grey.png")
    u = np.array([0, 1, 0, 1], np.float32)
    v = np.array([0, 0, 1, 1], np.float32)
    got = look_up(mi.load_dict({"type": "mrt_texture", "filename": str(tmp_path / "grey.png")}), u, v)
    assert_allclose(got[:, 0] * 255, np.array(image.convert("L")).ravel(), atol=1e-4)


def test_standard_texturing_is_bilinear_and_decodes_srgb(picture):
    path, values = picture
    ball = Sphere((0, 0, 0), 1.0, Material(1.0, 0.5, (0, 0, 0), (0.5, 0.5, 0.5), str(path)))
    scene = Scene(Camera((0, 0, 2), (0, 0, 0)), (0, 0, 0), (), spheres=(ball,), texturing="standard")
    shape = mi.load_dict(scene.to_dict()).shapes()[0]
    decoded = ((values[2, :2] / 255 + 0.055) / 1.055) ** 2.4
    assert values[2, :2].min() > 0.04045 * 255
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.uv = mi.Point2f(1 / 7, 0.5)  # between two texels of the middle row
    si.shape = mi.ShapePtr(shape)
    between = shape.bsdf().eval_diffuse_reflectance(si).numpy()[:, 0]
    # texels in half precision or 8 bits
    assert_allclose(between, decoded.mean(axis=0), atol=2e-3)
