"""``mrt.error_vs_time`` on scenes of one's own: known errors, biases and intervals, and the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from cases import Cases
from nodes import rgb, sensor

import mrt_mitsuba as mrt
from mrt_mitsuba.command.main import main
from mrt_mitsuba.files.images import save
from mrt_mitsuba.rendering.film import derived_seed
from mrt_mitsuba.validation import work_precision
from mrt_mitsuba.validation.work_precision import Findings, Point, frontier

for needed in ("matplotlib", "jinja2", "scipy", "flip_evaluator"):
    pytest.importorskip(needed)

SIZE = (32, 24)
ONE_RAY = {"aa": 1, "aamode": "none"}


@pytest.fixture
def scene(variant):
    """A diffuse ball under a bright sky: every path is one bounce, noise is tame, path is direct."""
    nodes = {"type": "scene", "sensor": sensor([0, 1, 3], [0, 0, 0], SIZE), "sky": {"type": "constant"}}
    nodes["ball"] = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse"}}
    nodes["light"] = {"type": "point", "position": [2, 2, 2], "intensity": rgb(9.0, 9.0, 9.0)}
    return nodes


def path(spp: int, **more: object) -> dict[str, object]:
    return {"integrator": "path", "spp": spp, **more}


def test_errors_fall_as_theory_says_and_a_bias_is_found(scene):
    cases = {f"path {n}": path(n) for n in (4, 16, 64)}
    cases |= {f"blind {n}": path(n, integrator={"type": "path", "max_depth": 1}) for n in (1, 16)}
    found = mrt.error_vs_time(scene, cases, reference=path(2048), repeats=6, shared=ONE_RAY)
    assert not found.failed
    assert list(found.families) == ["path", "blind"]
    points = found.points
    few = points["path 4"]
    many = points["path 64"]
    # 768 pixels of 6 repeats: their mean square is known to some 5 %
    assert few.rmse / many.rmse == pytest.approx(4, rel=0.15)
    assert few.rmse**2 == pytest.approx(few.variance, rel=0.1)
    assert few.bias_interval[0] == 0
    assert few.bias_interval[1] < 0.5 * few.rmse  # a quarter of the MSE at most
    blind = points["blind 16"]
    assert blind.bias == pytest.approx(blind.rmse, rel=0.01)
    assert blind.bias_interval[0] > 0.9 * blind.bias
    # the reference's error is that of 2048 rays
    assert found.reference_error == pytest.approx(many.rmse * (64 / 2048) ** 0.5, rel=0.15)
    assert few.seconds_interval[0] <= few.seconds <= few.seconds_interval[1]
    assert few.rmse_interval[0] < few.rmse < few.rmse_interval[1]
    assert few.efficiency == pytest.approx(1 / few.variance / few.seconds)
    assert few.cold > 0


@pytest.mark.parametrize(("seconds", "renders"), [(0.02, 3), (0.026, 2), (0.06, 1)])
def test_a_timing_takes_fifty_milliseconds(seconds, renders, scene, monkeypatch):
    calls = []

    def render(*args, **options):
        result = mrt.render(*args, **options)
        calls.append(options["seed"])
        return replace(result, timings=replace(result.timings, total=7 + seconds, load=7.0))

    monkeypatch.setattr(work_precision, "render", render)
    truth = np.ones((*SIZE[::-1], 3))
    found = mrt.error_vs_time(scene, {"path": path(1)}, reference=truth, shared=ONE_RAY, repeats=2)
    # a first run, then two repeats
    assert calls == [0, *[0] * renders, *[derived_seed(0, repeat=1)] * renders]
    assert found.points["path"].seconds == pytest.approx(seconds)


def test_a_reference_that_is_too_coarse_is_said_first(scene, tmp_path):
    cases = {f"path {n}": path(n) for n in (4, 256)}
    with pytest.warns(
        mrt.MrtWarning, match=r"too coarse, its own RMSE is .*: nothing .* about path 256; use"
    ):
        found = mrt.error_vs_time(scene, cases, reference=path(16), repeats=2, shared=ONE_RAY)
    assert str(found).startswith("The reference is too coarse")
    found.save(tmp_path)
    page = (tmp_path / "index.html").read_text("utf-8")
    assert page.index("The reference is too coarse") < page.index("<table") < page.index("not resolved")
    assert all(error > 2 * found.reference_error for error in found.errors)
    nothing = replace(found, points={"path 256": found.points["path 256"]})
    assert nothing.verdicts == ["No verdict on time: no case has an error that the reference can resolve."]


def test_an_automatic_reference_gets_better_until_it_resolves_all(scene):
    scene["integrator"] = {"type": "path"}
    cases = {f"path {n}": path(n) for n in (4, 64)}
    found = mrt.error_vs_time(scene, cases, repeats=2, shared=ONE_RAY)
    assert found.warning == ""
    assert all(point.resolved for point in found.points.values())
    assert found.points["path 64"].bias_interval[0] == 0
    assert found.reference_error < min(found.errors) / 2


def test_scenes_are_opened_with_all_that_the_caller_said(variant, tmp_path):
    """The parameters and the focus of an XML file, another sensor, keys of ``mi.traverse``."""
    mrt.register()
    nodes = mrt.scene_dict(3, width=32, height=24)
    (tmp_path / "scene.xml").write_text(XML)
    for given, options in (
        (tmp_path / "scene.xml", {"params": {"glow": 3}}),
        (tmp_path / "scene.xml", {"params": {"glow": 3}, "sensor": 1}),
        (nodes, {"params": {"material_0.alpha": 0.4}}),
    ):
        options = {**options, **ONE_RAY}
        truth = mrt.render(given, **options)
        found = mrt.error_vs_time(given, {"a": {}}, reference=truth, repeats=1, shared=options)
        assert not found.failed
        assert found.points["a"].rmse < 1e-6


def test_failed_cases_are_kept_with_the_reason(scene, tmp_path):
    black = {**scene, "dark": {"type": "point", "position": [0, 3, 0], "intensity": float("nan")}}
    bad = {
        "integratr": {"integratr": "path"},
        "NaN": path(4, scene=black),
        "8x6": path(4, scene=mrt.scene_dict(0, width=8, height=6)),
    }
    cases = {"good": path(4), **bad}
    found = mrt.error_vs_time(scene, cases, reference=path(64), repeats=1, shared=ONE_RAY)
    assert list(found.points) == ["good"]
    assert list(found.failed) == list(bad)
    assert all(word in why for word, why in found.failed.items()), found.failed
    found.save(tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["passed"] is False


def test_references_of_other_kinds(variant, tmp_path):
    """A lattice, whose own error is the difference from fewer samples, and the file of a picture."""
    scene = mrt.scene_dict(0, width=32, height=24)
    lattice = {"aamode": "none", "lattice": "centered"}
    best = mrt.render(scene, aa=8, **lattice)
    best.save(tmp_path / "best.exr")
    error = mrt.compare(mrt.render(scene, aa=2, **lattice), best).rmse
    for reference, aa in (({"aa": 8}, 6), (tmp_path / "best.exr", 8)):
        found = mrt.error_vs_time(scene, {"aa=2": {"aa": 2}}, reference=reference, repeats=2, shared=lattice)
        other = mrt.compare(mrt.render(scene, aa=aa, **lattice), best).rmse
        assert found.reference_error == pytest.approx(other, rel=1e-5)
        two = found.points["aa=2"]
        assert (two.rmse, *two.rmse_interval) == pytest.approx((error,) * 3, rel=1e-4)  # nothing is random
        assert np.isnan(two.efficiency)
    save(tmp_path / "noisy.exr", best.image, layers={"error.Y": np.full((24, 32), 0.01)})
    noisy = tmp_path / "noisy.exr"
    with pytest.warns(mrt.MrtWarning, match="too coarse, its own RMSE is 0.01"):
        found = mrt.error_vs_time(scene, {"a": {}}, reference=noisy, repeats=1, shared=lattice)
    assert found.reference_error == pytest.approx(0.01)


wrong = Cases()
wrong({"cases": {}}, "at least one case")
wrong({"repeats": 0}, "one repeat")
wrong({"cases": {"a": {"seed": 3}}}, "a sets a seed")
wrong({"reference": np.ones((3, 3, 4, 1))}, "has the shape")


@pytest.mark.parametrize(("arguments", "message"), wrong)
def test_wrong_arguments(arguments, message, variant):
    with pytest.raises(mrt.UsageError, match=message):
        mrt.error_vs_time(0, **{"cases": {"a": {}}, "reference": {}, **arguments})


def point(name: str, times: list[float], rmse: float = 0.1, gram: np.ndarray | None = None) -> Point:
    image = np.full((2, 2, 3), 0.5, np.float32)
    gram = rmse**2 * np.eye(len(times)) if gram is None else gram
    return Point.of(name, np.array(times), gram, cold=1.0, image=image, reference_error=0.0)


def found_of(*points: Point) -> Findings:
    repeats = 1 if np.isnan(points[0].seconds_interval[0]) else 2
    return Findings("test", {p.name: p for p in points}, {}, np.zeros((2, 2, 3)), 0.0, repeats)


def test_the_frontier_is_what_nothing_else_beats():
    fast = [point(f"fast {n}", [n] * 3, 0.1 / n) for n in (1.0, 4.0)]
    slow = [point(f"slow {n}", [2 * n] * 3, 0.1 / n) for n in (1.0, 4.0)]
    between = point("between", [3.0] * 3, 0.09)
    assert frontier([*slow, between, *fast]) == [fast[0], between, fast[1]]


def test_time_to_an_error_is_read_off_the_curve():
    curve = found_of(point("a 1", [1.0] * 3, 0.4), point("a 4", [4.0] * 3, 0.2), point("b", [9.0] * 3, 0.01))
    for error, seconds in ((0.5, 1), (0.4, 1), (0.4 / 2**0.5, 2), (0.2, 4), (0.19, np.inf)):
        assert tuple(curve.time_to(error)["a"]) == pytest.approx((seconds,) * 3)
    once = found_of(point("a", [1.0]), point("b", [9.0]))
    assert once.verdicts == ["No verdict on time: a single repeat has no interval."]
    assert np.isnan([*once.time_to(0.1)["a"][1:], once.points["a"].rmse_interval[1]]).all()


XML = """<scene version="3.0.0">
  <default name="glow" value="1"/>
  <default name="focaldist" value="2"/>
  <default name="focalrange" value="0.2"/>
  <integrator type="mrt_whitted"/>
  <emitter type="mrt_light"><point name="position" x="0" y="3" z="3"/>
    <rgb name="intensity" value="$glow"/></emitter>
  <shape type="sphere"><bsdf type="mrt_bsdf"/></shape>
  <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="24"/>
    <integer name="height" value="18"/></film>
    <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform></sensor>
  <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="24"/>
    <integer name="height" value="18"/></film>
    <transform name="to_world"><lookat origin="2,3,5" target="0,0,0" up="0,1,0"/></transform></sensor>
