"""``region``: part of a picture, the same bit for bit as in the whole, with filters and random numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba import memory
from mrt_mitsuba.errors import UsageError

WIDTH, HEIGHT = 131, 97
SIZE = {"width": WIDTH, "height": HEIGHT}
# columns and rows of tiles: narrower than what filters look at, in the middle, and the rest
COLUMNS, ROWS = (0, 5, 60, WIDTH), (0, 40, 47, HEIGHT)


def tiles() -> Iterator[tuple[int, int, int, int]]:
    for (top, bottom), (left, right) in itertools.product(
        itertools.pairwise(ROWS), itertools.pairwise(COLUMNS)
    ):
        yield left, top, right - left, bottom - top


def assert_put_together(scene: Any, **options: Any) -> None:
    whole = mrt.render(scene, **options)
    for x, y, width, height in tiles():
        part = mrt.render(scene, region=(x, y, width, height), **options)
        assert part.layers.keys() == whole.layers.keys()
        inside = slice(y, y + height), slice(x, x + width)
        assert part.image.tobytes() == whole.image[inside].tobytes(), (x, y)
        for name, values in part.layers.items():
            assert values.tobytes() == whole.layers[name][inside].tobytes(), (name, x, y)
        assert part.options["region"] == (x, y, width, height)


MODES = [
    ("none", None), ("none", "report"), ("luma", "corrected"), ("sobel", "report"), ("geometry", "corrected"),
]  # fmt: skip


@pytest.mark.parametrize(("aamode", "dof"), MODES)
def test_filters(aamode: str, dof: str | None) -> None:
    focus = {"dof": dof, "focaldist": 2.0, "focalrange": 0.5} if dof else {"focaldist": 0}
    layers = ["normal", "samples"] + ["edges"] * (aamode != "none") + ["blur"] * bool(dof)
    assert_put_together(3, aa=2, aamode=aamode, layers=layers, **SIZE, **focus)


@pytest.mark.parametrize("aamode", ["none", "sobel"])
def test_random_numbers(aamode: str) -> None:
    scene = mrt.scene_dict(3, **SIZE)
    assert_put_together(scene, aa=2, aamode=aamode, integrator="path", spp=2, focaldist=2.0, seed=5)


@pytest.mark.parametrize("motionmode", ["frames", "stratified"])
def test_motion(motionmode: str) -> None:
    assert_put_together(3, aa=2, motion=[0.2, 0.0, 0.1], motionsamples=3, motionmode=motionmode, **SIZE)


def test_parts_within_a_region(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "MOST_PIXELS", 30 * WIDTH)
    monkeypatch.setattr(memory, "MOST_RAYS", 3001)
    assert_put_together(3, aa=2, focaldist=2.0, focalrange=0.5, **SIZE)


@pytest.mark.parametrize(
    "region", [(0, 0, WIDTH + 1, 1), (0, HEIGHT, 1, 1), (-1, 0, 5, 5), (0, 0, 0, 1), (1, 2), 3]
)
def test_regions_outside_are_refused(region: object) -> None:
    with pytest.raises(UsageError, match="region="):
        mrt.render(3, region=region, **SIZE)
