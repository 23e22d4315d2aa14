"""Bounds the size of an XML file with its parameters and includes, before Mitsuba's parser expands it."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field

import mitsuba as mi

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.mitsuba_changes import mitsuba_first
from mrt_mitsuba.scene.files import require_file

MAX_INCLUDES = 1000
MAX_INCLUDE_DEPTH = 15  # of files that include each other; Mitsuba refuses more
MAX_SUBSTITUTED = 2**24  # maximum characters of the expanded parameters of a file and its includes


@dataclass
class Expansion:
    """Bounds the expansion of a file's parameters and includes: parameters that name each other, and files
    that include others many times, multiply."""

    values: dict[str, str]  #: by name; ``read`` adds the defaults
    known: set[str] = field(default_factory=set)  #: names that a file uses or declares
    length: int = 0  #: characters that were substituted
    includes: int = 0

    def read(self, path: str, depth: int = 0) -> None:
        """Read a file and, in order, those that it includes. Raises ``RuntimeError`` for too much."""
        require_file(path)
        for tag, raw in elements(path):
            attributes = {key: self._substituted(text) if "$" in text else text for key, text in raw.items()}
            name, value, filename = (attributes.get(key, "") for key in ("name", "value", "filename"))
            if tag == "default":
                self.known.add(name)
                self.values.setdefault(name, value)
            elif tag == "path":
                mitsuba_first(str(mi.file_resolver().resolve(value)))
            file = str(mi.file_resolver().resolve(filename)) if tag == "include" else ""
            if os.path.exists(file) and depth < MAX_INCLUDE_DEPTH:
                self.includes += 1
                if self.includes > MAX_INCLUDES:
                    raise RuntimeError(f"it includes more than {MAX_INCLUDES} files")
                outside = mi.file_resolver()
                mitsuba_first(os.path.dirname(file))  # what an included file includes is relative to it
                self.read(file, depth + 1)
                mi.set_file_resolver(outside)

    def _substituted(self, text: str) -> str:
        self.known.update(re.findall(r"\$(\w+)", text))
        for name in sorted(filter(None, self.values), key=len, reverse=True):  # the longest first, as Mitsuba
            self.length += text.count(f"${name}") * len(self.values[name])
            if self.length > MAX_SUBSTITUTED:
                raise RuntimeError(f"its parameters expand to more than {MAX_SUBSTITUTED} characters")
            text = text.replace(f"${name}", self.values[name])
        return text


def elements(file: str) -> list[tuple[str, dict[str, str]]]:
    """Return tag and attributes of each element of an XML file, in order."""
    from xml.parsers import expat

    def entity(name: str, *declaration: object) -> None:  # which Mitsuba's parser reads in another way
        raise SceneError(f"cannot load {file}: it declares the entity {name}; write the text in its place")

    read: list[tuple[str, dict[str, str]]] = []
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler = lambda *element: read.append(element)
    parser.EntityDeclHandler = entity
    try:
        with open(file, "rb") as stream:
            parser.ParseFile(stream)
    except expat.ExpatError as error:
        raise SceneError(f"cannot load {file}: it must be XML in UTF-8, but has {error}") from None
    return read