</scene>"""


races = Cases()
races([2.0, 2.1, 1.9, 2.05], 0.1, 0.1, ": a, 1.02 (0.863 to 1.22) s; b takes 2 times as long.")
races([0.9, 1.3, 0.8, 1.4], 0.1, 0.1, ": no winner: a; b, 1.02 (0.863 to 1.22) s.")
races([1.0] * 4, 0.2, 0.1, ": a, 1.02 (0.863 to 1.22) s.")
races([1.0] * 4, 0.2, 1e-3, ": nothing comes so low.")


@pytest.mark.parametrize(("times", "rmse", "error", "said"), races)
def test_a_winner_is_named_only_if_intervals_are_apart(times, rmse, error, said):
    found = found_of(point("a", [1.0, 1.1, 0.9, 1.05]), point("b", times, rmse))
    assert found.verdict(error) == f"RMSE of {error:g}{said}"
    assert found.verdicts == [found.verdict(error) for error in found.errors]
    assert all(verdict in str(found) for verdict in found.verdicts)


@pytest.mark.parametrize(("spread", "decided"), [(1e-3, True), (0.5, False)])
def test_a_curve_that_may_come_so_low_has_not_lost(spread, decided):
    """The error of b is 0.11; pictures that differ widely leave in doubt whether it is 0.1."""
    gram = 0.11**2 * np.diag(1 + spread * np.array([-1, 1, -1, 1]))
    times = [1.0, 1.1, 0.9, 1.05]
    found = found_of(point("a", times), point("b", times, 0.11, gram))
    assert ("no winner: a; b" in found.verdict(0.1)) is not decided


@pytest.mark.parametrize("reference_error", [0.0, 0.1])
def test_a_case_with_no_error_left_is_not_resolved_by_a_coarse_reference(reference_error):
    best = replace(point("best", [1.0] * 3, 0.0), reference_error=reference_error)
    found = replace(found_of(best), reference_error=reference_error)
    assert ("about best" in found.warning) is (reference_error > 0)


@pytest.mark.parametrize("count", [3, 5, 10])
def test_intervals_cover_what_they_should_and_equal_cases_have_no_winner(count):
    """95 % of them, of log-normal times as a busy machine makes them, and of pictures with a bias.

    200 trials leave ± 4.6 %. Intervals that overlap are a test far stricter than one of 5 %.
    """
    rng = np.random.default_rng(count)
    trials = 200
    pixels = 64
    bias = 0.05
    held = np.zeros(3)
    winners = 0
    for _ in range(trials):
        times = np.exp(rng.normal(0, 0.3, (2, count)))
        pictures = bias + rng.normal(0, 0.3, (count, pixels))
        p = point("a", times[0], gram=pictures @ pictures.T / pixels)
        true = 1, (0.3**2 + bias**2) ** 0.5, bias
        ends = p.seconds_interval, p.rmse_interval, p.bias_interval
        held += [low <= value <= high for value, (low, high) in zip(true, ends, strict=True)]
        equal = found_of(point("a", times[0]), point("b", times[1]))
        winners += "no winner" not in equal.verdict(0.1)
    assert (held >= 0.88 * trials).all(), held
    assert winners <= 0.05 * trials


GOOD = """
repeats = 2
shared = {width = 24, height = 18, aamode = "none", focaldist = 0}
reference = {aa = 4}
[cases]
"aa=1" = {aa = 1}
"aa=2" = {aa = 2}
"""


def test_command_writes_a_page(tmp_path, capsys, variant):
    out = tmp_path / "report"
    cases = tmp_path / "cases.toml"
    cases.write_text(GOOD)
    assert main(["error-vs-time", "3", f"cases={cases}", f"out={out}"]) == 0
    assert "index.html" in capsys.readouterr().out
    names = {path.name.removeprefix("error-vs-time-") for path in out.iterdir()}
    assert {"index.html", "summary.json", "diagram.png", "points.csv"} <= names
    cases.write_text(GOOD + '"bad" = {aa = 1, lattice = "none"}\n')
    assert main(["error-vs-time", "scene=3", f"cases={cases}", f"out={out}"]) == 1
    assert "bad" in capsys.readouterr().out
