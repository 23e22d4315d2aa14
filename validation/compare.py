"""Two pictures of the same thing: how far one is from the other, and whether noise alone explains it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mrt_mitsuba.adaptive.metric import METRICS
from mrt_mitsuba.adaptive.tails import exceedance
from mrt_mitsuba.errors import OutputError, UsageError, needs_extra
from mrt_mitsuba.files.images import read_channels, save
from mrt_mitsuba.files.replacing import check_target
from mrt_mitsuba.rendering.api import Result
from mrt_mitsuba.validation.laws.law import sidak

Array = np.ndarray
Picture = Any  # the path of an EXR, an array or the result of a render
ORDER = "RGBXYZUVA"  # of channels within a layer, after others
ROUNDING = 1e-5  # relative size of differences that are float32's: sums in another order, fused operations
EPSILON = 0.01  # keeps black pixels from dominating the relative error
CELL = 16  # pixels, side of the cells whose means are compared
MAX_BLOCKS = 64  # along a side of the picture; the signs of a block change together
# Random changes of signs, and number of the largest results to which an exponential tail is fitted
SIGN_CHANGES = 500
TAIL_SIZE = 25
CHEAP = ("mae", "rmse", "rel_mse", "display", "psnr", "largest", "p_value")
MEASURES = (*CHEAP[:-1], "flip", "p_value")
# HDR-FLIP exposes from where the brightest value is tone-mapped (ACES) to 0.85 to where the median is
FLIP_WHITE = 2.11887
MAX_EXPOSURES = 16  # stops between the first and the last exposure
FLIP_LARGEST = 1e10  # larger values are white in every exposure
LUMINANCE = (0.2126, 0.7152, 0.0722)
UNDEFINED = {  # why a measure may be None
    "flip": "FLIP needs three channels, finite and not negative, a reference that is not black, and the "
    "package flip-evaluator",
    "p_value": 'neither has a layer "error" next to its picture',
}


@dataclass(frozen=True)
class Difference:
    """Difference of ``a`` from ``b``, the reference; infinite where only one of them is."""

    mae: float  #: mean absolute error
    rmse: float  #: root of the mean squared error
    rel_mse: float  #: mean of (a − b)² / (b² + 0.01)
    display: float  #: RMSE of sRGB values clipped to [0, 1], as on a screen; a grey level is 1/255
    psnr: float  #: peak signal-to-noise ratio in dB, for a peak of 1
    largest: float  #: largest absolute error of a channel
    place: tuple[int, int]  #: row and column of the largest error
    p_value: float | None  #: of as much difference by noise alone; None where no noise is known
    difference: Array = field(repr=False)  #: a − b, float32 [H, W, C]
    pictures: tuple[Array, Array] = field(repr=False)
    inputs: tuple[str, ...] = ()  #: paths of the files that were compared

    @cached_property
    def flip(self) -> float | None:
        """Mean of HDR-FLIP (Andersson et al. 2021), the difference that a viewer sees, from 0 to 1.

        Exposures are chosen from the reference. None where it is not defined. A megapixel takes a minute.
        """
        a, b = self.pictures
        if a.shape[2] != 3 or find_spec("flip_evaluator") is None or not b.any():
            return None
        if not all(np.isfinite(p).all() and (p >= 0).all() for p in self.pictures):
            return None
        import flip_evaluator

        # Exposed here, since the package ends the process where its own choice of exposures fails
        luminance = b @ np.array(LUMINANCE)
        scale = FLIP_WHITE / luminance.max()
        stops = np.log2(luminance.max() / max(np.median(luminance), luminance.max() / 2**MAX_EXPOSURES))
        exposures = {"startExposure": 0.0, "stopExposure": float(stops)}
        exposures["numExposures"] = max(2, math.ceil(stops))
        test, reference = (np.minimum(p * scale, FLIP_LARGEST).astype(np.float32) for p in (a, b))
        return float(
            flip_evaluator.evaluate(reference, test, "HDR", applyMagma=False, parameters=exposures)[1]
        )

    def measures(self, names: Sequence[str] = MEASURES) -> dict[str, float | None]:
        """Measures by name, by default all."""
        return {name: getattr(self, name) for name in names}

    @needs_extra()
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the signed difference as .exr, and its size in false colours as .png, black for none.

        The ending of ``path`` does not matter. Raises ``OutputError``, also for a file that was compared.
        """
        from matplotlib import colormaps

        if not Path(path).name.strip("."):
            raise OutputError(f"cannot write {str(path)!r}: it names no file")
        stem = Path(path).with_suffix("") if Path(path).suffix in (".exr", ".png") else Path(path)
        for ending in ("exr", "png"):
            check_target(f"{stem}.{ending}", self.inputs)
        values = self.difference
        shown = values if values.shape[2] == 3 else np.repeat(values[..., :1], 3, axis=2)
        save(f"{stem}.exr", shown, header={k: str(v) for k, v in self.measures(CHEAP).items()})
        size = abs(values).max(axis=2)
        scale = np.max(size, initial=0, where=np.isfinite(size)) or 1
        colors = colormaps["inferno"](size / scale)  # what is above 1 as 1
        save(f"{stem}.png", np.float32(colors[..., :3]))

    def text(self, names: Sequence[str] = MEASURES) -> str:
        """Return a line for each of these measures, and one that says where the largest difference is."""
        lines = [f"{name:<8} {'-' if v is None else f'{v:.4g}'}" for name, v in self.measures(names).items()]
        return "\n".join([*lines, f"the largest is at row {self.place[0]}, column {self.place[1]}"])

    def __str__(self) -> str:
        return self.text()


