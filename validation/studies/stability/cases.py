"""Cases of the stability study: what was done, is expected and came out, and the bound it is held to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import mitsuba as mi

from mrt_mitsuba import runtime
from mrt_mitsuba.validation.tools.study import Bound, Study

COLUMNS = ("case", "what", "expected", "measured", "bound", "")


@dataclass
class Cases:
    """Rows of one table. A case with a bound is held to it; one without cannot hold, and says why.

    Each upper bound states the least fault that it shows. A ``fault`` is one that was made, in words, with
    the figure that came of it, which must be twice the bound. Without one, the bound itself is the least.
    """

    study: Study
    name: str
    title: str
    rows: list[tuple[str, str, str, float, str, str]] = field(default_factory=list)
    bounds: list[Bound] = field(default_factory=list)

    def at_most(
        self,
        name: str,
        what: str,
        expected: str,
        measured: float,
        limit: float,
        *,
        fault: tuple[str, float] | None = None,
    ) -> None:
        """Add a case whose figure must not exceed ``limit``."""
        least = fault[0] if fault else f"{limit:.3g}" if limit else "a single one"
        title = f"{self.title}: {name}"
        self._add(Bound(title, float(measured), float(limit), note=f"least fault: {least}"), what, expected)
        if fault:
            self.at_least(f"{name}, its fault", least, "seen", fault[1], 2 * limit or 1)

    def at_least(self, name: str, what: str, expected: str, measured: float, limit: float) -> None:
        """Add a case whose figure must not be below ``limit``; ``expected`` is the reason, too."""
        bound = Bound(f"{self.title}: {name}", float(measured), float(limit), False, expected)
        self._add(bound, what, expected)

    def beyond_float32(self, name: str, what: str, measured: float, why: str) -> None:
        """Add a case that no float32 renderer can pass: its figure is shown, not held to anything."""
        self.rows.append((name, what, why, float(measured), "-", "cannot hold"))

    def close(self, note: str = "") -> None:
        """Give table and bounds to the study."""
        self.study.bounds += self.bounds
        self.study.table(self.name, self.title, COLUMNS, self.rows, note)

    def _add(self, bound: Bound, what: str, expected: str) -> None:
        name, limit = bound.name.removeprefix(f"{self.title}: "), f"{bound.sign} {bound.limit:.3g}"
        self.rows.append((name, what, expected, bound.measured, limit, bound.verdict))
        self.bounds.append(bound)


def both_variants() -> Iterator[str]:
    """Go through the current variant and the scalar one; yield what to add to the names of cases."""
    before = mi.variant()
    yield ""
    runtime.use(runtime.SLOW)
    try:
        yield f" ({runtime.SLOW})"
    finally:
        runtime.use(before)
