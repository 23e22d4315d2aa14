"""Reader of MTL files, the material libraries of OBJ files, by the report's or the standard convention."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mrt_mitsuba.errors import SceneError, warn
from mrt_mitsuba.options import StrPath
from mrt_mitsuba.scene.files import MISSING, decode, find, has_alpha, read_text, warn_of
from mrt_mitsuba.scene.model import MAX_FLOAT, Material

# Field of ``Material`` that a statement sets, by convention
CONVENTIONS = {
    "report": {"Ka": "ior", "Ni": "alpha", "Ks": "specular", "Kd": "diffuse", "map_Kd": "texture"},
    "standard": {"Ni": "ior", "Ns": "alpha", "Ks": "specular", "Kd": "diffuse", "map_Kd": "texture"},
}

# The report's material of everything before the first usemtl
DEFAULT_MATERIAL = Material(
    ior=1.1022, alpha=0.0579, specular=(0.286, 0.235, 0.128), diffuse=(1.0, 0.766, 0.762)
)

_STANDARD = Material(ior=1.0, alpha=1.0, specular=(0.0, 0.0, 0.0), diffuse=(0.8, 0.8, 0.8))

_KNOWN = ("Kd", "Ks", "Ka", "Ni", "Ns", "map_Kd")
# Unused statements and options that do not change the picture, as exporters write them; numbers without
# trailing zeros
_WITHOUT_EFFECT = {"d 1", "Tr 0", "illum 0", "illum 1", "illum 2", "sharpness 60", "Ke 0 0 0", "Tf 1 1 1"}
_WITHOUT_EFFECT |= {"-blendu on", "-blendv on", "-clamp off", "-cc off", "-boost 0", "-bm 1", "-type sphere"}


def read_mtl(path: StrPath, *, convention: str = "report", folder: Path | None = None) -> dict[str, Material]:
    """Read the materials of an MTL file, by name.

    ``convention``:

    * ``report``: ``Kd`` diffuse, ``Ks`` specular, ``Ni`` roughness, first value of ``Ka`` index of refraction
      (0: no reflection). What a block leaves out is taken from ``DEFAULT_MATERIAL``.
    * ``standard``: ``Kd``, ``Ks``, ``Ni`` index of refraction, ``Ns`` the exponent of a Blinn–Phong lobe,
      which is nearest to a roughness of √(2 / (Ns + 2)) (Walter et al., "Microfacet Models for Refraction",
      2007, §5.2). Defaults of the format's description: Kd 0.8, Ks 0, Ni 1, Ns 0.

    ``map_Kd`` names a picture that replaces Kd, with its options ``-s``, ``-o`` and ``-mm``; it is looked for
    relative to ``folder`` (that of the OBJ file), then to the MTL file. One that is missing is named in a
    warning and Kd is used. Values may exceed 1, as in the report. Statements and options that would change
    the picture and are not used are named in a warning.

    Raises ``SceneError`` with file and line for what cannot be read.
    """
    path = Path(path)
    reader = _Reader(path, convention, [folder or path.parent, path.parent])
    for number, line in enumerate(io.BytesIO(read_text(path)), 1):
        if line != b"\n":
            reader.read(decode(line).strip(), f"{path}:{number}")
    reader.warn()
    default = DEFAULT_MATERIAL if convention == "report" else _STANDARD
    return {name: replace(default, **fields) for name, fields in reader.blocks.items()}


def find_material(materials: Iterable[str], text: str) -> str | None:
    """Return the name among ``materials`` that a ``usemtl`` statement means, or None.

    Names may hold a number sign (``Material #1``), and a comment may follow a name.
    """
    for name in (_without_comment(text), text.partition("#")[0].strip()):
        if name in materials:
            return name
    return None


def _without_comment(name: str) -> str:
    return re.sub(r"\s+#(\s.*)?$", "", name)


@dataclass
class _Reader:
    """State of reading a file."""

    path: Path
    convention: str
    folders: list[Path]  #: where pictures are looked for
    blocks: dict[str, dict[str, Any]] = field(default_factory=dict)  #: fields of ``Material``, by its name
    name: str = ""  #: of the block
    unused: dict[str, str] = field(default_factory=dict)  #: first use of each statement or option
    missing: list[str] = field(default_factory=list)  #: messages about textures

    def warn(self) -> None:
        """Warn of missing textures, and of unused statements that would change the picture."""
        warn_of({"textures": self.missing})
        if self.unused:
            first, *others = self.unused
            more = f", nor {', '.join(others[:9])}" if others else ""
            warn(f"{self.unused[first]} is not used{more}")

    def read(self, line: str, where: str) -> None:
        """Read one statement."""
        statement, text = [*line.split(maxsplit=1), "", ""][:2]
        if statement.startswith("#"):
            return
        if statement not in ("newmtl", "map_Kd"):
            text = text.partition("#")[0].strip()
        elif not text:
            problem = {"newmtl": "has no name; write newmtl NAME", "map_Kd": "names no file"}[statement]
            raise SceneError(f"{where}: {statement} {problem}")
        if statement == "newmtl":
            self.name = _without_comment(text)
            self.blocks[self.name] = {}
        elif statement in _KNOWN:
            if not self.name:
                raise SceneError(f"{where}: {statement} comes before any newmtl; write newmtl NAME before it")
            read = self._texture(text, where) if statement == "map_Kd" else _value(statement, text, where)
            if statement in CONVENTIONS[self.convention]:
                self.blocks[self.name][CONVENTIONS[self.convention][statement]] = read
        elif statement:
            self._unused(f"{statement} {text}", where)

    def _unused(self, text: str, where: str) -> None:
        if re.sub(r"\.0+\b", "", text) not in _WITHOUT_EFFECT:
            self.unused.setdefault(text.split()[0][:48], f"{where}: {text[:48].strip()}")

    def _texture(self, text: str, where: str) -> str | None:
        """Return the path of a picture, and store its options; None if it is missing."""
        for line in dict.fromkeys((text, _without_comment(text), text.partition("#")[0].strip())):
            words = line.split()
            # options of some words before the name, which may have blanks in it
            for first in range(min(len(words), 32) if line.startswith("-") else 1):
                name = " ".join(words[first:]) if first else line
                picture = find(name, self.folders)
                if picture is not None:
                    self._options(words[:first], where)
                    if has_alpha(picture):
                        self._unused(f"alpha of {name}", where)
                    return str(picture)
        text = f"{where}: the texture {text} {MISSING} {self.folders[0]}; Kd is used in its place"
        self.missing.append(text)
        return None

    def _options(self, words: list[str], where: str) -> None:
        """Store the options of a texture, or record that they are unused."""
        fields = {"-s": ("scale", 1.0), "-o": ("offset", 0.0), "-mm": ("texture_range", 1.0)}
        for option in re.findall(r"-[a-zA-Z]\w*(?: [^-]\S*| -[\d.]\S*)*", " ".join(words)):
            name, *values = option.split()
            if name in fields:
                target, second = fields[name]
                problem = f"{where}: {option[:80]!r} must have one to three finite numbers"
                numbers = _numbers(values, (1, 2, 3), -MAX_FLOAT, problem)
                self.blocks[self.name][target] = (*numbers, second)[:2]
            else:
                self._unused(option, where)


def _value(statement: str, text: str, where: str) -> Any:
    """Return the colour, index or roughness of a statement. Raises ``SceneError`` for anything else."""
    colour = statement[0] == "K"
    must = f"must be {'one or three numbers' if colour else 'one number'}, finite and not negative, but is"
    problem = f"{where}: {statement} {must} {text[:80]!r}"
    values = _numbers(text.split(), (1, 3) if colour else (1,), 0.0, problem)
    if statement == "Ns":
        return math.sqrt(2 / (values[0] + 2))
    if statement in ("Kd", "Ks"):
        return values[0], values[len(values) // 2], values[-1]
    return values[0]


def _numbers(words: Sequence[str], counts: Sequence[int], low: float, problem: str) -> list[float]:
    """Return finite numbers, each at least ``low``; raise ``SceneError`` with the ``problem`` for others."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(low <= number <= MAX_FLOAT for number in numbers):
        raise SceneError(problem)
    return numbers
