"""Write the XML files anew: ``python -m mrt_mitsuba.scenes_xml``."""

from __future__ import annotations

from mrt_mitsuba.scene.export import write_xml
from mrt_mitsuba.scene.model import FLAVORS
from mrt_mitsuba.scenes_xml import NUMBERS, path

for number in NUMBERS:
    for flavor in FLAVORS:
        write_xml(number, path(number, flavor), flavor=flavor)
