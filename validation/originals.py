"""Pictures of the original program, whole or shortened, and renders made comparable with them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrt_mitsuba.files.images import read_exr


@dataclass(frozen=True)
class Original:
    """A picture of the original program; a shortened one is a window, or means of blocks, in fewer bits."""

    image: np.ndarray  #: float32 [H, W, 3], linear
    options: dict[str, Any]  #: of ``render``, by which the original program was called
    scene: int
    window: tuple[int, int, int, int]  #: first column and row, width and height, in pixels of the whole
    block: int  #: side in pixels of the squares whose means are kept; 1: every pixel
    bits: int  #: significant ones of each value
    layers: dict[str, np.ndarray]  #: float32 [H, W] by channel

    def like(self, picture: np.ndarray) -> np.ndarray:
        """Shorten a whole picture [H, W, 3] in the same way, so that both lose the same to rounding.

        A window of it, as the means of its blocks, rounded to a number of significant bits.
        """
        x, y, width, height = self.window
        side = self.block
        part = np.float64(picture[y : y + height, x : x + width])
        part = part.reshape(height // side, side, width // side, side, -1).mean(axis=(1, 3))
        digits, exponent = np.frexp(part)
        return np.ldexp(np.round(digits * 2.0**self.bits), exponent - self.bits).astype(np.float32)


def read_original(path: str | os.PathLike[str]) -> Original:
    """Read an EXR of the original program, which has its options in the header."""
    picture = read_exr(path)
    options = json.loads(picture.header["comments"])
    whole = f"0 0 {options['width']} {options['height']}"
    x, y, width, height = map(int, picture.header.get("mrt:window", whole).split())
    return Original(
        image=picture.image,
        scene=options.pop("scene"),
        options=options,
        window=(x, y, width, height),
        block=int(picture.header.get("mrt:block", 1)),
        bits=int(picture.header.get("mrt:bits", 24)),  # of a float32
        layers=dict(picture.layers),
    )
