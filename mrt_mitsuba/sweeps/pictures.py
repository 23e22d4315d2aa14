"""The pictures of a sweep: which are its own and whole, and how those cut into tiles become one file.

A tile is a region of the picture in a file of its own, with the pixels that the whole picture has there. The
picture is written some rows at a time, so that no process ever holds it.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

from mrt_mitsuba.errors import MrtError, OutputError, UsageError
from mrt_mitsuba.files.images import exr_threads, silenced
from mrt_mitsuba.files.replacing import replacing
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.scene.open import open_scene
from mrt_mitsuba.sweeps.folder import Facts
from mrt_mitsuba.sweeps.jobs import Job, receive

MADE_WITH = "mrt:sweep"  # in the header of each picture: its job's ``made_with``
ROWS = 64  # of a picture, read at a time; a multiple of the 16 that are compressed together
# Memory for a tile, unless the caller says: what is kept of a pixel is 84 bytes at most
BYTES_PER_PIXEL = 128
LEAST_MEMORY = 2**27


def checksum(path: str) -> str:
    """The SHA-256 of a file, as ``sha256sum`` prints it, and its bytes: "HASH/BYTES"."""
    total = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(2**20):
            total.update(block)
    return f"{total.hexdigest()}/{os.path.getsize(path)}"


def mark(path: str) -> str | None:
    """The fingerprint in a picture that a sweep made: "" in any other, None in what is no picture."""
    if not os.path.isfile(path):  # a pipe has no end to wait for
        return None
    try:
        if path.endswith(".png"):
            with warnings.catch_warnings(), Image.open(path) as picture:
                return str(picture.info.get(MADE_WITH, ""))
        with silenced():
            return str(OpenEXR.File(path, header_only=True).header().get(MADE_WITH, ""))
    except Exception:  # whatever libraries raise for damaged files
        return None


def is_fresh(job: Job, folder: str, noted: Facts | None, png: bool = False) -> bool:
    """Whether a job's files are as they were written, by the same scene, settings and versions.

    ``noted``: its row of the table, or the note of a tile; None without one. "checksum" is that of each file.
    Raises ``OutputError`` for a file of the user's own under their names: one without a sweep's mark, unless
    it is what damage left of the noted one.
    """
    sums = str((noted or {}).get("checksum") or "").split()
    checksums = dict(zip(job.files(png=True), sums, strict=False))  # of the EXR and the PNG, if any
    fresh = True
    for file in job.files(png):
        known = checksums.get(file, "")
        path = os.path.join(folder, file)
        marked = mark(path)
        # A file without a mark is what damage left of the noted one if it is no picture at all, or as long
        damaged = os.path.isfile(path) and (marked is None or known.endswith(f"/{os.path.getsize(path)}"))
        if os.path.lexists(path) and not marked and (noted is None or not damaged):
            text = "was not made by a sweep, which would replace it: move it away, or choose another folder"
            raise OutputError(f"{path} {text}")
        fresh = fresh and marked == job.made_with and checksum(path) == known
    return fresh


def cut(job: Job, tiles: Any) -> list[Job]:
    """The jobs of a picture's tiles, row by row, each with a file in a folder named after the picture.

    ``tiles``: the numbers of rows and of columns. Raises ``UsageError`` if the picture cannot be cut so.
    """
    if not (isinstance(tiles, list | tuple) and [*map(type, tiles)] == [int, int] and min(tiles) > 0):
        raise UsageError(f"tiles={tiles!r}: give rows and columns, such as (4, 4)")
    if RenderSettings.of(**job.arguments).goal() is not None:
        raise UsageError("tiles: target and aamode=noise share the rays out over the whole picture")
    size: Any = job.arguments.get("width"), job.arguments.get("height")
    if None in size:  # only the scene knows
        source = open_scene(receive(job.scene), width=size[0], height=size[1])
        size = source.width, source.height
    width, height = size
    rows, columns = tiles
    if rows > height or columns > width:
        raise UsageError(f"tiles={tiles}: a picture of {width}x{height} pixels has fewer rows or columns")
    tiles_of_it = []
    for row, column in itertools.product(range(rows), range(columns)):
        left = width * column // columns
        top = height * row // rows
        wide = width * (column + 1) // columns - left
        high = height * (row + 1) // rows - top
        memory = max(LEAST_MEMORY, BYTES_PER_PIXEL * wide * high)
        arguments = {"memory": memory, **job.arguments, "region": (left, top, wide, high)}
        tiles_of_it.append(job._replace(name=f"{job.name}.tiles/{row},{column}", arguments=arguments))
    return tiles_of_it


def join(job: Job, parts: Sequence[Job], outcomes: Sequence[Facts], folder: str) -> Facts:
    """The facts of a picture, given those of its parts; tiles are put together and removed."""
    if parts == [job]:
        return dict(outcomes[0])
    attempts = max(facts.get("attempts", 1) for facts in outcomes)
    for facts in outcomes:
        if "error" in facts:
            return {"error": facts["error"], "attempts": attempts}
    try:
        _write_rows(job, parts, folder)
        whole = checksum(os.path.join(folder, job.file))
        for part in parts:
            for file in (part.file, part.note):
                os.unlink(os.path.join(folder, file))
        with contextlib.suppress(OSError):  # something else is in there
            os.rmdir(os.path.join(folder, f"{job.name}.tiles"))
    except (MrtError, OSError, RuntimeError) as error:
        return {"error": f"cannot put {job.name} together: {error}", "attempts": attempts}
    known = ("seconds", "rays") if all(outcomes) else ()
    sums = {name: sum(facts[name] for facts in outcomes) for name in known}
    return {"file": job.file, "attempts": attempts, "checksum": whole, **sums}


def _write_rows(job: Job, tiles: Sequence[Job], folder: str) -> None:
    files = [OpenEXR.InputFile(os.path.join(folder, tile.file)) for tile in tiles]
    regions = [tile.arguments["region"] for tile in tiles]
    own = files[0].header()
    left, top, wide, high = regions[-1]
    names = list(own["channels"])
    header: dict[str, Any] = OpenEXR.Header(left + wide, top + high)
    header |= {name: value for name, value in own.items() if name not in header and name != "type"}
    options = {name: value for name, value in json.loads(own["mrt:options"]).items() if name != "region"}
    header |= {"channels": own["channels"], "mrt:options": json.dumps(options).encode()}
    header[MADE_WITH] = job.made_with.encode()
    columns = [region[1] for region in regions].count(0)  # those in the first row
    with replacing(os.path.join(folder, job.file)) as (file,):
        with contextlib.ExitStack() as stack:
            kind = OpenEXR.ZIP_COMPRESSION
            stack.enter_context(exr_threads())
            header["compression"] = type(header["compression"])(int(kind))  # an older type of the library
            picture = stack.enter_context(contextlib.closing(OpenEXR.OutputFile(file.name, header)))
            for first in range(0, len(files), columns):
                for row in range(0, regions[first][3], ROWS):
                    rows = min(ROWS, regions[first][3] - row)
                    strips = [
                        b"".join(tile.channels(names, scanLine1=row, scanLine2=row + rows - 1))
                        for tile in files[first : first + columns]
                    ]
                    blocks = [
                        np.frombuffer(strip, np.float32).reshape(len(names), rows, -1) for strip in strips
                    ]
                    planes = map(bytes, np.concatenate(blocks, axis=2))
                    picture.writePixels(dict(zip(names, planes, strict=True)), rows)
        # The library does not report a full disk, but a row that is missing
        written = OpenEXR.InputFile(file.name)
        last = written.header()["dataWindow"].max.y
        written.channel("R", scanLine1=last, scanLine2=last)