def compare(a: Picture, b: Picture, layer: str = "") -> Difference:
    """Compare a picture with a reference.

    Args:
        a, b: each the path of an EXR, an array [H, W] or [H, W, C], or the result of ``render``.
        layer: of an EXR or a result ("depth"), or one channel of it ("depth.Z"); by default the picture.

    The p-value needs a layer "error", the standard error of each pixel, next to the picture, as
    ``render(target=...)`` and ``aamode="noise"`` write it, whatever the film's filter.

    An EXR of several parts has each as a layer, by its name. Raises ``UsageError`` for what cannot be
    compared: another size or data window, no such layer, NaN.
    """
    sides = [read_layer(side, layer, name) for side, name in ((a, "a"), (b, "b"))]
    (first, _, window), (second, _, other) = sides
    if first.shape != second.shape:
        sizes = " and ".join("{1}x{0} with {2} channels".format(*side[0].shape) for side in sides)
        raise UsageError(f"cannot compare pictures of {sizes}: their sizes must be the same")
    if window and other and window != other:
        raise UsageError(f"cannot compare the data windows {window} and {other}: they show other places")
    with np.errstate(all="ignore"):
        difference = np.where(first == second, 0, first - second)  # inf where both are
        size = abs(difference)
        square = difference**2
        relative = np.where(np.isinf(square), np.inf, square / (second**2 + EPSILON))
        psnr = -10 * np.log10(square.mean())
    return Difference(
        mae=float(size.mean()),
        rmse=float(square.mean() ** 0.5),
        rel_mse=float(relative.mean()),
        display=METRICS["display"].rmse(first, second),
        psnr=float(psnr),
        largest=float(size.max()),
        place=divmod(int(size.max(axis=2).argmax()), size.shape[1]),
        p_value=_p_value(sides),
        difference=np.float32(difference),
        pictures=(first, second),
        inputs=tuple(os.fspath(side) for side in (a, b) if isinstance(side, str | os.PathLike)),
    )


# A picture or layer [H, W, C] in float64; the variance of its mean [H, W, 1], if it is known; and of an EXR
# the first column and row, and the last ones
Layer = tuple[Array, Array | None, tuple[int, ...]]


