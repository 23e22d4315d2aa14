"""The options of the ``mrt`` command: of ``RenderSettings`` and its own, one table for parsing and help."""

from __future__ import annotations

import difflib
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.command.registry import split
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.files.images import TONEMAP
from mrt_mitsuba.options import SWITCH, Kind, check, choice, either, is_obj, is_path, option, table
from mrt_mitsuba.rendering import settings
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.scene.report import NUMBERS

# What ``log`` shows, from the fewest records to the most, as Python, Mitsuba and Dr.Jit call them
LEVELS = {
    "error": (logging.ERROR, "Error", "Error"),
    "warn": (logging.WARNING, "Warn", "Warn"),
    "info": (logging.INFO, "Info", "Warn"),
    "debug": (logging.DEBUG, "Debug", "Info"),  # with every kernel that is launched
}
FORM = "mrt FILENAME [SCENE] [name=value ...]"


def _scene(value: Any) -> int | str:
    if value in NUMBERS or (value and "\0" not in value):
        return value
    raise ValueError("a path is not empty, and has no null character")


@dataclass(frozen=True, kw_only=True)
class Options(RenderSettings):
    """The arguments of a render and of its output. None: the scene or the machine decides."""

    filename: str
    scene: int | str = option(
        0,
        Kind("PATH", "the path of a file", _scene),
        "XML or OBJ file to render in place of a numbered scene",
        "none",
    )
    format: str = option("both", choice("png", "exr", "both"), "files to write")
    tonemap: str = option("report", TONEMAP, "values in the PNG: linear as in the report, or sRGB")
    plan: str = option("hide", choice("show", "hide"), "print what will run and what is left out, and why")
    quiet: bool = option(False, SWITCH, "print errors only", "0")
    log: str = option("warn", choice(*LEVELS), "what to print: warnings; times; every kernel")

    def render_arguments(self) -> dict[str, Any]:
        """The options that say how to render, without those about files and messages."""
        return {name: getattr(self, name) for name in (*settings.TABLE, "params")}

    def outputs(self) -> list[str]:
        """The paths of the pictures to write."""
        return [f"{self.filename}.{ending}" for ending in ("png", "exr") if self.format in (ending, "both")]

    def inputs(self) -> list[str]:
        """The paths of the files to render."""
        return [self.scene] if isinstance(self.scene, str) else []


TABLE = table(Options)


def parse(arguments: Sequence[str]) -> Options:
    """Turn ``FILENAME [SCENE] [name=value ...]`` into options; raise ``UsageError`` naming what is wrong."""
    values: dict[str, Any] = {"filename": _filename(arguments[0])}
    plain, given = split(arguments[1:])
    if len(plain) > 1:
        raise UsageError(f"unexpected argument {plain[-1]!r}: options are written name=value")
    for text in plain:
        if "scene" in given:
            raise UsageError(f"both SCENE {text} and scene={given['scene']}: give one of them")
        if text not in map(str, NUMBERS):
            numbers = either([*map(str, NUMBERS)])
            raise UsageError(
                f"SCENE {text}: must be {numbers} ('mrt scenes' lists them); a file is scene=PATH"
            )
        values["scene"] = int(text)
    params = {name: given.pop(name) for name in [*given] if name not in TABLE}
    for name, text in given.items():
        needed = TABLE[name].metadata["needs"]
        if needed and needed not in given:
            form = TABLE[needed].metadata["kind"].form
            raise UsageError(f"{name} is of use only with {needed}={form.lower()}")
        values[name] = check(name, TABLE[name].metadata["kind"], text, text=True)
    if params and not is_path(values.get("scene"), ".xml"):  # whose parameters are checked as it is read
        strange = min(params)
        close = difflib.get_close_matches(strange.lstrip("-").lower(), TABLE, n=1)
        hint = f" Did you mean {close[0]}?" if close else " 'mrt help' lists the options."
        raise UsageError(f"unknown option {strange!r}.{hint}")
    options = Options(**values, params=params or None)
    is_obj(options.scene, options.model())
    return options


def _filename(text: str) -> str:
    stem, ending = os.path.splitext(text)
    if "=" in text and text.partition("=")[0] in TABLE:
        raise UsageError(f"FILENAME is missing before {text}: {FORM}")
    if text.startswith("-"):
        raise UsageError(f"unknown option {text}: options are written name=value; 'mrt help' lists them")
    if ending.lower() in (".png", ".exr"):
        raise UsageError(f"FILENAME has no extension: write {stem} format={ending[1:].lower()}")
    if not os.path.basename(text).strip(".") or "\0" in text:
        raise UsageError(f"FILENAME {text!r} names no file")
    return text
