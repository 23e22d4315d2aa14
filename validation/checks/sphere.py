"""The sphere of directions cut into cells, small where samples are dense: for chi-square and quadrature.

A direction has a hemisphere, r = √(1 − |z|) and an azimuth. Near the normal r keeps all digits of x and y,
which the cosine loses; dω = 2 r dr dφ. A cell is a square of a quadtree in (r, φ), named by its level and the
Morton code at which it starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mrt_mitsuba.validation.checks.probe import Array, Lanes, joined

DEPTH = 17  # the finest cell is a hundred times what float32 rounding moves a direction by
SIDE = 6
POINTS = SIDE**2  # at which a cell is integrated
HEMISPHERE = 4**DEPTH  # codes of each
_SPREAD = np.sum([(np.arange(2**DEPTH) >> k & 1) << 2 * k for k in range(DEPTH)], axis=0)  # bits with gaps


def encode(wo: Array) -> Array:
    """Return the Morton codes of directions [N, 3]."""
    x, y, z = wo.T.astype(np.float64)
    r = np.sqrt((x * x + y * y) / (1 + np.abs(z)))
    turn = np.arctan2(y, x) / (2 * np.pi) + 0.5
    places = (np.clip(np.nan_to_num(u) * 2**DEPTH, 0, 2**DEPTH - 1) for u in (r, turn))
    a, b = (_SPREAD[place.astype(np.int64)] for place in places)
    return (z < 0) * HEMISPHERE + (a | (b << 1))


class Cells(Lanes):
    """Cells that cover the sphere: ``start`` and ``level`` [C], and what else is known of each."""

    @staticmethod
    def around(codes: Array, most: int, coarsest: int = 4) -> Cells:
        """Return cells that hold at most ``most`` of the directions each; only the finest may hold more."""
        codes, done = np.sort(codes), []
        start = np.arange(2 * 4**coarsest) * 4 ** (DEPTH - coarsest)
        cells = Cells(start=start, level=np.full(len(start), coarsest))
        while len(cells.start):
            first, last = np.searchsorted(codes, [cells.start, cells.end])
            full = (last - first > most) & (cells.level < DEPTH)
            done.append(cells.only(~full))
            cells = cells.only(full).quartered()
        return in_order(done)

    @property
    def end(self) -> Array:
        return self.start + 4 ** (DEPTH - self.level)

    @property
    def width(self) -> Array:
        return 0.5**self.level

    @property
    def corner(self) -> tuple[Array, Array]:
        """Return r and turn, in [0, 1), at the corners of cells."""
        bits = self.start % HEMISPHERE
        a, b = (np.searchsorted(_SPREAD, x & _SPREAD[-1]) for x in (bits, bits >> 1))
        return a / 2**DEPTH, b / 2**DEPTH

    def find(self, codes: Array) -> Array:
        """Return the index of the cell in which each direction lies."""
        return np.searchsorted(self.start, codes, side="right") - 1

    def quartered(self) -> Cells:
        """Return four cells for each, one after the other."""
        level = np.repeat(self.level + 1, 4)
        part = np.tile(np.arange(4), len(self.start))
        return Cells(start=np.repeat(self.start, 4) + part * 4 ** (DEPTH - level), level=level)

    def at(self, i: Array, j: Array) -> tuple[Array, Array]:
        """Return directions [C, P, 3] at places of each cell, from 0 to 1, and r there."""
        (r0, turn0), width = (x[:, None] for x in self.corner), self.width[:, None]
        r, turn = r0 + width * i, turn0 + width * j
        z = np.where(self.start >= HEMISPHERE, -1, 1)[:, None] * (1 - r * r)
        sin, phi = r * np.sqrt(2 - r * r), 2 * np.pi * (turn - 0.5)
        return np.stack([sin * np.cos(phi), sin * np.sin(phi), z], axis=-1).astype(np.float32), r

    def points(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return random directions in each cell, one in each part [C, POINTS, 3], and dω [C, POINTS]."""
        i, j = np.divmod(np.arange(POINTS), SIDE)
        shift = rng.random((2, len(self.start), POINTS))
        wo, r = self.at((i + shift[0]) / SIDE, (j + shift[1]) / SIDE)
        return wo, 4 * np.pi * r * (self.width[:, None] / SIDE) ** 2

    @property
    def solid_angle(self) -> Array:
        r, _ = self.corner
        return 2 * np.pi * self.width * ((r + self.width) ** 2 - r**2)

    def bounds(self, index: int) -> tuple[float, float, float, float, int]:
        """Return r and φ from … to, and the sign of z, of one cell."""
        (r, turn), width = (float(x[index]) for x in self.corner), float(self.width[index])
        phi, sign = 2 * np.pi * (turn - 0.5), -1 if self.start[index] >= HEMISPHERE else 1
        return r, r + width, phi, phi + 2 * np.pi * width, sign


