"""The sphere of directions cut into cells, small where samples are dense: for chi-square and quadrature.

A direction has a hemisphere, r = √(1 − |z|) and an azimuth. Near the normal r keeps all digits of x and y,
which the cosine loses; dω = 2 r dr dφ. A cell is a square of a quadtree in (r, φ), named by its level and the
Morton code at which it starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import stats

from .law import NO_LANES, Outcome, sidak
from .probe import Array, Function, Lanes, joined

MAX_LEVEL = 17  # the finest cell is a hundred times what float32 rounding moves a direction by
SIDE = 6
POINTS_PER_CELL = SIDE**2  # at which a cell is integrated
HEMISPHERE = 4**MAX_LEVEL  # codes of each
COARSEST_LEVEL = 4
SMALL_CELL_LEVEL = 7  # level of cells of about a degree
MAX_DOUBTFUL = 256  # cells that are cut because samples contradict them: if more do, the density is wrong
MAX_REFINEMENTS = 8  # at integrals that are certain enough
# bits with gaps
_SPREAD = np.sum(
    [(np.arange(2**MAX_LEVEL) >> k & 1) << 2 * k for k in range(MAX_LEVEL)], axis=0
)  # bits with gaps


def encode(wo: Array) -> Array:
    """Morton codes [N] of directions [N, 3]."""
    x, y, z = np.float64(wo.T)
    r = np.sqrt((x * x + y * y) / (1 + abs(z)))
    turn = np.arctan2(y, x) / (2 * np.pi) + 0.5
    return (z < 0) * HEMISPHERE + (_bits(r) | (_bits(turn) << 1))


def _bits(u: Array) -> Array:
    """The bits of numbers in [0, 1), with gaps between them for those of another."""
    place = np.clip(np.nan_to_num(u) * 2**MAX_LEVEL, 0, 2**MAX_LEVEL - 1)
    return _SPREAD[place.astype(np.int64)]


class Cells(Lanes):
    """Cells that cover the sphere: ``start`` and ``level`` [C], and what else is known of each."""

    @staticmethod
    def uniform(level: int) -> Cells:
        """All cells of a level."""
        start = np.arange(2 * 4**level) * 4 ** (MAX_LEVEL - level)
        return Cells(start=start, level=np.full(len(start), level))

    @staticmethod
    def around(codes: Array, most: int) -> Cells:
        """Cells that hold at most ``most`` of the directions each; only the finest may hold more."""
        codes = np.sort(codes)
        done = []
        cells = Cells.uniform(COARSEST_LEVEL)
        while len(cells.start):
            first, last = np.searchsorted(codes, [cells.start, cells.end])
            full = (last - first > most) & (cells.level < MAX_LEVEL)
            done.append(cells[~full])
            cells = cells[full].quartered()
        return in_order(done)

    @property
    def end(self) -> Array:
        return self.start + 4 ** (MAX_LEVEL - self.level)

    @property
    def width(self) -> Array:
        return 0.5**self.level

    @property
    def corner(self) -> tuple[Array, Array]:
        """r and turn, in [0, 1), at the corners of cells. [C], [C]"""
        bits = self.start % HEMISPHERE
        r = np.searchsorted(_SPREAD, bits & _SPREAD[-1])
        turn = np.searchsorted(_SPREAD, bits >> 1 & _SPREAD[-1])
        return r / 2**MAX_LEVEL, turn / 2**MAX_LEVEL

    @property
    def below(self) -> Array:
        """True for cells of the lower hemisphere. [C]"""
        return self.start >= HEMISPHERE

    def find(self, codes: Array) -> Array:
        """Index of the cell in which each direction lies."""
        level = self.level[0]
        if len(self.start) == 2 * 4**level:  # all cells of one level, which are found without a search
            return codes // 4 ** (MAX_LEVEL - level)
        return np.searchsorted(self.start, codes, side="right") - 1

    def quartered(self) -> Cells:
        """Four cells for each, one after the other."""
        level = np.repeat(self.level + 1, 4)
        part = np.tile(np.arange(4), len(self.start))
        return Cells(start=np.repeat(self.start, 4) + part * 4 ** (MAX_LEVEL - level), level=level)

    def at(self, i: Array, j: Array) -> tuple[Array, Array]:
        """Directions [C, P, 3] at places of each cell, from 0 to 1, and r there [C, P]."""
        r0, turn0 = self.corner
        width = self.width[:, None]
        r = r0[:, None] + width * i
        phi = 2 * np.pi * (turn0[:, None] + width * j - 0.5)
        z = np.where(self.below, -1, 1)[:, None] * (1 - r * r)
        sin = r * np.sqrt(2 - r * r)
        return np.stack([sin * np.cos(phi), sin * np.sin(phi), z], axis=-1).astype(np.float32), r

    def points(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Random directions in each cell, one in each part [C, P, 3], and dω [C, P]."""
        i, j = np.divmod(np.arange(POINTS_PER_CELL), SIDE)
        shift = rng.random((2, len(self.start), POINTS_PER_CELL))
        wo, r = self.at((i + shift[0]) / SIDE, (j + shift[1]) / SIDE)
        return wo, 4 * np.pi * r * (self.width[:, None] / SIDE) ** 2

    @property
    def middle(self) -> Array:
        """The directions in the middle of cells. [C, 3]"""
        half = np.array([0.5])
        wo, _ = self.at(half, half)
        return wo[:, 0]

    def bounds(self, index: int) -> tuple[float, ...]:
        """r and φ from … to, and the sign of z, of one cell."""
        r, turn = (float(x[index]) for x in self.corner)
        width = float(self.width[index])
        phi = 2 * np.pi * (turn - 0.5)
        return r, r + width, phi, phi + 2 * np.pi * width, -1 if self.below[index] else 1

    def counts(self, codes: Array) -> Array:
        """Number of directions in each cell. [C]"""
        return np.bincount(self.find(codes), minlength=len(self.start))

    def integrals(self, function: Function, rng: np.random.Generator) -> tuple[Array, Array]:
        """Integrals of ``function(directions [N, 3]) -> [N]`` over cells, and their variances. [C], [C]"""
        wo, omega = self.points(rng)
        values = function(wo.reshape(-1, 3)).reshape(omega.shape) * omega * POINTS_PER_CELL
        return values.mean(axis=1), values.var(axis=1) / (POINTS_PER_CELL - 1)

    def rows(self) -> Iterator[Array]:
        """For each cell [C] the number of its row: of one r or azimuth, or in slices along x and y."""
        r, turn = self.corner
        x, y, _ = self.middle.T
        for place in (r, turn, 0.5 + 0.4999 * x, 0.5 + 0.4999 * y):
            yield np.floor(place / self.width).astype(int) * 2 + self.below


