"""Tables of parametrised tests, written a case a statement."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


class Cases(list[Any]):
    """The cases of a parametrised test: ``cases(value, ...)`` adds one, named by its values or a ``name``.

    ``slow``: it takes some five seconds or more, and ``make test`` alone runs it.
    """

    def __call__(self, *values: Any, name: str | None = None, slow: bool = False) -> None:
        self.append(pytest.param(*values, id=name, marks=[pytest.mark.slow] * slow))


def but_slow(names: Iterable[str], slow: Collection[str]) -> list[Any]:
    """Names of cases, with the mark of those that take more than about ten seconds."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in slow)) for name in names]
