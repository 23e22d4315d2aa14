"""The study of our renders against the float64 tracer: quick on one scene, and that it sees mistakes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba import runtime
from mrt_mitsuba.output.files import read_exr
from mrt_mitsuba.plugins import plugin
from mrt_mitsuba.plugins.fresnel import f0_from_ior, fresnel_schlick
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation.oracles.reference import reference_render
from mrt_mitsuba.validation.studies import scenes
from mrt_mitsuba.validation.tools.study import Picture, Plot, Study, Table

pytestmark = pytest.mark.skipif(
    runtime.obstacle(runtime.FAST) is not None, reason="scalar variants take minutes"
)

SIZE = (48, 36)


@pytest.fixture(autouse=True)
def fast() -> None:
    runtime.use(runtime.FAST)


def judged(number: int = 0, **changes) -> tuple[scenes.Judgement, Study]:
    """Judge a scene, some of it changed, by the truth of the unchanged one."""
    scene = report_scene(number)
    found = scenes.judge(scenes.draw(dataclasses.replace(scene, **changes), SIZE), scene)
    study = Study("scenes", scenes.TITLE)
    scenes._bounds(study, number, found)
    return found, study


def test_our_render_passes() -> None:
    found, study = judged()
    assert study.passed and len(study.bounds) == 3
    assert found.count("unexplained") == 0


@pytest.mark.parametrize("name", ["light", "sphere", "sky"])
def test_a_mistake_is_seen(name: str) -> None:
    scene = report_scene(0)
    moved = dataclasses.replace(scene.spheres[2], center=(0, 1.02, 0))  # by a pixel
    changes = {
        "light": {"lights": scene.lights[:1]},
        "sphere": {"spheres": (*scene.spheres[:2], moved, *scene.spheres[3:])},
        "sky": {"sky": tuple(1.02 * c for c in scene.sky)},
    }
    found, study = judged(**changes[name])
    assert not study.passed
    assert found.count("unexplained") > 0


# ------------------------------------ Plugins broken on purpose ------------------------------------


def brighter(patch: pytest.MonkeyPatch) -> None:
    bsdf = plugin("bsdf").MrtBSDF
    value = bsdf._value
    patch.setattr(bsdf, "_value", lambda *arguments: 1.02 * value(*arguments))


def rougher(patch: pytest.MonkeyPatch) -> None:
    point = plugin("bsdf")._Point
    read = point._read
    patch.setattr(point, "_read", lambda self, name: (1.05 if name == "alpha" else 1) * read(self, name))


def flipped(patch: pytest.MonkeyPatch) -> None:
    prepared = plugin("whitted").Prepared
    intersect = prepared.intersect

    def inside_out(*arguments, **options):
        hit = intersect(*arguments, **options)
        hit.si.sh_frame.n, hit.si.wi.z = -hit.si.sh_frame.n, -hit.si.wi.z
        return hit

    patch.setattr(prepared, "intersect", inside_out)


def unclamped(patch: pytest.MonkeyPatch) -> None:
    visible_part = plugin("whitted").MrtWhitted._visible_part

    def without(self, *arguments):
        self.clamp = False
        return visible_part(self, *arguments)

    patch.setattr(plugin("whitted").MrtWhitted, "_visible_part", without)


def darker(patch: pytest.MonkeyPatch) -> None:
    prepared = plugin("whitted").Prepared
    read_emitters = prepared._read_emitters

    def without_the_last(self, scene):
        read_emitters(self, scene)
        self.lights = self.lights[:-1]

    patch.setattr(prepared, "_read_emitters", without_the_last)


def approximated(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        plugin("bsdf"),
        "fresnel_dielectric",
        lambda c, ext_ior, int_ior, s2: fresnel_schlick(c, f0_from_ior(ext_ior, int_ior), s2),
    )


@pytest.mark.parametrize("break_it", [brighter, rougher, flipped, unclamped, darker, approximated])
def test_a_broken_plugin_is_seen(
    break_it: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scene 1 has every roughness, and lights that need the clamp."""
    break_it(monkeypatch)
    found, study = judged(1)
    assert not study.passed
    assert found.count("unexplained") > 0


def test_every_pixel_that_is_off_has_one_reason() -> None:
    """A picture shifted by half a displacement is off at silhouettes and shadows only, and judged so."""
    size = {"width": 64, "height": 48}
    scene = report_scene(1)
    shifted = reference_render(scene, displacement=(2e-2, 0), **size).image
    found = scenes.judge(shifted, scene, displacement=2e-2)
    counts = {reason: found.count(reason) for reason in scenes.REASONS}
    assert sum(counts.values()) == np.sum(found.error > scenes.STEP) > 5
    assert counts["silhouette"] > 0 and counts["unexplained"] == 0


def test_the_study_tells_all_it_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MRT_REFERENCE", str(tmp_path))  # nothing there
    monkeypatch.setattr(scenes, "LIMITS", {n: scenes.LIMITS[n] for n in (0, 3)})
    monkeypatch.setattr(scenes, "_size", lambda number, quick: SIZE)
    study = Study("scenes", scenes.TITLE)
    scenes.run(study, quick=True)
    assert study.passed, [str(b) for b in study.bounds if not b.holds]
    assert [row[0] for part in study.parts if isinstance(part, Table) for row in part.rows] == [0, 3]
    assert any(isinstance(part, Plot | Picture) for part in study.parts)
    assert any(isinstance(part, str) and "MRT_REFERENCE" in part for part in study.parts)


def test_the_originals_renders_are_judged_where_they_are_at_hand(original_data: Path) -> None:
    """Ours is nearer to the truth than the original in scene 0."""
    theirs = read_exr(original_data / "renders" / "s0_none_aa1.exr").image
    height, width, _ = theirs.shape
    truth = reference_render(report_scene(0), width=width, height=height).image
    ours = scenes.draw(0, (width, height))
    assert np.abs(ours - truth).mean() < np.abs(theirs - truth).mean()
