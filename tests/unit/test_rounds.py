"""Sampling to an error, with numbers drawn in place of rays: is the mean right, and the error honest?"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from inspect import getclosurevars
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import Cases
from numpy.testing import assert_array_equal

import mrt_mitsuba as mrt
from mrt_mitsuba.adaptive import rounds
from mrt_mitsuba.adaptive.denoise import Denoiser
from mrt_mitsuba.adaptive.estimate import Sums, pilot_estimate, pixel_variance
from mrt_mitsuba.adaptive.metric import METRICS
from mrt_mitsuba.adaptive.rounds import Tracer, run_rounds
from mrt_mitsuba.adaptive.tails import PARETO_K_THRESHOLD, tail_shape
from mrt_mitsuba.adaptive.target import Goal, Target
from mrt_mitsuba.rendering.film import Film

SIDE = 16
PIXELS = SIDE**2
Draw = Callable[[np.random.Generator, np.ndarray], np.ndarray]  # values of rays in these pixels


class Draws:
    """An exposer of drawn values; those of the picture ``other`` are drawn by another function."""

    names = ("R", "G", "B")

    def __init__(
        self, draw: Draw, other: int = -1, draw_other: Draw | None = None, rfilter: str = "box"
    ) -> None:
        import mitsuba as mi

        mrt.register()
        film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": rfilter}}
        self.film = Film(mi.load_dict({"type": "perspective", "film": film}))
        self.draws = [draw_other or draw if picture == other else draw for picture in range(4)]

    def expose(self, groups: Any, samples: Any, *, pictures: int, **_: Any) -> Any:
        seed = getclosurevars(samples).nonlocals["seed"]
        shape = (pictures, *self.film.shape)
        pixels = self.film.pixels
        rays = groups.rays_of(pictures * pixels).reshape(pictures, pixels)
        before = np.zeros((pictures, pixels), np.int64)
        before.ravel()[groups.pixels] = groups.counts_and_first[1]
        total, square, peak = np.zeros((3, pictures, pixels))
        for picture, draw in enumerate(self.draws):
            rng = np.random.default_rng((seed, picture, int(before[picture].sum())))
            pixel = np.repeat(np.arange(pixels), rays[picture])
            values = draw(rng, pixel)
            total[picture] = np.bincount(pixel, values, pixels)
            square[picture] = np.bincount(pixel, values**2, pixels)
            np.fmax.at(peak[picture], pixel, values)
        total, square = (np.repeat(v.reshape(1, *shape), 3, axis=0) for v in (total, square))
        sums = total / np.maximum(rays, 1).reshape(shape)
        if self.film.reach:  # which averages noise, half of what changes within a pixel, too
            mean = sums.mean((-2, -1), keepdims=True)
            sums = (
                mean
                + (sums - mean)
                * (self.film.filter_variance_ratio * (1 + self.film.between_pixel_share) / 2) ** 0.5
            )
        weights = (rays > 0).reshape(shape).astype(float)
        peak = peak.reshape(shape)
        return SimpleNamespace(sums=sums, weights=weights, rays=rays, total=total, square=square, peak=peak)


def _render(
    exposer: Draws,
    seed: int = 0,
    target: Any = None,
    rays: int = 64,
    on_round: Any = None,
    metric: str = "linear",
) -> Any:
    """Return what a render of drawn values has."""
    tracer = Tracer(exposer, seed)  # type: ignore[arg-type]
    aim = Goal(None if target is None else Target.of(target), rays, metric=metric)
    stage = lambda *_: nullcontext(lambda rays: None)  # noqa: E731
    done, stats, error, _ = run_rounds(tracer, stage, aim, on_round=on_round)
    return SimpleNamespace(
        rounds=done,
        error=error,
        rays=stats.count.reshape(4, -1)[:2],
        image=stats.image(),
        map=np.sqrt(pixel_variance(stats, None).mean(-1)),
        samples=stats.samples(),
    )


def _pilot_rmse(stats: Any) -> float:
    """The error of the halves' mean, as the variance of pilot rays foresees it."""
    squares = stats.without_border(pilot_estimate(stats).variance / stats.count[:2].sum(0))
    return float(np.sqrt(squares.mean()))