def in_order(parts: Sequence[Cells]) -> Cells:
    """Return the cells of several sets, in the order of their codes."""
    cells = joined(parts)
    return cells.only(np.argsort(cells.start))


def integrate(
    function: Callable[[Array], Array],
    cells: Cells,
    rng: np.random.Generator,
    codes: Array,
    weights: Array,
    samples: int,
) -> Cells:
    """Integrate ``function(directions [N, 3]) -> [N, K]`` over cells; those known too badly are cut further.

    ``codes`` and ``weights`` of ``samples`` samples say what the first integrand gives where; the integrals
    are made as certain as so many samples would be. The cells returned have the ``mean`` of each estimate and
    its ``variance``, both [C, K].
    """
    done = []
    order = np.argsort(codes)
    codes, below = codes[order], np.concatenate([[0], np.cumsum(weights[order])]) / samples
    for attempt in range(8):
        first, last = below[np.searchsorted(codes, [cells.start, cells.end])]
        wo, omega = cells.points(rng)
        values = np.nan_to_num(function(wo.reshape(-1, 3)), posinf=0, neginf=0)
        values = values.reshape(*omega.shape, -1) * omega[..., None] * POINTS
        mean, variance = values.mean(axis=1), values.var(axis=1) / (POINTS - 1)
        total = np.abs(mean).sum(axis=0) + 1e-12
        # half of what chance does to the count of the samples, or one sample, is known well enough
        bad = (variance / total**2 > 0.25 * np.abs(mean) / total / samples + 1 / samples**2).any(axis=1)
        bad |= ((last - first) * samples > 1.5) & (mean[:, 0] < 0.2 * (last - first))
        bad &= (cells.level < DEPTH) & (attempt < 7)
        done.append(Cells(**{**vars(cells), "mean": mean, "variance": variance}).only(~bad))
        if not bad.any():
            break
        cells = cells.only(bad).quartered()
    return in_order(done)


def chi_square(found: Cells, codes: Array, count: int, known: float = 0.0) -> tuple[Array, tuple]:
    """Compare the counts of samples with those that integrals expect.

    Return χ² and its degrees of freedom [6, 2] in six ways to group cells, so that faults of any width
    show: neighbours that expect 25 samples or more, a 128th and a 16th of all, and slices along x, y and z of
    a 16th; and the cell that is most off. ``known``: to how much the density is known, relative.
    """
    seen = np.bincount(found.find(codes), minlength=len(found.start))
    expected, variance = count * found.mean[:, 0], count**2 * found.variance[:, 0]
    neighbours, tests = np.arange(len(seen)), []
    middles = found.at(np.array([0.5]), np.array([0.5]))[0][:, 0]
    ways = [(count / 25, neighbours), (128, neighbours), (16, neighbours)]
    for parts, order in ways + [(16, np.argsort(axis)) for axis in middles.T]:
        group = np.floor(np.cumsum(expected[order]) / max(count / parts, 25)).astype(int)
        group = np.minimum(group, max(group[-1] - 1, 0))
        seen_in, expected_in, variance_in = (np.bincount(group, x[order]) for x in (seen, expected, variance))
        used = (seen_in > 0) | (expected_in > 1e-6)
        variance_in += expected_in + (known * expected_in) ** 2
        pull = (seen_in - expected_in)[used] ** 2 / np.maximum(variance_in, 1e-6)[used]
        tests.append((float(pull.sum()), max(len(pull), 1)))
    cell = int(np.argmax(np.abs(seen - expected) / np.sqrt(expected + variance + 1)))
    return np.array(tests), found.bounds(cell)
