"""Channels and integrators of the user's own, by any name, or by none: every door gives them back."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import sensor
from numpy.testing import assert_allclose

import mrt_mitsuba as mrt

pytestmark = pytest.mark.usefixtures("variant")


def scene(integrator: dict[str, Any], size: tuple[int, int] = (8, 6)) -> mi.Scene:
    nodes: dict[str, Any] = {"type": "scene", "integrator": integrator, "sky": {"type": "constant"}}
    nodes["ball"] = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 0.4}}
    return mi.load_dict(nodes | {"sensor": sensor([0, 1, 6], [0, 0, 0], size, fov=25)})


def of_the_user(names: str) -> dict[str, Any]:
    """An integrator as in tutorials, whose channels hold 1, 2, ...; like most, it has no ``to_string``."""

    class Named(mi.SamplingIntegrator):  # of the current variant
        def __init__(self, props: mi.Properties) -> None:
            mi.SamplingIntegrator.__init__(self, props)
            self.names = props["names"].split()

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> tuple:
            values = [mi.Float(1 + k) for k in range(len(self.names))]
            return mi.Spectrum(0.25), mi.Bool(True), values

        def aov_names(self) -> list[str]:
            return self.names

    mi.register_integrator("named", Named)
    return {"type": "named", "names": names}


NAMES = [
    "square.Y",
    "square image",
    "image.R image.G image.B",
    "error.Y samples.Y",
    "variance.R depth.Z noise",
]
OPTIONS: list[dict[str, Any]] = [{"spp": 4}, {"layers": "all"}, {"target": 0.1, "maxspp": 16}]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("names", NAMES)
def test_names_of_the_user_win(names, options):
    result = mrt.render(scene(of_the_user(names)), **options)
    assert_allclose(result.image, 0.25, rtol=1e-5)
    for k, name in enumerate(names.split()):
        assert_allclose(result.layers[name], 1 + k, rtol=1e-5)


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
def test_names_of_the_user_win_inside_mrt_adaptive(variant, names):
    inside = {"type": "mrt_adaptive", "target": 0.1, "max_spp": 16, "nested": of_the_user(names)}
    loaded = scene(inside)
    picture = np.array(mi.render(loaded))
    count = len(names.split())
    assert_allclose(
        picture[..., 3 : 3 + count], np.ones((*picture.shape[:2], 1)) * range(1, 1 + count), rtol=1e-5
    )
    own = {"error.Y", "samples.Y"} - set(names.split())
    assert picture.shape[2] == 3 + count + len(own)
    assert "Named" in str(loaded.integrator())


@pytest.mark.parametrize("name", ["variance", "error", "samples", "image", "albedo"])
@pytest.mark.parametrize("options", [{}, *OPTIONS], ids=str)
def test_channels_of_aov_keep_their_values(name, options):
    """The variance of the noise came back as the albedo."""
    inner = {"type": "aov", "aovs": f"{name}:albedo", "inner": {"type": "path"}}
    layers = mrt.render(scene(inner), **options).layers
    albedo = np.stack([layers[f"{name}.{letter}"] for letter in "RGB"], -1)
    assert albedo.max() == pytest.approx(0.4, abs=1e-5)
    assert albedo.min() == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("options", [{}, *OPTIONS], ids=str)
@pytest.mark.parametrize("name", [*"RGBAW", "d.T", "d.B"])
def test_channels_of_one_name_are_refused(name, options):
    """One of the two was lost. Films have some of their own; Mitsuba's refuse others like these."""
    integrator = of_the_user(f"a {name}")
    if "." in name:
        aovs = "d:depth,d:depth" if name == "d.T" else "d:albedo,d:albedo"
        integrator = {"type": "aov", "aovs": aovs, "inner": {"type": "path"}}
    with pytest.raises(mrt.MrtError, match=r"several channels named [RGBAWd.T]+; name each diff"):
        mrt.render(scene(integrator), **options)


@pytest.mark.parametrize(
    "inner", [{}, {"x": {"type": "path"}}, {"x": {"type": "direct"}, "y": {"type": "path"}}]
)
@pytest.mark.parametrize("pixel_format", ["rgb", "rgba", "luminance"])
def test_mrt_adaptive_shows_of_aov_what_mitsuba_shows(inner, pixel_format):
    """Without an integrator, ``aov`` has no colours: black ones stood before its channels."""
    aov = {"type": "aov", "aovs": "p:position", **inner}
    loaded = scene({"type": "mrt_adaptive", "spp": 16, "nested": aov})
    eye = sensor([0, 1, 6], [0, 0, 0], (8, 6), fov=25)
    eye["film"]["pixel_format"] = pixel_format
    view = mi.load_dict(eye)
    expected = np.array(mi.render(loaded, sensor=view, integrator=mi.load_dict(aov), spp=64))
    picture = np.array(mi.render(loaded, sensor=view))
    assert picture.shape == (6, 8, expected.shape[2] + 2)
    # 16 rays of a pixel for 64, over 48 pixels of which some lie on the outline
    assert_allclose(picture[..., :-2].mean((0, 1)), expected.mean((0, 1)), atol=0.1)


@pytest.mark.parametrize("options", [{}, {"spp": 4}], ids=str)
@pytest.mark.parametrize("base", ["SamplingIntegrator", "prb"])
def test_an_integrator_may_render_by_itself(base, options):
    """One that overrides ``render`` gives whole pictures, as in ``mi.render``, whatever its base samples."""
    mother = getattr(mi, base, None) or type(mi.load_dict({"type": base}))

    class Gray(mother):  # type: ignore[misc, valid-type]
        def render(self, scene: mi.Scene, sensor: Any = 0, seed: int = 0, spp: int = 0, *_: Any, **__: Any):
            film = (scene.sensors()[sensor] if isinstance(sensor, int) else sensor).film()
            film.prepare([])
            values = mi.TensorXf(np.full((6, 8, 4), [0.5, 0.5, 0.5, 2], np.float32))
            film.put_block(mi.ImageBlock(values, offset=[0, 0], rfilter=film.rfilter(), border=False))
            return film.develop()

    mi.register_integrator("gray", Gray)
    loaded = scene({"type": "gray"})
    assert_allclose(np.array(mi.render(loaded))[..., :3], 0.25)
    assert_allclose(mrt.render(loaded, **options).image, 0.25)
    with pytest.raises(mrt.UsageError, match="gives whole pictures, not single rays"):
        mrt.render(loaded, target=0.1)


@pytest.mark.parametrize("door", ["render", "prepare", "again", "mi.render"])
def test_a_warning_names_the_line_of_the_user(door):
    """That of another file is of no use, and Python shows one warning only for each line."""
    loaded = scene({"type": "path"})
    options = {"target": 1e-6, "maxspp": 16}
    adaptive = mi.load_dict(
        {"type": "mrt_adaptive", "target": 1e-6, "max_spp": 16, "nested": {"type": "path"}}
    )
    with pytest.warns(mrt.MrtWarning, match="target") as warned:
        if door == "render":
            mrt.render(loaded, **options)
        elif door == "mi.render":
            np.array(mi.render(loaded, integrator=adaptive))
        else:
            again = mrt.prepare(loaded, **options)
            if door == "again":
                warned.clear()
                again()
    assert {each.filename for each in warned} == {__file__}
