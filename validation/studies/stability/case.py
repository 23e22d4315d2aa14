"""A case of the stability study: a measured figure, with the reason for its limit or for having no limit."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """A row of a table."""

    name: str
    what: str  #: is measured
    why: str  #: it is held to its limit, or cannot hold
    measured: float = math.nan
    limit: float | None = None  #: None where nothing can be promised
    at_most: bool = True  #: else: at least
