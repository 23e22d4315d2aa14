"""Results and the files they are written to."""

from __future__ import annotations

from mrt_mitsuba.output.files import LAYERS, read_exr, save, to_8bit

__all__ = ["LAYERS", "read_exr", "save", "to_8bit"]
