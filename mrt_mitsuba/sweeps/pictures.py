"""The pictures of a sweep: which of those in its folder are its own, whole and up to date."""

from __future__ import annotations

import os
import warnings

import OpenEXR
from PIL import Image

from mrt_mitsuba.errors import OutputError
from mrt_mitsuba.files.images import silenced
from mrt_mitsuba.sweeps.jobs import Job

MADE_WITH = "mrt:sweep"  # in the header of each picture: its job's ``made_with``


def fingerprint_in(path: str) -> str | None:
    """Return the ``made_with`` in a picture that a sweep made: "" in any other, None in a damaged file."""
    if not os.path.isfile(path):  # a pipe has no end to wait for
        return None
    try:
        if path.endswith(".png"):
            with warnings.catch_warnings(), Image.open(path) as picture:
                picture.load()  # raises unless all checksums are right
                return str(picture.info.get(MADE_WITH, ""))
        with silenced():
            return str(OpenEXR.File(path).header().get(MADE_WITH, ""))
    except Exception:  # whatever libraries raise for damaged files
        return None


def is_fresh(job: Job, folder: str, recorded: bool, png: bool) -> bool:
    """True if a job's files are whole and were made by the same scene, settings and versions.

    ``recorded``: the folder's table has the picture. Raises ``OutputError`` for a file of the user's own
    under their names: a picture that no sweep made, or something unreadable that the table does not have.
    """
    fresh = True
    for file in (job.file, f"{job.name}.png") if png else (job.file,):
        path = os.path.join(folder, file)
        found = fingerprint_in(path)
        if os.path.lexists(path) and (found == "" or not (found or (recorded and os.path.isfile(path)))):
            raise OutputError(
                f"{path} was not made by a sweep, which would replace it: move it away, or choose another "
                "folder"
            )
        fresh = fresh and found == job.made_with
    return fresh
