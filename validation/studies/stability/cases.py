"""A case of the stability study, which is a row of its tables."""

from __future__ import annotations

from typing import NamedTuple


class Case(NamedTuple):
    """A figure and its limit; one without a limit cannot hold in float32, and says why.

    An upper limit states the least fault that it shows: that of ``fault``, one that was made, in words, with
    the figure that came of it, which must be twice the limit; without one, the limit itself.
    """

    name: str
    what: str  # is measured
    why: str  # it is held to this limit, or cannot hold
    measured: float
    limit: float | None = None
    fault: tuple[str, float] | None = None
    at_most: bool = True  # else: at least
