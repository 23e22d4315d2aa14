"""Against the original program's own pictures: as shortened in ``data``, and whole where at hand."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.filters import luma_edges, sobel_edges
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.originals import read_original

# Mean absolute difference, and share of pixels off by more than 1/255, without detector or blur. Ours are off
# at the borders of shadows, where the original's rays start a fixed distance off the surface and speckle
OURS = {0: (1e-5, 0.001), 1: (6e-5, 0.005), 2: (6e-5, 0.005), 3: (2e-5, 0.005), 4: (3e-4, 0.025)}
# Of the float64 reference: what the original's float32 and its speckles leave, nearly all near terminators
FLOAT64 = {0: (1e-6, 0.0002), 1: (4e-5, 0.003), 2: (4e-5, 0.003), 3: (1e-5, 0.001), 4: (3e-4, 0.01)}
DETECTORS = {"luma": luma_edges, "sobel": sobel_edges}
MODES = "0_luma_aa4 1_sobel_aa4 2_luma_aa4 2_sobel_aa4_dof 3_none_aa1 3_sobel_aa4 3_default 4_default"
NAMES = [f"s{mode}" for mode in (*(f"{number}_none_aa4" for number in OURS), *MODES.split())]
SHORTENED = Path(__file__).parent / "data"
WHOLE = Path(os.environ.get("MRT_REFERENCE", Path(__file__).parents[3] / "shared" / "reference")) / "renders"
FOLDERS = {"whole": WHOLE, "shortened": SHORTENED}

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(params=[kind for kind, folder in FOLDERS.items() if folder.is_dir()])
def originals(request: pytest.FixtureRequest) -> Path:
    """The folder of the original's pictures."""
    return FOLDERS[request.param]


def test_what_is_committed_is_small() -> None:
    assert sum(path.stat().st_size for path in SHORTENED.iterdir()) <= 400_000


@pytest.mark.parametrize("name", NAMES)
def test_render_gives_the_same_picture(name: str, originals: Path) -> None:
    original = read_original(originals / f"{name}.exr")
    ours = mrt.render(original.scene, fresnel="dielectric", **original.options)
    difference = np.abs(original.like(ours.image) - original.image)
    mean, share = OURS[original.scene]
    # a detector decides by the last bit of a grey value, and the blur spreads a wrong pixel over its window.
    # In a window, borders of shadows may take up three times their share of the picture
    slack = 1 if original.options["aamode"] == "none" else 3
    slack *= 3 if original.window[2:] != (320, 240) else 1
    assert difference.mean() <= slack * mean
    assert (difference.max(axis=-1) > 1 / 255).mean() <= slack * share


@functools.cache  # the whole original and the shortened one are compared with the same picture
def reference_picture(number: int) -> np.ndarray:
    """The float64 reference's picture of a scene of the report, one pixel in 4. [120, 160, 3]"""
    corner = (-0.25, -0.25)  # from the middle of four pixels to the lower left one
    return reference_render(report_scene(number), width=160, height=120, displacement=corner)


@pytest.mark.parametrize("number", [0, 1, 2, 3, pytest.param(4, marks=pytest.mark.slow), 9])
def test_the_reference_gives_the_same_picture(number: int, originals: Path) -> None:
    """One pixel in 4; of scene 9, whose cone is broken in the original, the floor far from it and its
    shadow."""
    original = read_original(originals / f"s{number}_none_aa1.exr")
    whole = np.repeat(np.repeat(reference_picture(number), 2, axis=0), 2, axis=1)
    error = np.abs(original.like(whole) - original.image)[1::2, ::2]
    step = 2.0 ** (1 - original.bits)  # of a value of one, as it is stored
    if number == 9:
        assert np.median(error[-16:]) <= 1e-6 + step  # mostly floor
        return
    mean, share = FLOAT64[number]
    slack = 3 if len(original.image) < 240 else 1
    assert error.mean() <= slack * mean and (error.max(axis=-1) > 1 / 255).mean() <= slack * share
    # no exp, no mirror, no clamp wrong anywhere: nine pixels in ten agree to a few roundings of float32
    assert np.quantile(error.max(axis=-1), 0.9) <= 2e-5 + step


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("scene", [0, 1, 2, 3, 4, 9])
def test_the_same_pixels_are_refined(scene: int, detector: str, originals: Path) -> None:
    """A refined pixel is that of the fully supersampled picture, any other that of the plain one."""
    plain = read_original(originals / f"s{scene}_none_aa1.exr")
    mask = np.asarray(DETECTORS[detector](plain.image).mask)
    if plain.layers:  # 1 where a pixel was refined, 0 where not, 0.5 where that cannot be told
        refined, inside = plain.layers[f"{detector}.Y"], np.s_[1:-1, 1:-1]  # the rim has other neighbours
        told = refined[inside] != 0.5
        np.testing.assert_array_equal(mask[inside][told], refined[inside][told])
        assert told.mean() > 0.5 and not mask[inside].all()
        assert mask[inside].any() or (scene, detector) == (9, "luma")  # whose window is a floor
        return
    full, adaptive = (read_original(originals / f"s{scene}_{m}_aa4.exr").image for m in ("none", detector))
    np.testing.assert_array_equal(adaptive, np.where(mask[..., None], full, plain.image))
    telling = (plain.image != full).any(axis=-1)
    assert telling.mean() > 0.99 and mask[telling].any() and not mask[telling].all()
