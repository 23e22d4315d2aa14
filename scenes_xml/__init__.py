"""The report's scenes as Mitsuba XML: ``sceneN.xml`` with this project's plugins, ``sceneN_stock.xml``
without.

The files are written from the dicts of ``mrt_mitsuba.scene_dict`` by ``python -m mrt_mitsuba.scenes_xml``.
"""

from __future__ import annotations

from pathlib import Path

NUMBERS = (0, 1, 2, 3, 4)


def path(number: int, flavor: str = "mrt") -> Path:
    """Where the XML of a scene lies."""
    suffix = "" if flavor == "mrt" else f"_{flavor}"
    return Path(__file__).parent / f"scene{number}{suffix}.xml"