def summed(counts: Array, group: Array) -> Array:
    """Sums of counts [K, C] over groups of cells; ``group`` [C] is the number of each cell's group. [K, G]"""
    return np.array([np.bincount(group, row) for row in counts])


def hold_small(law: Outcome, cells: Cells, counts: Array, known: float, at: Lanes = NO_LANES) -> None:
    """Check ``small`` by the smallest p-value of counts in cells, and ``slices`` by that of their rows.

    ``counts`` [3, C]: samples seen, samples expected, and the variance of the latter. ``known``: the relative
    error to which densities are known.
    """
    chances = chances_of(counts, known)
    cell = cells.bounds(int(chances.argmin()))
    law.check("small", p_value_of_least(chances, len(chances)), at, cell=cell)
    chances = np.concatenate([chances_of(summed(counts, row), known) for row in cells.rows()])
    law.check("slices", p_value_of_least(chances, len(chances)), at)


def chances_of(counts: Array, known: float) -> Array:
    """The one-sided p-values of ``counts`` [3, C] by a Poisson distribution. [C]"""
    seen, expected, variance = counts
    room = 3 * np.sqrt(variance) + known * expected  # is not Poisson's
    many = stats.poisson.sf(seen - 1, expected + room)
    few = stats.poisson.cdf(seen, expected - room)
    return np.minimum(many, np.where(expected > room, few, 1))


