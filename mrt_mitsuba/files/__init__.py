"""Results and the files they are written to."""

from __future__ import annotations

from mrt_mitsuba.files.images import read_exr, save, to_8bit
from mrt_mitsuba.files.layers import LAYERS

__all__ = ["LAYERS", "read_exr", "save", "to_8bit"]
