"""The studies of ``mrt-validate``: each passes in quick mode, and notices faults that are planted."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cases import Cases, but_slow

import mrt_mitsuba as mrt
from mrt_mitsuba.scene.model import Scene
from mrt_mitsuba.scene.report import report_scene
from mrt_mitsuba.validation import cli
from mrt_mitsuba.validation.scenery import with_materials
from mrt_mitsuba.validation.studies import roughconductor, scenes
from mrt_mitsuba.validation.study import Study, findings

for needed in cli.EXTRAS:
    pytest.importorskip(needed)

pytestmark = pytest.mark.usefixtures("variant")

Patch = pytest.MonkeyPatch
Fault = Callable[[Patch], None]


@pytest.fixture(autouse=True)
def tiny(monkeypatch: Patch, variant: str) -> None:
    """Let studies measure as little as shows whether their bounds hold."""
    monkeypatch.setattr(roughconductor.runtime, "usable_variants", lambda: ["llvm_ad_rgb"])


def quick(name: str) -> Study:
    """What a study, or a part of it as "study:part", finds."""
    module, _, part = name.partition(":")
    study = import_module(f"mrt_mitsuba.validation.studies.{module}")
    return findings(getattr(study, part or "run"), quick=True)


# Stability and adaptive have tests of their own; the pictures of roughconductor, see below
PASSING = ["roughconductor:pointwise", "stock", "scenes", "error_vs_time", "needs"]


@pytest.mark.filterwarnings("ignore:The reference is too coarse")
@pytest.mark.parametrize("name", but_slow(PASSING, PASSING[1:]))  # whole studies
def test_study_passes(name):
    study = quick(name)
    assert study.passed, study.missed


# ------------------------------------------------ Faults ------------------------------------------------


def wrapped(module: Any, name: str, change: Callable[..., Any]) -> Fault:
    """Put ``change(original, *arguments, **options)`` in the place of a function."""

    def plant(patch: Patch) -> None:
        patch.setattr(module, name, partial(change, getattr(module, name)))

    return plant


def of_type(kind: str, **parameters: Callable[[Any], Any]) -> Fault:
    """Change parameters of every plugin of a type that is loaded: functions of what was given."""

    def inner(node: Any) -> Any:
        if not isinstance(node, dict):
            return node
        if node.get("type") == kind:
            node = node | {name: change(node.get(name)) for name, change in parameters.items()}
        return {key: inner(value) for key, value in node.items()}

    return wrapped(mi, "load_dict", lambda load, nodes, *more: load(inner(nodes), *more))


of_bsdf = partial(of_type, "mrt_bsdf")


BRIGHT = of_bsdf(specular_reflectance=lambda _: 1.02)
ROUGH = of_bsdf(alpha=lambda alpha: 1.05 * alpha if isinstance(alpha, float) else alpha)


def mirrors_too(render: Any, scene: Any, *, integrator: Any, **options: Any) -> Any:
    changed = integrator if integrator == "direct" else integrator | {"max_depth": 2}
    return render(scene, integrator=changed, **options)


faults = Cases()
faults("stock:direct", wrapped(mrt, "render", mirrors_too), "share of pixels off", slow=True)
faults("roughconductor:pointwise", ROUGH, "value")


@pytest.mark.parametrize(("name", "fault", "bound"), faults)
def test_a_planted_fault_is_noticed(name, fault, bound, monkeypatch):
    fault(monkeypatch)
    with np.errstate(all="ignore"):  # what divides by a density of zero is the fault's doing
        missed = quick(name).missed
    assert [what for what in missed if bound in what], missed


# --------------------------------- Scenes: the least mistakes, every mode ---------------------------------

SIZE = (80, 60)


def altered(**changes: Callable[[Any], Any]) -> Callable[[Scene], Scene]:
    """Change numbers of every material."""

    def change(m: Any) -> Any:
        return dataclasses.replace(m, **{name: of(getattr(m, name)) for name, of in changes.items()})

    return lambda scene: with_materials(scene, change)


def moved(scene: Scene) -> Scene:
    """One sphere by a tenth of a pixel or less."""
    first, second, *others = scene.spheres
    second = dataclasses.replace(second, center=tuple(np.add(second.center, (0, 1e-3, 0))))
    return dataclasses.replace(scene, spheres=(first, second, *others))


def brighter_sky(scene: Scene) -> Scene:
    return dataclasses.replace(scene, sky=tuple(1.001 * c for c in scene.sky))


def a_light_less(scene: Scene) -> Scene:
    return dataclasses.replace(scene, lights=scene.lights[:-1])


def dimmer(color: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(0.9999 * c for c in color)


MISTAKES = {"sky x 1.001": brighter_sky, "a light less": a_light_less, "a sphere moved": moved}
MISTAKES["alpha x 1.0001"] = altered(alpha=lambda a: 1.0001 * a)
MISTAKES["index + 0.00003"] = altered(ior=lambda n: n + 3e-5)
MISTAKES["Ks x 0.9999"] = altered(specular=dimmer)


def verdict(number: int, scene: Scene | None = None, **integrator: Any) -> Study:
    """Judge a scene, changed or drawn otherwise, by the truth of the unchanged one."""
    right = report_scene(number)
    image = scenes.draw(scene or right, SIZE, **integrator)
    error, unexplained = scenes.judge(image, right)
    return findings(scenes.hold, number=number, error=error, unexplained=unexplained)


def test_small_mistakes_are_seen():
    """Scene 1 has every roughness, and lights that need the clamp."""
    assert verdict(1).passed
    for name, mistake in MISTAKES.items():
        assert not verdict(1, mistake(report_scene(1))).passed, name
    assert not verdict(1, clamp=False).passed
    assert not verdict(1, bounce_budget="plain", max_depth=1).passed


# ---------------------------------------- compare_roughconductor ----------------------------------------

SMALL: dict[str, Any] = {"size": 32, "spp": 8, "renders": 32, "pairs": 2000}


@pytest.mark.parametrize("distribution", ["beckmann", "ggx"])
def test_comparison_finds_them_equal(distribution):
    found = mrt.compare_roughconductor(alpha=0.2, distribution=distribution, **SMALL)
    assert found.equal
    assert 0 < found.errors["value"] < 2e-5
    assert found.errors["pixels that differ, with the same random numbers"] < 5e-3
    assert found.timings["ratio"] == pytest.approx(found.timings["ours"] / found.timings["theirs"])
    assert {image.shape for image in found.images.values()} == {(24, 32, 3)}
    assert "alpha = 0.2: equal" in str(found)


def test_comparison_sees_a_broken_bsdf(monkeypatch):
    BRIGHT(monkeypatch)
    found = mrt.compare_roughconductor(alpha=0.3, **SMALL)
    assert not found.equal
    assert found.errors["value"] > 0.01
    # the ball is a third of the picture
    assert found.errors["pixels that differ, with the same random numbers"] > 0.1


@pytest.mark.parametrize("alpha", [0, 1.5, float("nan")])
def test_roughness_out_of_range_is_refused(alpha):
    with pytest.raises(mrt.UsageError, match="alpha="):
        mrt.compare_roughconductor(alpha)
