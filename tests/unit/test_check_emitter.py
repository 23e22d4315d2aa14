"""The laws of emitters, through ``check_scene``: stock ones pass, each mistake fails its own laws."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.validation.checks import scene
from mrt_mitsuba.validation.checks.law import Check

pytestmark = pytest.mark.usefixtures("variant")

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


@pytest.fixture(autouse=True)
def lights_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The square below the light has been checked elsewhere."""
    for name in ("check_bsdf", "check_shape"):
        monkeypatch.setattr(scene, name, lambda *_, **__: Check("", "", {}, 0.0))


def failed(light: dict[str, Any]) -> set[str]:
    """Return the laws that a light fails over a square, as part of a scene."""
    view = mi.ScalarTransform4f().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 6}
    sensor = {"type": "perspective", "to_world": view, "film": film}
    nodes = {"integrator": {"type": "direct"}, "sensor": sensor, "square": {"type": "rectangle"}}
    found = mrt.check_scene({"type": "scene", **nodes, "light": light}, quick=True)
    return {name.split(": ")[1] for name in found.failed if name.startswith("emitter")}


@pytest.mark.parametrize("name", STOCK)
def test_stock_emitters_and_ours(name: str) -> None:
    given = {k: mi.Bitmap(v) if k == "bitmap" else v for k, v in STOCK[name].items()}
    assert not failed({"type": name, **given})


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral"], indirect=True)
def test_other_variants(variant: str) -> None:
    assert not failed({"type": "envmap", "bitmap": mi.Bitmap(SUN)})


# Changes of what ``sample_direction`` gives, and of other functions; and the laws that they break
MISTAKES: dict[str, set[str]] = {
    "none": set(),
    "density x 1.1": {"density", "weights"},
    "pdf_direction x 1.1": {"density", "sampling"},
    "weight x 1.05": {"weights"},
    "seen 0.9 times as bright": {"weights"},
    "eval_direction x 0.9": {"weights"},
    "half of the sky": {"sampling"},
    "wrong distance": {"sampling"},
    "NaN": {"finite"},
    "negative": {"finite", "weights"},
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_fails_its_own_laws(mistake: str) -> None:
    def if_it_is(name: str, wrong: Any, right: Any) -> Any:
        return wrong if mistake == name else right

    class Sky(mi.Emitter):
        def __init__(self, props: Any) -> None:
            mi.Emitter.__init__(self, props)
            self.m_flags = mi.EmitterFlags.Infinite

        def radiance(self, d: Any) -> Any:
            return mi.Spectrum(1 + 0.5 * d.z)

        def eval(self, si: Any, active: Any = True) -> Any:
            return if_it_is("seen 0.9 times as bright", 0.9, 1) * self.radiance(-si.wi)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            half, whole = mi.warp.square_to_uniform_hemisphere, mi.warp.square_to_uniform_sphere
            d = if_it_is("half of the sky", half, whole)(sample)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.d, ds.p, ds.n = d, it.p + 20 * d, mi.Normal3f(-d)
            ds.dist = mi.Float(if_it_is("wrong distance", 5, 20))
            ds.pdf = mi.Float(dr.inv_four_pi * if_it_is("density x 1.1", 1.1, 1))
            ds.emitter = mi.EmitterPtr(self)
            factor = if_it_is("weight x 1.05", 1.05, if_it_is("negative", -1, 1))
            weight = factor * 4 * dr.pi * self.radiance(d)
            return ds, dr.select(if_it_is("NaN", sample.x > 0.99, False), dr.nan, weight)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(dr.inv_four_pi * if_it_is("pdf_direction x 1.1", 1.1, 1))

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return if_it_is("eval_direction x 0.9", 0.9, 1) * self.radiance(ds.d)

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return "Sky"

    mi.register_emitter("sky", Sky)
    assert failed({"type": "sky"}) == MISTAKES[mistake]
