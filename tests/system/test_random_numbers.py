"""Random numbers of a render: every ray has its own, in all passes, frames, rounds and parts."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases

import mrt_mitsuba as mrt
from mrt_mitsuba.rendering import exposing, whole
from mrt_mitsuba.rendering.film import derived_seed

pytestmark = pytest.mark.usefixtures("variant")

SIZE = {"width": 24, "height": 18}
MOVING = {"motion": (0.2, 0, 0), "motionsamples": 4}
STEPS = 2**24  # numbers in [0, 1) that a sampler draws


def recorder() -> Any:
    """An integrator that sees black or white by chance; ``drawn`` has the numbers of each ray, 48 bits."""

    class Draws(mi.SamplingIntegrator):
        def __init__(self, props: mi.Properties) -> None:
            mi.SamplingIntegrator.__init__(self, props)
            self.drawn: list[np.ndarray] = []

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            first, second = np.array([sampler.next_1d(), sampler.next_1d()], np.float64)
            self.drawn.append(first * STEPS**2 + second * STEPS)
            return mi.Spectrum(mi.Float(np.floor(first + 0.5))), mi.Bool(True), []

        def to_string(self) -> str:
            return "Draws[]"

    return Draws(mi.Properties())


REPORT = {"lattice": "report"}
REFINED = {"aamode": "luma", "aa": 2}
passes = Cases()
passes({"aamode": "none", "aa": 3, **REPORT}, name="lattice")
passes({**REFINED, **REPORT}, name="lattice, refined")
passes({**REFINED, **REPORT, **MOVING}, name="lattice, refined frame by frame")
passes({**REFINED, "spp": 2}, name="film, refined")
passes({"aamode": "none", "aa": 1, "spp": 3, **MOVING}, name="moments")
passes({"aamode": "noise", "spp": 32}, name="rounds")
passes({"aamode": "none", "aa": 1, "spp": 4, "sampler": "stratified"}, name="film, strata")
passes({**REFINED, "spp": 4, "sampler": "multijitter"}, name="film, refined, jitter")


@pytest.mark.parametrize("at_once", [2**24, 500])
@pytest.mark.parametrize("options", passes)
def test_no_two_rays_draw_the_same(options, at_once, monkeypatch):
    """Of some thousand rays, with seeds that follow each other, two have the same 48 bits by chance once in a
    million such tests."""
    monkeypatch.setattr(exposing, "wavefront_size", lambda space, channels: at_once)
    nodes = mrt.scene_dict(0, **SIZE)
    nodes["sensor"]["sampler"] = {"type": options.get("sampler", "independent"), "sample_count": 4}
    scene = mi.load_dict(nodes)
    integrator = recorder()
    options = {name: value for name, value in options.items() if name != "sampler"}
    rays = [mrt.render(scene, integrator=integrator, seed=n, **options).rays["primary"] for n in (0, 1, 2)]
    drawn = np.concatenate(integrator.drawn)
    assert len(drawn) == sum(rays) > 3 * 24 * 18
    assert len(np.unique(drawn)) == len(drawn)


def test_seeds_of_parts_differ():
    """From each other, whatever the names and numbers, and from those of other seeds; 16,000 hashes of 32
    bits are all different in 97 % of such lists."""
    seeds = [
        derived_seed(seed, frame=frame, refinement=refinement, repeat=repeat)
        for seed, frame, refinement, repeat in np.ndindex(100, 20, 2, 4)
    ]
    assert len(set(seeds)) == len(seeds)
    assert [derived_seed(seed, frame=0) for seed in (0, 7)] == [0, 7]
    assert derived_seed(5, frame=2) == derived_seed(5, refinement=0, frame=2) < 2**32
    assert derived_seed(derived_seed(0, repeat=1), frame=1) != derived_seed(
        derived_seed(0, frame=1), repeat=1
    )


def test_parts_of_a_whole_picture_draw_numbers_of_their_own(monkeypatch):
    """Light tracing renders a picture in parts that fit into memory; equal ones would add nothing."""
    box = mi.cornell_box()
    box["sensor"]["film"] |= SIZE
    scene = mi.load_dict(box)
    options = {"integrator": "ptracer", "aamode": "none", "seed": 3}
    few = mrt.render(scene, spp=8, **options)
    monkeypatch.setattr(whole, "wavefront_size", lambda space, channels: few.rays["primary"])
    many = mrt.render(scene, spp=16, **options)
    assert many.rays["primary"] == 2 * few.rays["primary"]
    assert not np.allclose(many.image, few.image, rtol=1e-4)
    more = mrt.render(scene, spp=20, **options)  # the last part is half as large, and counts half
    assert more.image.mean() == pytest.approx(few.image.mean(), rel=0.05)
