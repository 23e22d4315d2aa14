"""Tables of parametrised tests, written a case a statement."""

from __future__ import annotations

from typing import Any

import pytest


class Cases(list[Any]):
    """The cases of a parametrised test: ``cases(value, ...)`` adds one, named by its values or a ``name``."""

    def __call__(self, *values: Any, name: str | None = None) -> None:
        self.append(pytest.param(*values, id=name))
