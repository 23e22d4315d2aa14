"""The contact sheet: all pictures of a sweep, small, in one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

LABEL = 14  # pixels below a picture, for its name
GAP = 4  # pixels between pictures
MOST = 1000  # pictures; more would be too small to see


def write_sheet(path: str, names: Sequence[str], pictures: Sequence[Any]) -> None:
    """Write small pictures, [h, w, 3] in 8 bit or None where one is missing, with their names as PNG."""
    from PIL import Image, ImageDraw

    from mrt_mitsuba.output.replacing import replacing

    if all(picture is None for picture in pictures):
        return
    width = max(picture.shape[1] for picture in pictures if picture is not None) + GAP
    height = max(picture.shape[0] for picture in pictures if picture is not None) + GAP + LABEL
    columns = math.ceil(math.sqrt(len(pictures) * height / width))
    sheet = Image.new("RGB", (columns * width + GAP, math.ceil(len(pictures) / columns) * height + GAP))
    draw = ImageDraw.Draw(sheet)
    for number, (name, picture) in enumerate(zip(names, pictures, strict=True)):
        x, y = GAP + number % columns * width, GAP + number // columns * height
        if picture is not None:
            sheet.paste(Image.fromarray(picture), (x, y))
        letters = next(n for n in range(len(name), -1, -1) if draw.textlength(name[:n]) <= width - GAP)
        draw.text((x, y + height - LABEL - GAP), name[:letters], fill="white")
    with replacing(path) as file:
        sheet.save(file, format="PNG", compress_level=1)  # half the time