def read_layer(source: Picture, layer: str = "", name: str = "the picture") -> Layer:
    """Return the picture, or a layer of it, of whatever ``compare`` takes. Raises ``UsageError``."""
    if isinstance(source, str | os.PathLike):
        name = os.fspath(source)
        try:
            found = _layer_of(*read_channels(source), layer, name)
        except OutputError as error:
            raise UsageError(f"{error}; only EXR files can be compared") from error
    elif isinstance(source, Result):
        picture = {letter: source.image[..., i] for i, letter in enumerate("RGB")}
        found = _layer_of({**picture, **source.layers}, {}, layer, f"result {name}")
    elif layer:
        raise UsageError(f"{name} is an array, which has no layer {layer!r}: give a result or an EXR")
    else:
        values = np.asarray(source, np.float32)
        if values.ndim not in (2, 3) or not values.size:
            raise UsageError(f"{name} has the shape {values.shape}: a picture is [H, W] or [H, W, C]")
        found = np.atleast_3d(values).astype(np.float64), None, ()
    bad = np.argwhere(np.isnan(found[0]).any(axis=-1))
    if len(bad):
        place = f"row {bad[0][0]}, column {bad[0][1]}"
        raise UsageError(
            f"{name} is NaN in {len(bad)} pixels, the first at {place}: replace NaNs before comparing"
        )
    return found


def _layer_of(channels: Mapping[str, Array], headers: Mapping[str, Any], layer: str, name: str) -> Layer:
    """Return a layer of channels by name, with its variance and window where they are known."""
    groups: dict[str, list[str]] = {}  # channels by layer, in order
    for key in sorted(channels, key=lambda key: (ORDER.find(key[-1]), key)):
        groups.setdefault(key.rpartition(".")[0] or key, []).append(key)
    picture = [c for c in "RGB" if c in channels] or [*channels.keys() & {"Y"}]
    keys = picture if not layer else [layer] if layer in channels else groups.get(layer)
    if not keys:
        raise UsageError(f"{name} has no layer {layer or 'R, G, B'!r}; it has {', '.join(sorted(groups))}")
    window = tuple(int(n) for corner in (headers[keys[0]]["dataWindow"] if headers else ()) for n in corner)
    found = _stacked(channels, keys)
    if layer:
        return found, None, window
    if "variance" in groups:
        return found, _stacked(channels, groups["variance"]), window
    if "error" in groups:  # of linear values, unless another metric was asked for
        return found, _stacked(channels, groups["error"]) ** 2, window
    return found, None, window


def _stacked(channels: Mapping[str, Array], names: Sequence[str]) -> Array:
    """Return channels as an array [H, W, names]."""
    return np.stack([channels[name] for name in names], -1, dtype=np.float64)


def _p_value(sides: Sequence[Layer]) -> float | None:
    """Return the probability that noise alone makes so large a difference, of the mean of channels.

    Uniform for equal pictures of equal noise. Means over cells are tested by the signs of differences alone,
    which is exact. How the largest difference over its deviation continues the tail of the others depends on
    sizes alone; it is wrong where a single ray may cause it, and has a hundredth of the level.
    """
    variances = [variance.mean(axis=2) for _, variance, _ in sides if variance is not None]
    if not variances:
        return None
    values = [picture.mean(axis=2) for picture, _, _ in sides]
    brightness = np.maximum(*np.abs(values))
    rounding = ROUNDING * (brightness + brightness.mean())
    difference = values[0] - values[1]
    difference -= np.clip(difference, -rounding, rounding)
    pixels = exceedance(abs(difference) / np.sqrt(sum(variances) + rounding**2 + 1e-300))
    least = min(_p_of_means(difference) / 0.99, pixels / 0.01)
    return float(-np.expm1(np.log1p(-min(0.99 * least, 1 - 1e-15)) + np.log1p(-0.01 * least)))


