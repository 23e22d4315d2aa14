"""Tables of parametrised tests, written a case a statement."""

from __future__ import annotations

from typing import Any

import pytest


class Cases(list[Any]):
    """The cases of a parametrised test: ``cases(value, ...)`` adds one, named by its values or a ``name``.

    ``slow``: it takes more than about ten seconds.
    """

    def __call__(self, *values: Any, name: str | None = None, slow: bool = False) -> None:
        self.append(pytest.param(*values, id=name, marks=[pytest.mark.slow] * slow))
