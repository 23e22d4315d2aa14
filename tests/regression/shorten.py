"""Shorten the original program's pictures to test data: ``python tests/regression/shorten.py RENDERS``.

Says which window of each scene tells most: the detectors must mark the same pixels in it, in fewer bits.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import OpenEXR

from mrt_mitsuba.files.images import read_exr
from mrt_mitsuba.filters import luma_edges, sobel_edges
from mrt_mitsuba.validation.originals import shortened

DATA = Path(__file__).parent / "data"
WHOLE, WIDTH, HEIGHT = (0, 0, 320, 240), 56, 36
HALF, MOST = 11, 16  # significant bits; the detectors look at the last of eight
DETECTORS = {"luma": luma_edges, "sobel": sobel_edges}
WINDOWS = [f"s{mode}" for mode in ["0_luma_aa4", "1_sobel_aa4", "2_luma_aa4", "3_sobel_aa4"]]
WINDOWS += ["s2_sobel_aa4_dof", "s3_default", "s4_default"]


def write(name: str, renders: Path, window: tuple[int, int, int, int], block: int, bits: int, **layers):
    """Write a shortened picture with its options, as half floats if these hold all bits."""
    picture = read_exr(renders / f"{name}.exr")
    image = shortened(picture.image, window, block, bits)
    channels = {"RGB": image.astype(np.float16) if bits <= HALF else image}
    channels |= {f"{layer}.Y": np.float16(values) for layer, values in layers.items()}
    header = {"comments": picture.header["comments"], "mrt:window": " ".join(map(str, window))}
    header |= {"mrt:block": block, "mrt:bits": bits, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File({**header, "type": OpenEXR.scanlineimage}, channels).write(str(DATA / f"{name}.exr"))


def refined(plain: np.ndarray, full: np.ndarray, adaptive: np.ndarray) -> np.ndarray:
    """Return 1 for pixels that were refined, 0 for others, and 0.5 where refining changes nothing."""
    same = (plain == full).all(axis=-1)
    return np.where(same, 0.5, (adaptive == full).all(axis=-1))


def window_of(scene: int, plain: np.ndarray, masks: dict[str, np.ndarray]) -> tuple[int, int, int, int]:
    """Return the window with most edges and most smooth pixels, in which rounding changes no decision.

    That of scene 9 shows the floor, far from the cone, which is broken in the original.
    """
    best, found = -1.0, (0, 0, 0, 0)
    for y in range(180 if scene == 9 else 40, 205, 4):
        for x in range(8, 257, 8):
            window = (x, y, WIDTH, HEIGHT)
            short = shortened(plain, window, 1, MOST)
            inside = np.s_[y + 1 : y + HEIGHT - 1, x + 1 : x + WIDTH - 1]
            shares = []
            for name, detect in DETECTORS.items():
                mask = np.asarray(detect(short).mask)[1:-1, 1:-1]
                told = masks[name][inside] != 0.5
                alike = (mask == masks[name][inside])[told].all()
                marked = mask[told].mean() if alike and told.any() else 0.0
                shares.append(min(marked, 1 - marked))
            telling = max(shares) if scene == 9 else min(shares)
            if telling > best:
                best, found = telling, window
    print(f"scene {scene}: window {found}, {best:.0%} of its pixels at least are on either side")
    return found


def main(renders: Path) -> None:
    DATA.mkdir(exist_ok=True)
    for scene in (0, 1, 2, 3, 4, 9):
        modes = ("none_aa1", "none_aa4", "luma_aa4", "sobel_aa4")
        plain, full, luma, sobel = (read_exr(renders / f"s{scene}_{mode}.exr").image for mode in modes)
        masks = {"luma": refined(plain, full, luma), "sobel": refined(plain, full, sobel)}
        window = window_of(scene, plain, masks)
        x, y, width, height = window
        parts = {name: mask[y : y + height, x : x + width] for name, mask in masks.items()}
        write(f"s{scene}_none_aa1", renders, window, 1, MOST, **parts)
        if scene < 9:
            write(f"s{scene}_none_aa4", renders, WHOLE, 2, HALF)
        for name in WINDOWS:
            if name.startswith(f"s{scene}"):
                write(name, renders, window, 1, HALF)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
