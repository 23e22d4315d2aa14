"""Pictures of the original program, whole or shortened, and renders made comparable with them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba.files.images import read_exr
from mrt_mitsuba.rendering.progress import Progress
from mrt_mitsuba.validation import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


def side_by_side(folder: str | os.PathLike[str]) -> tuple[Figure, list[dict[str, Any]]]:
    """Draw scenes 0 to 4 by the original program, by ours, and their difference times 100.

    Also return a row for each scene.
    """
    rows = []
    drawn, plots = plotting.panels(5, 3, 7.2, 9.4)
    for scene, row in enumerate(plots):
        original = read_original(Path(folder) / f"s{scene}_none_aa4.exr")
        result = mrt.render(original.scene, fresnel="dielectric", progress=Progress(), **original.options)
        ours = original.like(result.image)
        difference = np.abs(ours - original.image)
        shown = {
            f"scene {scene}, 2020": original.image,
            "this project": ours,
            "difference × 100": 100 * difference,
        }
        for axes, (title, picture) in zip(row, shown.items(), strict=True):
            plotting.show_picture(axes, picture)
            axes.set_title(title, loc="left")
        off = f"{(difference.max(axis=-1) > 1 / 255).mean():.2%}"
        mean = float(difference.mean())
        rows.append({"scene": scene, "mean difference": mean, "pixels off by > 1/255": off})
    return drawn, rows
