"""The edge detectors as ``aamode`` names them; the filters themselves are in ``mrt_mitsuba.filters``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Detector:
    """A row of the table: ``filters.<name>_edges``, and what it reads."""

    name: str
    reads: tuple[str, ...]  #: layers, in the order of the filter's arguments
    takes_variance: bool  #: can it distinguish noise from edges


DETECTORS = {
    detector.name: detector
    for detector in (
        Detector("luma", ("image",), takes_variance=True),
        Detector("sobel", ("image",), takes_variance=True),
        Detector("geometry", ("normal", "depth"), takes_variance=False),
    )
}
