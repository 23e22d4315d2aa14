"""The study against Mitsuba's own plugins, on small pictures, and that its comparisons see mistakes."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies import approximations, stock
from mrt_mitsuba.validation.tools import mutations
from mrt_mitsuba.validation.tools.image_tests import compare

SMALL = {"width": 64, "height": 48}

pytestmark = pytest.mark.usefixtures("variant")

# -------------------------------------------- Direct light --------------------------------------------


@pytest.mark.parametrize(("number", "light"), [(0, 0), (1, 1), (2, 1), (3, 2)])
def test_direct_light_equals_mitsubas_pixel_by_pixel(number: int, light: int) -> None:
    found = stock.compare_direct(report_scene(number), light, **SMALL)
    assert found.unexplained == 0
    assert (found.ours > 0.05).any(axis=-1).mean() > 0.05  # there is something to compare
    assert found.beyond.mean() < 0.1
    # edges and highlights of a hundredth of a pixel: a handful at most
    assert found.off.sum() <= 5


def test_direct_light_of_another_light_is_different() -> None:
    ours = stock.compare_direct(report_scene(0), 0, **SMALL)
    other = dataclasses.replace(report_scene(0).lights[0], position=(10, 10.01, 10))
    theirs = stock.compare_direct(dataclasses.replace(report_scene(0), lights=(other,)), 0, **SMALL)
    error = np.abs(ours.ours - theirs.theirs) / (1 + theirs.theirs)
    assert np.mean(error.max(axis=-1) > stock.DIRECT_TOLERANCE) > 0.2


def test_beyond_its_stand_in_a_plane_is_not_compared() -> None:
    """Scene 0 looks along its floor: a row below the horizon is farther than 50 away."""
    found = stock.compare_direct(report_scene(0), 0, **SMALL)
    rows = np.flatnonzero(found.beyond.any(axis=1))
    assert 1 <= len(rows) <= 3
    assert not found.theirs[found.beyond].any()


# ------------------------------------------ Gloss and lattices ------------------------------------------


def test_gloss_becomes_a_mirror() -> None:
    found = stock.gloss_limit((0.2, 0.02, 0.002), width=32, height=24, spp=32)
    assert found.errors[0] > 0.05
    assert found.errors[-1] < 2e-3
    assert found.slope > 0.9


# ---------------------------------------- Approximations in turn ----------------------------------------


def test_each_approximation_changes_what_it_says() -> None:
    """Scene 1: the clamp matters in highlights, falloff nearly everywhere, and none is the last picture but
    the last."""
    steps = approximations.without_approximations(1, **SMALL, spp=16)
    images = {step.change: step.image for step in steps}
    right = mrt.render(1, **SMALL, aa=1, aamode="none", fresnel="dielectric").image
    assert np.array_equal(images["the report's picture"], right)
    names = list(images)
    change = [np.abs(images[b] - images[a]).max(axis=-1) for a, b in pairwise(names)]
    assert (images["clamp off"] >= images["the report's picture"] - 1e-6).all()
    assert 0.001 < np.mean(change[0] > 1 / 255) < 0.1
    assert np.mean(change[1] > 1 / 255) > 0.3
    assert all(c.max() > 1 / 255 for c in change)


def test_without_what_differs_the_rest_agrees() -> None:
    assert not approximations.compare_rest([3], **SMALL, spp=8)[0].rejects


def test_with_diffuse_parts_the_materials_differ() -> None:
    """The comparison that lets black materials pass sees that roughplastic refracts the diffuse light."""
    scene = approximations.physical(report_scene(3), least_alpha=approximations.ALPHA_FOR_TESTS)
    theirs = mrt.scene_dict(scene, flavor="stock", **SMALL)
    ours = approximations.finite(mrt.scene_dict(scene, fresnel="dielectric", **SMALL), theirs)
    pair = (
        approximations.path_estimate(nodes, spp=4, seed=seed) for nodes, seed in ((ours, 0), (theirs, 100))
    )
    assert compare(*pair).detected_by == ("pixel", "tile", "image")


# ---------------------------------------------- Mutations ----------------------------------------------


def test_every_mistake_is_found_and_nothing_else() -> None:
    found = {trial.mistake: trial.found for trial in mutations.trials((16,), **SMALL)}
    assert set(found) == {mutations.NONE, mutations.CLAMP, *(m.name for m in mutations.MISTAKES)}
    for name, comparison in found.items():
        assert comparison.rejects == (name != mutations.NONE), name
