"""Makes the sub-packages that are top-level folders of a source checkout importable from there.

An installed copy holds them inside the package and never loads this module. Without it, Python started in a checkout
would find this package in the current folder, but not its sub-packages.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

FOLDERS = ("plugins", "scenes_xml", "validation")
_ROOT = Path(__file__).resolve().parent.parent


class CheckoutFinder:
    """Finds ``mrt_mitsuba.<folder>`` beside the package; asked last, after the finders of an installed copy."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of one of ``FOLDERS``, or None for every other module."""
        package, _, folder = name.rpartition(".")
        if package != __package__ or folder not in FOLDERS:
            return None
        location = _ROOT / folder
        init = location / "__init__.py"
        if not init.is_file():
            return None
        return importlib.util.spec_from_file_location(name, init, submodule_search_locations=[str(location)])


def install() -> None:
    """Append the finder to ``sys.meta_path``, once."""
    if CheckoutFinder not in sys.meta_path:
        sys.meta_path.append(CheckoutFinder)  # type: ignore[arg-type]
