"""The noise of a float32 function without a reference, after Moré and Wild, and its conditioning.

Along a line of inputs a few float32 steps apart, what a function *should* do is smooth, and differences of
high order make it vanish; what is left is noise. Digits that are lost leave stairs: those on a slope show at
no step that is small against them, so coarser lines are examined as well.
Source: Moré and Wild, "Estimating Computational Noise", SIAM J. Sci. Comput. 33(3), 2011, §§ 3, 5: with T_k
the differences of order k, σ² ≈ γ_k ⟨T_k²⟩, γ_k = (k!)² / (2k)!.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .probe import Array, Function, Lanes

ROUNDING = 2.0**-24
ALLOWANCE = 8.0  # roundings that a formula of some dozen operations may make of its own
MAX_NOISE = 2.5  # sound formulas stay below 1.6
MAX_RELATIVE_CHANGE = 0.05
POINTS = 9  # of each line; Moré and Wild find seven to nine enough
STRIDES = (2, 64)  # the most float32 steps from one to the next
COARSE = (2**8, 2**10, 2**12)  # the same for stairs on a slope; steps of a table are further apart
MIN_STAIRS = 300.0  # roundings: linear interpolation in a table of 64 entries leaves up to 150
MAX_NOISE_RATIO = 3  # a kink's noise is four times as large at four times the step
REACHES = tuple(2**k for k in (2, 5, 8, 11, 13))  # float32 steps to either side, for the slope


def ecnoise(lines: Array, *, coarse: bool = False) -> Array:
    """The noise [N] of values along lines [P, N], in their own unit; 0 where nothing is noise.

    The first order k counts from which on three estimates agree to a factor of four and whose differences
    have both signs. If none is so, it is the smallest of all; or NaN where the line is too long to tell, for
    the values change along it by more than ``MAX_RELATIVE_CHANGE`` of the largest; and NaN wherever they
    change by half.
    ``coarse``: the least of all orders from the third, and 0 where values change by half.
    """
    table = np.float64(lines)
    gamma = 1.0
    levels = []
    signs = []
    for k in range(1, len(lines)):
        table = np.diff(table, axis=0)
        gamma *= 0.5 * k / (2 * k - 1)
        levels.append(np.sqrt(gamma * (table**2).mean(axis=0)))
        signs.append((table.min(axis=0) < 0) & (table.max(axis=0) > 0))
    level = np.array(levels)
    change = np.ptp(lines, axis=0) / abs(lines).max(axis=0)
    if coarse:
        return np.where(change > 0.5, 0, level[2:].min(axis=0))
    noise = np.where(change > MAX_RELATIVE_CHANGE, np.nan, level[:-2].min(axis=0))
    for k in reversed(range(len(level) - 2)):
        three = level[k : k + 3]
        agree = three.max(axis=0) <= 4 * three.min(axis=0)
        noise = np.where(signs[k] & agree, level[k], noise)
    return np.where(change > 0.5, np.nan, noise)


def steps_away(x: Array, count: Array) -> Array:
    """The float32 numbers that lie ``count`` steps from ``x``, beyond zero where it is near."""
    ordered = np.ascontiguousarray(x, np.float32).view(np.int32).astype(np.int64)
    ordered = np.where(ordered < 0, -(2**31) - ordered, ordered) + count
    return np.where(ordered < 0, -(2**31) - ordered, ordered).astype(np.int32).view(np.float32)


@np.errstate(divide="ignore", invalid="ignore")
def measure(
    function: Function,
    inputs: Array,
    project: Function,
    *,
    seed: int = 0,
) -> Lanes:
    """Estimate the noise of ``function([M, K]) -> [M]`` at float32 inputs [N, K].

    The result has the ``noise`` in roundings (2⁻²⁴) of the value; the noise over what inputs, rounded
    twice, and ``ALLOWANCE`` other roundings explain (``lost``); and the ``stride`` of each line.

    The first of ``STRIDES`` counts along which the value changes at half of the points, since lost digits
    leave stairs, flat where a line is short. ``COARSE`` lines are examined as well; ``project`` makes inputs
    so far from the first valid again. Stairs are as high at any step that is large compared with them,
    unlike kinks and what is left of a smooth function: only noise whose ratio at two steps is at most
    ``MAX_NOISE_RATIO`` counts. Nine in ten lines are shorter than a step of a table that is read by the
    nearest of a thousand entries: that is no rounding error.
    """
    inputs = np.float32(inputs)
    rng = np.random.default_rng(seed)

    def values(steps: Array, valid: Function = lambda x: x) -> Array:
        """The function that many float32 steps [..., N, K] away. [..., N]"""
        moved = steps_away(np.broadcast_to(inputs, steps.shape), steps)
        values = function(valid(moved.reshape(-1, inputs.shape[1])))
        return values.reshape(steps.shape[:-1]).astype(np.float64)

    def along(strides: Sequence[int]) -> Array:
        """Steps along a random line for each input and stride. [strides, POINTS, N, K]"""
        ways = np.array([rng.integers(-s, s + 1, inputs.shape) for s in strides])
        return np.arange(POINTS)[:, None, None] * ways[:, None]

    lines = values(along(STRIDES))
    flat = (np.diff(lines, axis=1) == 0).mean(axis=1) > 0.5
    chosen = np.where(flat.all(axis=0), len(STRIDES) - 1, flat.argmin(axis=0))
    line = np.take_along_axis(lines, chosen[None, None], axis=0)[0]
    slope = _slope(values, inputs.shape)
    explained = np.sqrt((slope**2).sum(axis=0) / 12)  # a rounded input is within half a step: variance 1/12
    unit = ROUNDING * abs(line[0])
    noise = ecnoise(line)
    stairs = np.array([ecnoise(line, coarse=True) for line in values(along(COARSE), project)])
    small = np.minimum(stairs[:-1], stairs[1:])
    large = np.maximum(stairs[:-1], stairs[1:])
    alike = (large <= MAX_NOISE_RATIO * small) & (small > MIN_STAIRS * unit)
    both = np.where(alike, small, 0).max(axis=0)
    noise = np.where(np.nan_to_num(noise) < both, both, noise)
    lost = np.nan_to_num(noise / unit / np.hypot(2 * explained / unit, ALLOWANCE), posinf=0)
    return Lanes(noise=noise / unit, lost=lost, stride=np.take(STRIDES, chosen))


def _slope(values: Function, shape: tuple[int, ...]) -> Array:
    """The change of ``values`` per float32 step of each of K inputs [N, K]. [K, N]"""
    reaches = np.array(REACHES)[:, None, None, None, None]
    signs = np.array([1, -1])[:, None, None, None]
    steps = signs * reaches * np.eye(shape[1], dtype=int)[:, None]
    steps = np.broadcast_to(steps, (*steps.shape[:3], *shape))
    forth, back = np.moveaxis(values(steps), 1, 0)
    slope = (forth - back) / (2 * reaches[..., 0, 0])
    # of several widths, the one that agrees best with its neighbour
    best = abs(np.diff(slope, axis=0)).argmin(axis=0)[None]
    return np.take_along_axis(slope[1:], best, axis=0)[0]
