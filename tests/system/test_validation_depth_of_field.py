"""The depth-of-field study: the fit of the lens, and that a worse filter is noticed."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from mrt_mitsuba import filters
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.studies import depth_of_field as dof
from mrt_mitsuba.validation.tools.study import findings

TINY = dof.Extent((96, 72), 2, 16)


def test_disc_has_the_variance_of_the_pascal_line():
    for k in range(1, 9):
        line = np.array([math.comb(2 * k - 1, j) for j in range(2 * k)], float)
        place = np.arange(2 * k)
        mean = np.average(place, weights=line)
        variance = np.average((place - mean) ** 2, weights=line)
        assert dof.disc_radius(np.array(float(k))) ** 2 / 4 == pytest.approx(variance)
    assert dof.disc_radius(np.array(0.0)) == 0


def test_fit_finds_a_lens_that_is_there(monkeypatch):
    """Discs of a known lens, in place of the report's blur: the fit must give that lens back."""
    scene, radius, focus = report_scene(3), 0.1, 3.0
    depth = np.linspace(1, 9, 200 * 150, dtype=np.float32).reshape(150, 200)
    scale = radius * 200 / (2 * math.tan(math.radians(scene.camera.hfov) / 2))
    monkeypatch.setattr(
        dof, "disc_radius", lambda amount: np.abs(scale * (1 / focus - 1 / depth.astype(float)))
    )
    lens = dof.fit_lens(dataclasses.replace(scene, focal_distance=focus), depth)
    assert (lens.radius, lens.focus) == pytest.approx((radius, focus), rel=1e-6)


def test_bounds_hold_and_a_worse_filter_is_noticed(monkeypatch, variant):
    monkeypatch.setattr(dof, "QUICK", TINY)
    monkeypatch.setattr(dof, "SCENES", (3,))
    study = findings(dof.run, quick=True)
    assert study.passed, study.missed
    right = filters.gaussian_dof

    def moved(image, depth, *, mode, **focus):
        """The corrected filter, off by one pixel."""
        blurred = right(image, depth, mode=mode, **focus)
        return np.roll(blurred, 1, axis=1) if mode == "corrected" else blurred

    monkeypatch.setattr(filters, "gaussian_dof", moved)
    assert any("corrected / report" in name for name in findings(dof.run, quick=True).missed)
