"""Pictures on a device, against the scalar variants: of make device-check on a GPU, else in LLVM."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt

SIZE = {"width": 16, "height": 12}
# Float32 in another order of operations; at edges and in narrow highlights a rounding can turn a pixel
NOISE = 2e-4
TURNED = 0.02


def different(a: np.ndarray, b: np.ndarray) -> float:
    """The share of the pixels that are not the same."""
    a, b = (np.nan_to_num(x, posinf=1e6) for x in (a, b))
    return float((np.abs(a - b).max(axis=-1) > NOISE * (1 + np.abs(b).max(axis=-1))).mean())


LAYERS = {"layers": ["depth", "bounces"]}
MOVING = {"motion": (0.3, 0.1, 0.4), "motionsamples": 4}


@pytest.mark.parametrize(
    ("variant", "number", "more"),
    [
        *(("llvm_ad_rgb", number, LAYERS) for number in (3, 4, 9)),
        ("llvm_ad_spectral", 3, {}),
        (
            "llvm_ad_rgb",
            0,
            {"integrator": "path", "spp": 2, "seed": 3, **MOVING},
        ),  # by random numbers and times
    ],
    indirect=["variant"],
)
def test_pictures_are_those_of_the_scalar_variant(number, variant, more):
    options = {"aa": 1, "aamode": "none", "focaldist": 0, **SIZE, **more}
    result = mrt.render(number, variant=variant, **options)
    truth = mrt.render(number, variant="scalar_" + variant.split("_")[-1], **options)
    assert different(result.image, truth.image) <= TURNED
    for name, layer in truth.layers.items():
        assert different(result.layers[name][..., None], layer[..., None]) <= TURNED
    assert different(result.image[::-1], truth.image) > TURNED  # the measure can tell


@pytest.mark.parametrize("variant", ["llvm_ad_rgb"], indirect=True)
def test_filters_and_updates_on_a_device(variant):
    """Tables made of NumPy's arrays, ids of shapes and sizes that the host reads are what could go wrong."""
    scene = mi.load_dict(mrt.scene_dict(3, **SIZE))
    before = [mrt.render(scene, aa=2, lattice="report", focaldist=2.0).image for _ in range(3)]
    assert np.array_equal(before[0], before[1])
    assert np.array_equal(before[1], before[2])
    parameters = mi.traverse(scene)
    key = next(k for k in list(parameters.keys()) if k.endswith("alpha"))
    parameters[key] = mi.Float(0.4)
    parameters.update()
    after = mrt.render(scene, aa=2, lattice="report", focaldist=2.0).image
    assert np.isfinite(after).all()
    assert not np.array_equal(after, before[0])
