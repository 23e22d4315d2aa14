"""The anti-aliasing study: what it finds, and that it notices what is wrong."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba import filters
from mrt_mitsuba.validation.studies import antialiasing
from mrt_mitsuba.validation.tools.study import Picture, findings

TINY = antialiasing.Extent((0,), ("report",), (2, 4), 8, (80, 60), 1, (60, 45), 8, (4, 16))


@pytest.fixture(autouse=True)
def tiny(monkeypatch, variant):
    monkeypatch.setattr(antialiasing, "QUICK", TINY)


def test_bounds_hold_and_everything_is_shown():
    study = findings(antialiasing.run, quick=True)
    assert study.passed, study.missed
    assert study.tables.keys() == {"modes", "box-filter", "path", "noise"}
    assert len(study.tables["modes"].rows) == 4 * 2
    picture = next(part for part in study.parts if isinstance(part, Picture))
    assert picture.image.shape == (60, 3 * 80 + 2 * 4, 3)
    assert set(np.unique(picture.image)) == {0.0, 0.5, 1.0}
    assert any(isinstance(part, str) and part.startswith("Scene 0") for part in study.parts)


def _spoil(monkeypatch, change) -> None:
    """Let the study see renders that were changed: ``change(result, options)``."""
    render = mrt.render
    monkeypatch.setattr(
        antialiasing.mrt, "render", lambda scene, **options: change(render(scene, **options), options)
    )


def test_a_ray_too_many_is_noticed(monkeypatch):
    def change(result, options):
        more = {**result.rays, "primary": result.rays["primary"] + (options["aamode"] == "luma")}
        return dataclasses.replace(result, rays=more)

    _spoil(monkeypatch, change)
    assert any("camera rays" in name for name in findings(antialiasing.run, quick=True).missed)


def test_a_refinement_that_changes_nothing_is_noticed(monkeypatch):
    render = mrt.render

    def change(result, options):
        if options["aamode"] != "sobel":
            return result
        one = render(0, width=80, height=60, aa=1, aamode="none", focaldist=0).image
        return dataclasses.replace(result, image=one) if result.image.shape == one.shape else result

    _spoil(monkeypatch, change)
    assert any("error of sobel" in name for name in findings(antialiasing.run, quick=True).missed)


def test_a_detector_that_ignores_the_variance_is_noticed(monkeypatch):
    sobel = filters.sobel_edges
    monkeypatch.setattr(filters, "sobel_edges", lambda image, variance=None: sobel(image))
    assert (
        "noise: share of flat pixels refined, 4 rays a pixel or more"
        in findings(antialiasing.run, quick=True).missed
    )
