"""A case of the stability study: what is measured, and why it holds to a limit or cannot."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """A row of a table."""

    name: str
    what: str  #: is measured
    why: str  #: it is held to its limit, or cannot hold
    measured: float
    limit: float | None = None  #: None where nothing can be promised
    at_most: bool = True  #: else: at least