@pytest.fixture
def pilots_alone(monkeypatch):
    """Rounds whose number of rays, too, is that which pilots foresee."""
    plan = rounds.plan_round

    def foreseen(allocator: Any, stats: Any, goal: Any, target: Any, now: Any) -> Any:
        return plan(allocator, stats, goal, target, replace(now, rmse=_pilot_rmse(stats)))

    monkeypatch.setattr(rounds, "plan_round", foreseen)


def _rare(share: float, pixels: int = PIXELS, bright: float = 200) -> Draw:
    """Return draws of about 1, of which a share is bright in some pixels."""

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        lit = (pixel % (PIXELS // pixels) == 0) & (rng.random(len(pixel)) < share)
        return np.where(lit, bright, 1 + 0.1 * rng.random(len(pixel)))

    return draw


def _calm(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
    return 1 + (0.1 + pixel / PIXELS) * rng.normal(size=len(pixel))


@pytest.mark.usefixtures("pilots_alone")
@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize(
    "goal",
    [
        {"rays": 64},
        {"rays": 512},
        {"target": 0.05, "rays": 2000},
        {"target": "2%", "rays": 9000},  # of a luminance that no half decides, either
    ],
)
def test_no_value_decides_its_weight_nor_when_to_stop(half, rfilter, goal):
    """Other values of one half change nothing of how many rays any pixel gets: so its mean is right."""

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        calm = _calm(rng, pixel)
        return np.where(pixel % 3, _rare(0.05)(rng, pixel), calm)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        plain = _render(Draws(_calm, rfilter=rfilter), **goal)
        changed = _render(Draws(_calm, half, draw, rfilter=rfilter), **goal)
    assert changed.image.mean() > 1.5 * plain.image.mean()
    assert len(plain.rounds) > 1
    assert_array_equal(changed.rays, plain.rays)
    assert [r.spp for r in changed.rounds] == [r.spp for r in plain.rounds]
    assert np.ptp(plain.rays[half]) > 8  # and yet rays go where the noise is


def _caustic(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
    """Draw about 1.1, to which rare rays of log-normal values add in a fifth of the pixels."""
    bright = (pixel % 5 == 0) & (rng.random(len(pixel)) < 0.05)
    return 1 + 0.2 * rng.random(len(pixel)) + 20 * bright * np.exp(rng.normal(size=len(pixel)))


_LIT = np.arange(PIXELS) % 5 == 0
stopped = Cases()
stopped(_calm, 0.037, np.ones(PIXELS))
stopped(_caustic, 0.25, 1.1 + _LIT * 0.05 * 20 * np.exp(0.5))
stopped(_rare(0.01), 1.2, np.full(PIXELS, 1.05 + 0.01 * 198.95))


@pytest.mark.slow
@pytest.mark.parametrize(("draw", "target", "mean"), stopped, ids=["calm", "caustic", "rare"])
@pytest.mark.filterwarnings("ignore::mrt_mitsuba.MrtWarning")
def test_stopping_by_the_error_of_the_picture_keeps_the_mean(draw, target, mean):
    """To 15 % of a picture's own standard error, of 2,000 seeds; intervals hold 90 % of errors, or are
    infinite."""
    results = [_render(Draws(draw), seed, target=target, rays=3000) for seed in range(2000)]
    means = np.array([result.image[..., 0].mean(dtype=float) for result in results])
    assert abs(means.mean() - mean.mean()) < 0.15 * means.std(ddof=1)  # known to 2 %
    true = [np.sqrt(np.mean((result.image[..., 0].ravel() - mean) ** 2)) for result in results]
    held = [r.error.low <= error <= r.error.high for r, error in zip(results, true, strict=True)]
    assert np.mean(held) > 0.9
    assert max(result.error.rmse for result in results) <= target


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_halves_count_alike_in_each_pixel_and_pilots_not_at_all(rfilter):
    """Halves of means 1 and 3, whose rays cancel in pairs, and whose pixels get different numbers of
    them: the picture is 2 but for the rounding of float32, a few of 10⁻⁷."""

    def draw(mean: float, side: int) -> Draw:
        def values(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
            signs = 1 - 2 * (np.arange(len(pixel)) % 2)
            return mean + signs * np.where(pixel // 4 % 2 == side, 2, 0.1)

        return values

    exposer = Draws(_calm, rfilter=rfilter)
    exposer.draws[:2] = draw(1, 0), draw(3, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        result = _render(exposer)
    assert np.ptp(result.rays) > 8
    np.testing.assert_allclose(result.image, 2, rtol=1e-6)


def test_rare_bright_values_keep_their_share():
    """Eight pixels of which 2 % is bright: within 4 standard errors of 4 % (f6b350c: 28 % too dark)."""
    exposer = Draws(_rare(0.02, 8))
    expected = 1.05 + 8 / PIXELS * 0.02 * 198.95
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        means = np.array([_render(exposer, seed).image.mean() for seed in range(150)])
    assert abs(means.mean() - expected) < 4 * means.std(ddof=1) / len(means) ** 0.5


@pytest.mark.parametrize("rays", [2, 3, 16])
def test_the_variance_of_few_rays_is_that_of_many(rays):
    """Of normal numbers of variance 1 in 10,000 pixels of three colours: known to 2 % and better."""
    values = np.random.default_rng(rays).normal(3, 1, (rays, 3, 100, 100)).astype(np.float32)
    sums = Sums(np.full((100, 100), rays, np.float32), values.sum(0), np.square(values).sum(0).mean(0))
    assert sums.variance.mean() == pytest.approx(1, rel=0.03)


@pytest.mark.parametrize("groups", [1, 32])
def test_pilots_know_the_variance_of_rays(groups):
    """Of normal numbers of variance 1, from the first two rays of a pixel on; the mean over 40 pictures of
    256 pixels is known to 2 %."""

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        return 5 + rng.normal(size=len(pixel))

    found = []
    for seed in range(40):
        tracer = Tracer(Draws(draw), seed)  # type: ignore[arg-type]
        first = groups * tracer.initial_allocation
        stats = tracer.trace(tracer.blank("linear"), first, lambda rays: None)
        found.append(pilot_estimate(stats).variance.mean())
    assert np.mean(found) == pytest.approx(1, rel=0.16)


def test_a_filter_makes_an_error_less_certain():
    """By the correlation of pixels: of the same rays, fewer are independent."""
    found = []
    for rfilter in ("box", "gaussian"):
        tracer = Tracer(Draws(_calm, rfilter=rfilter), seed=0)  # type: ignore[arg-type]
        stats = tracer.trace(tracer.blank("linear"), tracer.initial_allocation, lambda rays: None)
        found.append(pilot_estimate(stats).uncertainty)
    assert found[1] / found[0] == pytest.approx(tracer.film.correlation**0.5)


def test_a_target_takes_rays_enough_to_show_what_is_rare():
    """512 rays a pixel in a small picture, where the first round reaches the target."""
    result = _render(Draws(_calm), target=1e12, rays=5000)
    assert result.rounds[-1].spp == pytest.approx(512, rel=0.15)


def test_a_target_is_reached_in_few_rounds():
    """6.7 in the mean: each is as large as is foreseen to be enough, up to the growth that is allowed."""
    assert np.mean([len(_render(Draws(_calm), seed, 0.02, 9000).rounds) for seed in range(10)]) < 7.3


def test_a_tail_of_few_values_is_pulled_to_a_shape_of_a_half():
    """Of 20 values above the others, by ten more: so few of them seldom tell a heavy tail."""
    values = np.linspace(1, 0.005, 100) ** -0.1  # of a Pareto law of shape 0.1, without chance
    assert tail_shape(values, np.ones(100)) == pytest.approx((20 * 0.1 + 10 * 0.5) / 30, abs=0.05)


@pytest.mark.filterwarnings("ignore::mrt_mitsuba.MrtWarning")
def test_errors_on_a_screen_hold_where_light_is_rare():
    """In a tenth of the rays of a dark picture: the difference of the halves alone would be too small. The
    mean square of 40 pictures is known to 2 %; what clipping adds in pictures so small, to a tenth."""
    draws = Draws(lambda rng, pixel: 0.2 * (rng.random(len(pixel)) < 0.1))
    results = [_render(draws, seed, rays=16, metric="display") for seed in range(40)]
    errors = [METRICS["display"].rmse(result.image, np.full((SIDE, SIDE, 3), 0.02)) for result in results]
    stated = [result.error.rmse for result in results]
    assert np.linalg.norm(stated) / np.linalg.norm(errors) == pytest.approx(1.05, abs=0.1)


def test_the_second_round_is_sized_for_rays_that_go_to_noise(monkeypatch):
    """To a third of the error of even rays: three times as many, and what doubt about that error adds."""
    monkeypatch.setattr(rounds, "MIN_RAYS", 0)
    first = _render(Draws(_calm), rays=8).rounds[0]
    found = _render(Draws(_calm), target=first.rmse / 3, rays=9000).rounds[1]
    assert 24 < found.spp < 28


def test_denoising_must_save_more_samples_than_it_takes():
    """The time of 15: after 40, an error of 1.15 targets is 13 samples above it, one of 1.2 is 18."""
    denoiser = Denoiser(lambda: pytest.fail("no features are needed yet"))
    assert denoiser.pays(40, 1.2, 1.0)
    assert not denoiser.pays(40, 1.15, 1.0)
    assert denoiser.left_out == "13 further samples per pixel reach the target without it"


def test_errors_of_a_mixture_have_the_curvature_of_the_metric():
    """Which is a factor of squares."""
    found = []
    for curvature in (1.0, 4.0):
        tracer = Tracer(Draws(_calm), seed=0)  # type: ignore[arg-type]
        stats = tracer.trace(tracer.blank("display"), 4 * tracer.initial_allocation, lambda rays: None)
        vars(stats)["curvature"] = curvature
        plain = np.zeros((SIDE, SIDE, 3), np.float32)
        mixture = Denoiser(lambda: (plain, plain)).mixture(stats, plain_error=1.0)  # noqa: B023
        found.append([mixture.rmse, mixture.low, mixture.high, mixture.error.mean()])
    np.testing.assert_allclose(found[1], 2 * np.array(found[0]), rtol=1e-6)


@pytest.mark.parametrize(("draw", "doubtful"), [(_calm, False), (_rare(0.3), False), (_rare(0.003, 8), True)])
def test_doubt_is_for_errors_that_few_rays_rule(draw, doubtful):
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        results = [_render(Draws(draw), seed) for seed in range(20)]
    ruled = [r for r in results if r.image.max() > 1.5] if doubtful else results  # that met one at all
    share = np.mean([r.error.high == np.inf for r in ruled])
    assert len(ruled) > 9
    assert share >= 0.9 if doubtful else share == 0
    assert ["tail" in str(w.message) for w in warned].count(True) == sum(
        r.error.tail > PARETO_K_THRESHOLD for r in results
    )


@pytest.mark.parametrize(
    ("draw", "mean", "within"),
    [(_calm, 1, 1.25), (_rare(0.01), 1.05 + 1.9895, 3)],  # a tenth of the former has 256 squares: 5 %
    ids=["calm", "rare"],
)
def test_stated_errors_of_pixels_are_right_in_every_tenth(draw, mean, within):
    """Also where most pixels met no bright ray: they borrow from the others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        results = [_render(Draws(draw), seed) for seed in range(10)]
    stated = np.concatenate([r.map.ravel() for r in results])
    true = np.concatenate([(r.image[..., 0] - mean).ravel() for r in results])
    for tenth in np.array_split(np.argsort(stated), 10):
        ratio = np.sqrt(np.mean(true[tenth] ** 2) / np.mean(stated[tenth] ** 2))
        assert 1 / within < ratio < within


def test_pixels_state_what_neighbours_met_and_what_halves_differ_by():
    """A row that met no noise is not sure to have none; rays that cancel in pairs leave less than others."""

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        noise = rng.normal(size=len(pixel)) / 2
        pairs = np.where(np.arange(len(pixel)) % 2, 2, -2) + noise / 20
        return 5 + np.where(pixel % 2, pairs, noise) * (pixel // SIDE != 8)

    stated = _render(Draws(draw), rays=256).map
    even = stated[:8, ::2].mean()
    assert stated[8].mean() > 0.05 * even
    assert stated[:8, 1::2].mean() < even


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_radiance_that_is_no_number_is_named_and_left_out(value):
    """Also in a pixel where it was met once, before others met it."""
    done = list[bool]()

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        unfit = 9 * SIDE + 2 if done else 3 * SIDE + 5
        done.append(True)
        return np.where(pixel == unfit, value, _calm(rng, pixel))

    with pytest.warns(mrt.MrtWarning, match=f"radiance of {value} .* 2 pixels.* row 3, column 5") as warned:
        result = _render(Draws(draw), target=0.05, rays=4000)
    assert len(warned) == 1
    assert result.error.rmse < 0.055
    assert np.isfinite(result.map).all()


def test_what_is_done_to_a_round_does_not_change_the_picture():
    def spoil(now: Any) -> None:
        for values in (now.image, now.error, now.samples):
            values[:] = -1

    spoiled = _render(Draws(_calm), on_round=spoil)
    plain = _render(Draws(_calm))
    assert_array_equal(spoiled.image, plain.image)
    assert_array_equal(spoiled.samples, plain.samples)


def test_quiet_pixels_get_rays_enough_to_meet_a_lamp_in_a_mirror():
    """Lit by a tenth of the rays, a pixel among quiet ones is found, also where others take most rays."""

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        lit = (pixel == 130) & (rng.random(len(pixel)) < 0.1)
        return np.where(pixel < 16, rng.exponential(size=len(pixel)), 1) + 20 * lit

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mrt.MrtWarning)
        results = [_render(Draws(draw), seed, target=0.02, rays=512) for seed in range(20)]
    assert np.mean([r.image[8, 2, 0] > 1 for r in results]) > 0.9
    assert all(r.samples.min() > 8 for r in results)


def test_a_lamp_that_pilots_missed_gets_rays(monkeypatch):
    """It lights one pixel, and half of the rays there; in no pixel around it do pilots meet noise."""
    monkeypatch.setattr(rounds, "MIN_RAYS", 0)  # which show it in small pictures

    def missed(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        return np.where(pixel < 16, rng.exponential(size=len(pixel)), 1)

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        return missed(rng, pixel) + 2 * ((pixel == 130) & (rng.random(len(pixel)) < 0.5))

    exposer = Draws(draw)
    exposer.draws[2:] = 2 * [missed]
    result = _render(exposer, target=0.01, rays=4096)
    assert result.error.rmse <= 0.01
    assert result.samples[8, 2] > 64


def test_noise_of_any_size_ends_without_a_warning_of_numpy(monkeypatch):
    """Scouts without noise, halves with some; and rare rays so bright that counts would overflow."""
    monkeypatch.setattr(rounds, "MIN_RAYS", 0)
    quiet = _render(Draws(_calm, 2, lambda rng, pixel: np.ones(len(pixel))), target=10, rays=64)
    assert quiet.error.rmse < 10
    with pytest.warns(mrt.MrtWarning):
        bright = _render(Draws(_rare(0.02, bright=1e12)), target=1e-280, rays=64)
    assert bright.rounds[-1].spp <= 64


@pytest.mark.parametrize(("rfilter", "least"), [("box", 0.94), ("gaussian", 0.8)])  # shared out in tiles
def test_shares_take_all_the_room_there_is_and_no_more(rfilter, least, monkeypatch):
    """They are whole groups, found by trial: none may be left without any because a trial costs too much."""

    def draw(rng: np.random.Generator, pixel: np.ndarray) -> np.ndarray:
        return (0.1 + (pixel % SIDE == 3) + (pixel < 2 * SIDE)) * rng.normal(size=len(pixel))

    tracer = Tracer(Draws(draw, rfilter=rfilter), seed=0)  # type: ignore[arg-type]
    stats = tracer.trace(tracer.blank("linear"), tracer.initial_allocation, lambda rays: None)
    seen = pilot_estimate(stats)
    for most in np.linspace(20, 40, 101):
        allocation = tracer.allocator.allocate(stats, seen, most)
        taken = (tracer.cost(allocation) / PIXELS + 8) / most
        assert least < taken <= 1, most
    monkeypatch.setattr(tracer.allocator, "_rounding", lambda stats: np.full(stats.film.shape, 0.99))
    for most in np.linspace(20, 40, 101):
        assert tracer.cost(tracer.allocator.allocate(stats, seen, most)) / PIXELS + 8 <= most


@pytest.mark.parametrize(("error", "missed"), [(0.01, False), (0.0105, True)])
def test_a_target_that_is_missed_by_little_is_named(error, missed):
    now = rounds.Round(seconds=1.0, spp=64.0, rmse=error)
    said = rounds._target_warning(rounds.Goal(Target(0.01), 64), now, 0.01)
    assert ("is not reached: maxspp=64" in said) is missed