def p_value_of_least(chances: Array, tests: int) -> float:
    """The p-value of the smallest of so many two-sided tests."""
    return sidak(chances.min(), 2 * tests)


def in_order(parts: Sequence[Cells]) -> Cells:
    """The cells of several sets, in the order of their codes."""
    cells = joined(parts)
    return cells[np.argsort(cells.start)]


def integrate(
    function: Function, cells: Cells, rng: np.random.Generator, codes: Array, samples: int
) -> Cells:
    """Integrate ``function(directions [N, 3]) -> [N]`` over cells; those known too badly are cut further.

    ``codes`` of ``samples`` samples say where how much is expected; the integrals are made as certain as so
    many samples would be. The cells returned have the ``mean`` of each estimate and its ``variance``. [C]
    """
    done = []
    codes = np.sort(codes)
    for attempt in range(MAX_REFINEMENTS):
        first, last = np.searchsorted(codes, [cells.start, cells.end])
        seen = last - first
        mean, variance = cells.integrals(function, rng)
        total = mean.sum() + 1e-12
        # half of what chance does to the count of the samples, or one sample, is known well enough
        enough = 0.25 * mean / total / samples + 1 / samples**2
        bad = variance / total**2 > enough
        bad |= (seen > 1) & (mean < 0.2 * seen / samples)
        # a corner of a bright texel may lie between the points of a cell
        doubtful = (seen - samples * mean) ** 2 > 16 * (samples * mean + samples**2 * variance + 1)
        if doubtful.sum() < MAX_DOUBTFUL:
            bad |= doubtful
        bad &= (cells.level < MAX_LEVEL) & (attempt < MAX_REFINEMENTS - 1)
        done.append(cells.having(mean=mean, variance=variance)[~bad])
        if not bad.any():
            break
        cells = cells[bad].quartered()
    return in_order(done)


def compared(cells: Cells, density: Function, codes: Array, count: int, rng: np.random.Generator) -> Array:
    """Samples that are seen in each cell, those expected of ``count``, and the variance of the latter. [3, C]

    ``codes`` are those of the samples seen.
    """
    fine = integrate(density, cells, rng, codes, count)
    cell = cells.find(fine.start)
    mean = np.bincount(cell, fine.mean)
    variance = np.bincount(cell, fine.variance)
    return np.array([cells.counts(codes), count * mean, count**2 * variance])


def chi_square(
    integrals: Cells, codes: Array, count: int, known: float = 0.0
) -> tuple[Array, tuple[float, ...]]:
    """Compare the counts of samples with those that integrals expect.

    The first result is χ² and its degrees of freedom [6, 2] in six ways to group cells, so that faults of any
    width show: neighbours that expect 25 samples or more, a 128th and a 16th of all, and slices along x, y
    and z of a 16th. The second is the cell that is most off. ``known``: to how much the density is known,
    relative.
    """
    expected = count * integrals.mean
    counts = np.array([integrals.counts(codes), expected, count**2 * integrals.variance])
    neighbours = np.arange(len(expected))
    ways = [(count / 25, neighbours), (128, neighbours), (16, neighbours)]
    ways += [(16, np.argsort(axis)) for axis in integrals.middle.T]
    tests = []
    for parts, order in ways:
        below = np.cumsum(expected[order])
        group = np.floor(below / max(count / parts, 25)).astype(int)
        group = np.minimum(group, max(group[-1] - 1, 0))
        seen, wanted, variance = summed(counts[:, order], group)
        variance += wanted + (known * wanted) ** 2
        used = (seen > 0) | (wanted > 1e-6)
        pull = (seen - wanted)[used] ** 2 / np.maximum(variance, 1e-6)[used]
        tests.append((pull.sum(), max(len(pull), 1)))
    worst = abs(counts[0] - expected) / np.sqrt(counts[1:].sum(axis=0) + 1)
    return np.array(tests), integrals.bounds(worst.argmax())
