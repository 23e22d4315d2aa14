"""The study against Mitsuba's own plugins, on small pictures, and that its comparisons see mistakes."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies import approximations, stock
from mrt_mitsuba.validation.tools.image_tests import compare
from mrt_mitsuba.validation.tools.study import findings

SMALL = {"width": 64, "height": 48}

pytestmark = pytest.mark.usefixtures("variant")


NAMES = ["direct", "gloss", "materials", "approximations", "mutations"]


@pytest.mark.parametrize("part", stock.PARTS, ids=NAMES)
def test_every_part_of_the_study_holds(part) -> None:
    study = findings(part, quick=True)
    assert study.passed, study.missed


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


def test_each_approximation_changes_what_it_says() -> None:
    """Scene 1: the clamp matters in highlights, falloff nearly everywhere, and none is the last picture but
    the last."""
    images = approximations.without_approximations(1, **SMALL, spp=16)
    right = mrt.render(1, **SMALL, aa=1, aamode="none", fresnel="dielectric").image
    assert np.array_equal(images["the report's picture"], right)
    change = [np.abs(b - a).max(axis=-1) for a, b in pairwise(images.values())]
    assert (images["clamp off"] >= images["the report's picture"] - 1e-6).all()
    assert 0.001 < np.mean(change[0] > 1 / 255) < 0.1
    assert np.mean(change[1] > 1 / 255) > 0.3
    assert all(c.max() > 1 / 255 for c in change)


def test_with_diffuse_parts_the_materials_differ() -> None:
    """The comparison that lets black materials pass sees that roughplastic refracts the diffuse light."""
    scene = approximations.physical(report_scene(3), least_alpha=approximations.ALPHA_FOR_TESTS)
    theirs = mrt.scene_dict(scene, flavor="stock", **SMALL)
    ours = approximations.finite(mrt.scene_dict(scene, fresnel="dielectric", **SMALL), theirs)
    pair = (
        approximations.path_estimate(nodes, spp=4, seed=seed) for nodes, seed in ((ours, 0), (theirs, 100))
    )
    assert compare(*pair).detected_by == ("pixel", "tile", "image")
