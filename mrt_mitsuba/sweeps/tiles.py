"""Pictures cut into tiles: what each worker renders, and how the tiles become one file.

A tile is a region of the picture in a file of its own, with the pixels that the whole picture has there. The
picture is written some rows at a time, so that no process ever holds it.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mrt_mitsuba.errors import OutputError, UsageError
from mrt_mitsuba.rays.region import Region
from mrt_mitsuba.sweeps.scenes import fingerprint
from mrt_mitsuba.sweeps.worker import MADE_WITH, House, Task

ROWS = 64  # copied at a time; a multiple of the 16 that are compressed together
# Memory for a tile, unless the caller says: what is kept of a pixel is 84 bytes at most
BYTES_PER_PIXEL = 128
LEAST_MEMORY = 2**27


@dataclass(frozen=True)
class Mosaic:
    """A picture and its tiles, row by row."""

    picture: Task
    width: int
    height: int
    rows: int
    columns: int

    @classmethod
    def of(cls, task: Task, tiles: tuple[int, int]) -> Mosaic:
        """Cut a picture into so many rows and columns of tiles; raise ``UsageError`` if it is too small."""
        width, height = _size(task)
        rows, columns = tiles
        if rows > height or columns > width:
            raise UsageError(f"tiles={tiles}: a picture of {width}x{height} pixels has fewer rows or columns")
        return cls(task, width, height, rows, columns)

    @property
    def regions(self) -> list[Region]:
        """The tiles' places, whose sizes differ by a pixel at most."""
        return [
            Region(left, top, right - left, bottom - top)
            for top, bottom in itertools.pairwise(_cuts(self.height, self.rows))
            for left, right in itertools.pairwise(_cuts(self.width, self.columns))
        ]

    @property
    def tiles(self) -> list[Task]:
        """Return the tasks: each tile goes into a file in a folder named after the picture."""
        task, tasks = self.picture, []
        for number, region in enumerate(self.regions):
            place = (region.x, region.y, region.width, region.height)
            memory = max(LEAST_MEMORY, BYTES_PER_PIXEL * region.width * region.height)
            arguments = {"memory": memory, **task.arguments, "region": place}
            name = f"{self.folder}/{number // self.columns},{number % self.columns}"
            made_with = fingerprint(task.made_with, place)
            tasks.append(replace(task, name=name, arguments=arguments, made_with=made_with))
        return tasks

    @property
    def folder(self) -> str:
        """The name of the tiles' folder."""
        return f"{self.picture.name}.tiles"


def _cuts(size: int, parts: int) -> list[int]:
    return [size * number // parts for number in range(parts + 1)]


def _size(task: Task) -> tuple[int, int]:
    """Return width and height of a picture; loads its scene where only that knows."""
    from mrt_mitsuba import runtime
    from mrt_mitsuba.scene.open import open_scene
    from mrt_mitsuba.sweeps.scenes import SceneFile

    width, height = task.arguments.get("width"), task.arguments.get("height")
    if width and height:
        return width, height
    runtime.use()
    scene = task.scene.load() if isinstance(task.scene, SceneFile) else task.scene
    source = open_scene(scene, size=(width, height))
    return source.width, source.height


def assemble_task(mosaic: Mosaic, found: Sequence[Mapping[str, Any] | None], house: House) -> dict[str, Any]:
    """Put the tiles of a picture together, given the facts of those just made; return the picture's."""
    from distributed import get_worker

    facts: dict[str, Any] = {"worker": get_worker().address}
    errors = [tile["error"] for tile in found if tile and "error" in tile]
    if errors:
        return facts | {"error": errors[0]}
    task = mosaic.picture
    try:
        assemble(mosaic)
    except (OSError, RuntimeError, OutputError) as error:
        return facts | {"error": f"cannot put {task.name} together: {error}"}
    for name in ("seconds", "rays"):
        # tiles that an earlier sweep made have none
        facts[name] = sum(tile[name] for tile in found if tile) if all(found) else None
    return facts | {"file": task.files[-1]}


def assemble(mosaic: Mosaic) -> None:
    """Write a picture from its tiles, and remove these."""
    import OpenEXR

    from mrt_mitsuba.output.files import compressing

    task = mosaic.picture
    paths = [os.path.join(task.folder, tile.files[-1]) for tile in mosaic.tiles]
    path = os.path.join(task.scratch, task.files[-1])
    header = _header(mosaic, OpenEXR.InputFile(paths[0]).header())
    with compressing():
        picture = OpenEXR.OutputFile(path, header)
        try:
            for rows, planes in _rows(mosaic, paths, list(header["channels"])):
                picture.writePixels(planes, rows)
        finally:
            picture.close()
    _check_complete(path, mosaic.height)
    os.replace(path, os.path.join(task.folder, task.files[-1]))
    shutil.rmtree(os.path.join(task.folder, mosaic.folder))


def _header(mosaic: Mosaic, tile: Mapping[str, Any]) -> dict[str, Any]:
    """Return the header that the picture would have in one piece, given that of a tile."""
    import OpenEXR

    from mrt_mitsuba.output.files import compression

    header: dict[str, Any] = OpenEXR.Header(mosaic.width, mosaic.height)
    kind = compression(mosaic.width * mosaic.height)
    header["compression"] = type(header["compression"])(int(kind))  # an older type of the library
    header |= {name: value for name, value in tile.items() if name not in header and name != "type"}
    options = json.loads(tile["mrt:options"])
    options.pop("region", None)
    header["channels"] = tile["channels"]
    header["mrt:options"] = json.dumps(options).encode()
    header[MADE_WITH] = mosaic.picture.made_with.encode()
    return header


def _rows(
    mosaic: Mosaic, paths: Sequence[str], channels: Sequence[str]
) -> Iterator[tuple[int, dict[str, bytes]]]:
    """Yield some rows of the picture at a time: their number, and the bytes of each channel."""
    import numpy as np
    import OpenEXR

    regions = mosaic.regions
    for first in range(0, len(regions), mosaic.columns):
        tiles = [OpenEXR.InputFile(path) for path in paths[first : first + mosaic.columns]]
        for top in range(0, regions[first].height, ROWS):
            bottom = min(top + ROWS, regions[first].height)
            planes = {}
            for channel in channels:
                parts = [
                    np.frombuffer(tile.channel(channel, scanLine1=top, scanLine2=bottom - 1), np.float32)
                    for tile in tiles
                ]
                planes[channel] = np.hstack([part.reshape(bottom - top, -1) for part in parts]).tobytes()
            yield bottom - top, planes


def _check_complete(path: str, height: int) -> None:
    """Read the last row and let the file reach the disk: the library does not report a full one."""
    import OpenEXR

    OpenEXR.InputFile(path).channel("R", scanLine1=height - 1, scanLine2=height - 1)
    with open(path, "rb") as file:
        os.fsync(file.fileno())
