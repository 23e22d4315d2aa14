"""The options of the ``mrt`` command: of ``RenderSettings`` and its own, one table for parsing and help."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from mrt_mitsuba.command.parser import Parser
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.files.images import COMPRESSION, TONEMAP
from mrt_mitsuba.options import SWITCH, Kind, check, choice, either, is_obj, is_path, option, table
from mrt_mitsuba.rendering import settings
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.scene.model import MODEL_OPTIONS
from mrt_mitsuba.scene.report import NUMBERS

FORM = "mrt FILENAME [SCENE] [name=value ...]"
ABOUT = "Renders a scene and writes FILENAME.png and FILENAME.exr; FILENAME has no extension."
SCENES = [str(number) for number in NUMBERS]
ONLY_OBJ = {*MODEL_OPTIONS} - {"target"}  # options for OBJ files


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
        "XML or OBJ file in place of a numbered scene; other names set $parameters of XML",
        "none",
    )
    plugins: tuple[str, ...] = option(
        (), Kind("FILE.py|MODULE", "files or modules", tuple), "your own plugins; may be repeated", "none"
    )
    format: str = option("both", choice("png", "exr", "both"), "files to write")
    tonemap: str = option("report", TONEMAP, "values in the PNG: linear as in the report, or sRGB")
    compression: str = option("zip", COMPRESSION, "compression of the EXR, without loss")
    plan: str = option("hide", choice("show", "hide"), "print what will run and what is left out, and why")
    quiet: bool = option(False, SWITCH, "print errors only", "0")

    def render_arguments(self) -> dict[str, Any]:
        """Return the options that say how to render, without those about files and messages."""
        return {name: getattr(self, name) for name in (*settings.TABLE, "params")}

    def outputs(self) -> list[str]:
        """Return the paths of the pictures to write."""
        return [f"{self.filename}.{ending}" for ending in ("png", "exr") if self.format in (ending, "both")]

    def inputs(self) -> list[str]:
        """Return the paths of the files to render."""
        return [self.scene] if isinstance(self.scene, str) else []


TABLE = table(Options)


def add_options(parser: Parser, names: Iterable[str]) -> None:
    """Add options of the table to a parser."""
    for name in names:
        about = TABLE[name].metadata
        text = f"{about['help']} (default: {about['shown'] or TABLE[name].default})"
        parser.option(name, about["kind"].form, text, repeatable=name == "plugins")


def render_parser() -> Parser:
    """Return the parser of the words after FILENAME."""
    parser = Parser(prog="mrt", usage=f"{FORM}\n       mrt COMMAND ...", description=ABOUT)
    add_scene(parser)
    add_options(parser, (name for name in TABLE if name not in parser.forms))
    return parser


def add_scene(parser: Parser) -> None:
    """Add SCENE, scene=PATH and plugins=FILE.py."""
    text = f"number of a scene, {SCENES[0]} to {SCENES[-1]}, or an XML or OBJ file"
    parser.add_argument("number", metavar="SCENE", nargs="?", help=text)
    add_options(parser, ("scene", "plugins"))


def read_scene(parser: Parser, words: Sequence[str]) -> dict[str, Any]:
    """Return the values of options, as text but for "scene", with "params" for an XML file.

    Raises ``UsageError`` for words that the parser does not know, but for names in an XML scene.
    """
    values, params = parser.read(words)
    scene = values.get("scene")
    if number := values.pop("number", None):
        if scene is not None:
            parser.error(f"both SCENE {number} and scene={scene}: give one of them")
        if number not in SCENES and not is_path(number, (".xml", ".obj")):
            raise UsageError(
                f"SCENE {number}: must be {either(SCENES)} ('mrt scenes' lists them); a file is scene=PATH"
            )
        scene = number
    if scene is not None:
        values["scene"] = int(scene) if scene in SCENES else scene
    if is_path(scene, ".xml"):  # names that it does not use are refused when it is read
        params |= {name: values.pop(name) for name in ONLY_OBJ & values.keys()}
    elif params:
        parser.unknown(min(params))
    return values | ({"params": params} if params else {})


def parse(arguments: Sequence[str]) -> Options:
    """Turn ``FILENAME [SCENE] [name=value ...]`` into options; raise ``UsageError`` naming what is wrong."""
    return checked(_filename(arguments[0]), read_scene(render_parser(), arguments[1:]))


def checked(filename: str, given: dict[str, Any]) -> Options:
    """Return options of the values that ``read_scene`` gives; raise ``UsageError`` for a wrong one."""
    values: dict[str, Any] = {"params": given.pop("params", None)}
    for name, text in given.items():
        values[name] = check(name, TABLE[name].metadata["kind"], text, text=isinstance(text, str))
    options = Options(filename=filename, **values)
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