def _p_of_means(difference: Array) -> float:
    """Return the probability of the means of differences [H, W] between equal pictures, over cells and all.

    Their noise is as often positive as negative, whatever its law. So the least p value of Student's test is
    compared with those after random changes of sign of blocks of pixels; where it is among the least of
    these, with the exponential law that their logarithms continue. Under a film's filter, neighbours share
    rays, which their signs show; their correlation, taken for a Gaussian's, says how much wider sums are.
    """
    from scipy import stats

    side = -(-max(difference.shape) // MAX_BLOCKS)
    rows = difference[1:] * difference[:-1]
    columns = difference[:, 1:] * difference[:, :-1]
    near = np.append(rows, columns)
    both = np.sign(near)
    shared = both.sum() > 3 * np.count_nonzero(both) ** 0.5
    alike = max(near.sum(), 0) / 2 / (difference**2).sum() if shared else 0
    apart = np.arange(1, 4)  # pixels
    correlation = 2 * alike**apart**2
    wide = 1 + correlation.sum()
    inside = 1 + (correlation * np.maximum(1 - apart / side, 0)).sum()  # of a block
    picture = difference[None, ..., None]
    count = cell_sums(np.ones_like(picture), side)
    square = cell_sums(picture**2, side)
    blocks = cell_sums(picture, side)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (SIGN_CHANGES, *blocks.shape[1:]))
    blocks = np.concatenate([blocks, signs * blocks])
    least = np.inf
    for size in (max(CELL // side, CELL // 2), MAX_BLOCKS):
        pixels = cell_sums(count, size)
        squares = cell_sums(square, size)
        most = np.maximum(squares * pixels, 1e-300)
        share = np.minimum(cell_sums(blocks, size) ** 2 / most, 1 - 1e-15)
        t = np.sqrt((pixels - 1) * share / (1 - share)).max((1, 2, 3))
        t[0] *= inside / wide
        p = stats.t.sf(t, max(pixels.max() - 1, 1))  # of one side: only compared with each other
        least = np.minimum(least, p * max(np.count_nonzero(squares), 1))
    surprise = -np.log(least + 1e-300)
    others = np.sort(surprise[1:])[::-1]
    tail = others[:TAIL_SIZE] - others[TAIL_SIZE]
    if surprise[0] > others[TAIL_SIZE] and tail.any():
        return float(TAIL_SIZE / SIGN_CHANGES * np.exp((others[TAIL_SIZE] - surprise[0]) / tail.mean()))
    return float(np.mean(others >= surprise[0]))


# ------------------------------------------ Sets of renders ------------------------------------------


def p_values(ours: ArrayLike, theirs: ArrayLike) -> dict[str, float]:
    """Compare two sets of two or more independent renders [N, H, W, C].

    Return the p values of three questions, each with power where the others have little: does any single
    "pixel" differ (a dropped light, a flipped normal), does any "tile" of ``CELL`` × ``CELL`` pixels (a wrong
    roughness), does the whole "image" (a scale of 1.02)? By Welch's t-test with Šidák's correction for
    all that is asked: of equal pictures, the least of the three is below a level as often as the level says.
    Differences of a relative size of ``ROUNDING`` do not count.
    """
    from scipy import stats

    sides = [np.asarray(renders, np.float64) for renders in (ours, theirs)]
    light = np.maximum(*(abs(s.mean(axis=0)) for s in sides))
    sizes = {"pixel": 1, "tile": CELL, "image": max(light.shape)}
    found = {}
    for name, size in sizes.items():
        floor = ROUNDING * cell_sums(light + light.mean(), size) + 1e-30
        of_each = []  # mean, standard deviation, count
        for s in (cell_sums(side, size) for side in sides):
            of_each += [s.mean(axis=0), np.sqrt(s.var(axis=0, ddof=1) + len(s) / 2 * floor**2), len(s)]
        p = stats.ttest_ind_from_stats(*of_each, equal_var=False).pvalue
        found[name] = sidak(float(p.min()), p.size * len(sizes))
    return found


def averaged(pictures: ArrayLike) -> tuple[Array, Array]:
    """Return the mean of independent pictures [H, W, channels], in float64, and its squared error [H, W]."""
    pictures = np.asarray(pictures)
    mean = pictures.mean(axis=0, dtype=np.float64)
    return np.asarray(mean), pictures.var(axis=0, ddof=1).mean(axis=-1) / len(pictures)


def cell_sums(values: Array, size: int) -> Array:
    """Return the sums [..., rows, columns, C] over cells of ``size`` × ``size`` pixels."""
    for axis in (-3, -2):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], size), axis=axis)
    return values
