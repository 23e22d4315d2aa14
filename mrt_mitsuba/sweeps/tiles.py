"""Pictures cut into tiles: what each worker renders, and how the tiles become one file.

A tile is a region of the picture in a file of its own, with the pixels that the whole picture has there. The
picture is written some rows at a time, so that no process ever holds it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.sweeps.jobs import Job
from mrt_mitsuba.sweeps.scenes import fingerprint, receive
from mrt_mitsuba.sweeps.worker import MADE_WITH, Setting, made_with, strips

# Memory for a tile, unless the caller says: what is kept of a pixel is 84 bytes at most
BYTES_PER_PIXEL = 128
LEAST_MEMORY = 2**27


def check_tiles(tiles: Any, png: bool, jobs: Sequence[Job]) -> None:
    """Raise ``UsageError`` for numbers of rows and columns, or for jobs, that cannot be cut into tiles."""
    pair = isinstance(tiles, list | tuple) and [type(number) for number in tiles] == [int, int]
    if not (pair and min(tiles) > 0):
        raise UsageError(f"tiles={tiles!r}: give rows and columns, such as (4, 4)")
    if png:
        raise UsageError("tiles: pictures in tiles are written as EXR only; leave out png")
    if any(job.arguments.get("target") or job.arguments.get("aamode") == "noise" for job in jobs):
        raise UsageError("tiles: target and aamode=noise share the rays out over the whole picture")


def cut(job: Job, tiles: tuple[int, int]) -> list[Job]:
    """Return the jobs of a picture's tiles, row by row, each with a file in a folder named after the picture.

    Raises ``UsageError`` if the picture has too few pixels.
    """
    width, height = job.arguments.get("width"), job.arguments.get("height")
    if not (width and height):  # only the scene knows
        from mrt_mitsuba import runtime
        from mrt_mitsuba.scene.open import open_scene

        runtime.use()
        source = open_scene(receive(job.scene), size=(width, height))
        width, height = source.width, source.height
    rows, columns = tiles
    if rows > height or columns > width:
        raise UsageError(f"tiles={tiles}: a picture of {width}x{height} pixels has fewer rows or columns")
    found = []
    for row, (top, bottom) in enumerate(_spans(height, rows)):
        for column, (left, right) in enumerate(_spans(width, columns)):
            region = (left, top, right - left, bottom - top)
            memory = max(LEAST_MEMORY, BYTES_PER_PIXEL * region[2] * region[3])
            arguments = {"memory": memory, **job.arguments, "region": region}
            name, made = f"{job.name}.tiles/{row},{column}", fingerprint(job.made_with, region)
            found.append(replace(job, name=name, arguments=arguments, made_with=made))
    return found


def _spans(size: int, parts: int) -> Sequence[tuple[int, int]]:
    """Return start and end of each part, whose sizes differ by one at most."""
    return list(itertools.pairwise(size * number // parts for number in range(parts + 1)))


def assemble(
    job: Job, tiles: Sequence[Job], found: Sequence[Mapping[str, Any] | None], setting: Setting
) -> dict[str, Any]:
    """Write a picture from its tiles, and remove these; return its facts, given those of new tiles."""
    from distributed import get_worker

    facts: dict[str, Any] = {"worker": get_worker().address}
    for tile in found:
        if tile and "error" in tile:
            return facts | {"error": tile["error"]}
    paths = [os.path.join(setting.folder, tile.file) for tile in tiles]
    scratch = os.path.join(setting.scratch, job.file)
    try:
        _join(job, tiles, paths, scratch)
        os.replace(scratch, os.path.join(setting.folder, job.file))
        own = os.path.dirname(paths[0])
        for path in (os.path.join(own, name) for name in os.listdir(own)):
            if made_with(path):  # also those of another number of tiles
                os.unlink(path)
        with contextlib.suppress(OSError):  # something of the user's own is in there
            os.rmdir(own)
    except (OSError, RuntimeError) as error:
        return facts | {"error": f"cannot put {job.name} together: {error}"}
    for name in ("seconds", "rays"):  # unknown of tiles that an earlier sweep made
        facts[name] = sum(tile[name] for tile in found if tile) if all(found) else None
    return facts | {"file": job.file}


def _join(job: Job, tiles: Sequence[Job], paths: Sequence[str], path: str) -> None:
    import numpy as np
    import OpenEXR

    from mrt_mitsuba.output.files import compressing, compression

    files = [OpenEXR.InputFile(each) for each in paths]
    own = files[0].header()
    left, top, wide, high = tiles[-1].arguments["region"]
    header: dict[str, Any] = OpenEXR.Header(left + wide, top + high)
    kind = compression((left + wide) * (top + high))
    header["compression"] = type(header["compression"])(int(kind))  # an older type of the library
    header |= {name: value for name, value in own.items() if name not in header and name != "type"}
    options = {name: value for name, value in json.loads(own["mrt:options"]).items() if name != "region"}
    header["channels"] = own["channels"]
    header["mrt:options"] = json.dumps(options).encode()
    header[MADE_WITH] = job.made_with.encode()
    channels = list(own["channels"])
    columns = [tile.arguments["region"][1] for tile in tiles].count(0)  # those in the first row
    with compressing():
        picture = OpenEXR.OutputFile(path, header)
        try:
            for first in range(0, len(files), columns):
                row = [strips(file, channels) for file in files[first : first + columns]]
                for parts in zip(*row, strict=True):
                    planes, rows = {}, 0
                    for name in channels:
                        blocks = [np.frombuffer(part[name], np.float32) for part in parts]
                        rows = len(blocks[0]) // tiles[first].arguments["region"][2]
                        planes[name] = np.hstack([block.reshape(rows, -1) for block in blocks]).tobytes()
                    picture.writePixels(planes, rows)
        finally:
            picture.close()
    # The library does not report a full disk: read the last row, and let the file reach the disk
    OpenEXR.InputFile(path).channel("R", scanLine1=top + high - 1, scanLine2=top + high - 1)
    with open(path, "rb") as file:
        os.fsync(file.fileno())
