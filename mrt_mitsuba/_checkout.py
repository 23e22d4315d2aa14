"""Import the sub-packages that are top-level folders of a source checkout.

An installed copy holds them inside the package and never loads this module. Without it, Python started in a
checkout would find this package in the current folder, but not its sub-packages.
"""

from __future__ import annotations

import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

FOLDERS = ("plugins", "scenes_xml", "validation")
_ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


class CheckoutFinder:
    """Find ``mrt_mitsuba.<folder>`` next to the package; asked last, after an installed copy."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of one of ``FOLDERS``, or None for every other module."""
        package, _, folder = name.rpartition(".")
        if package != __package__ or folder not in FOLDERS:
            return None
        from importlib.util import spec_from_file_location

        location = os.path.join(_ROOT, folder)
        init = os.path.join(location, "__init__.py")
        return spec_from_file_location(name, init, submodule_search_locations=[location])


def install() -> None:
    """Append the finder to ``sys.meta_path``, once."""
    if CheckoutFinder not in sys.meta_path:
        sys.meta_path.append(CheckoutFinder)
