"""MTL files: what a material library of an OBJ file says, in the report's reading and in the standard one."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.scene.files import MISSING, Findings, decode, find, numbers, read_text
from mrt_mitsuba.scene.model import Color, Material

CONVENTIONS = ("report", "standard")

# The report's material of everything before the first usemtl
DEFAULT_MATERIAL = Material(
    ior=1.1022, alpha=0.0579, specular=(0.286, 0.235, 0.128), diffuse=(1.0, 0.766, 0.762)
)

# What exporters write of statements that are not used, where it changes nothing
_OPAQUE, _NOTHING = ("1", "1.0", "1.000000"), ("0", "0.0", "0.000000")
_WITHOUT_EFFECT = {"d": _OPAQUE, "Tr": _NOTHING, "illum": ("0", "1", "2"), "sharpness": ("60",)}
_WITHOUT_EFFECT |= {
    name: tuple(" ".join([value] * 3) for value in values)
    for name, values in (("Ke", _NOTHING), ("Tf", _OPAQUE))
}

# Options of a map_Kd statement, with the number of values that follow each
_MAP_OPTIONS = {
    "-blendu": (1, 1),
    "-blendv": (1, 1),
    "-cc": (1, 1),
    "-clamp": (1, 1),
    "-boost": (1, 1),
    "-imfchan": (1, 1),
    "-texres": (1, 1),
    "-bm": (1, 1),
    "-mm": (2, 2),
    "-o": (1, 3),
    "-s": (1, 3),
    "-t": (1, 3),
}


@dataclass
class _Entry:
    """The statements of one newmtl block; None for those it does not have."""

    line: int
    kd: Color | None = None
    ks: Color | None = None
    ka: Color | None = None
    ni: float | None = None
    ns: float | None = None
    map_kd: tuple[int, str] | None = None  # line, rest of the statement
    unknown: set[str] = field(default_factory=set)


def read_mtl(
    path: str | os.PathLike[str], *, convention: str = "report", folder: Path | None = None
) -> dict[str, Material]:
    """Return the materials of an MTL file by name.

    ``convention``:

    * ``report``: ``Kd`` diffuse, ``Ks`` specular, ``Ni`` roughness, first value of ``Ka`` index of refraction
      (0: no reflection). What a block leaves out is taken from ``DEFAULT_MATERIAL``.
    * ``standard``: ``Kd``, ``Ks``, ``Ni`` index of refraction, ``Ns`` the exponent of a Blinn–Phong lobe,
      which is nearest to a roughness of √(2 / (Ns + 2)) (Walter et al., "Microfacet Models for Refraction",
      2007, §5.2). Defaults of the format's description: Kd 0.8, Ks 0, Ni 1, Ns 0.

    ``map_Kd`` names a picture that replaces Kd; it is looked for relative to ``folder`` (that of the OBJ
    file), then to the MTL file. One that is missing is named in a warning and Kd is used. Values may exceed
    1, as in the report. ``standard`` warns of statements that would change the picture and are not used.

    Raises ``SceneError`` with file and line for what cannot be read.
    """
    path = Path(path)
    findings = Findings()
    # the report's reading defines itself; from the standard's, statements may be missing
    unused = findings if convention == "standard" else None
    entries = _parse(path, decode(read_text(path)).split("\n"), unused)
    make = {"report": _report_material, "standard": _standard_material}[convention]
    materials = {}
    for name, entry in entries.items():
        material = make(entry)
        if entry.map_kd is not None:
            line, rest = entry.map_kd
            material = replace(material, texture=_texture(path, line, rest, folder, findings))
        materials[name] = material
    findings.warn()
    return materials


def _parse(path: Path, lines: list[str], findings: Findings | None) -> dict[str, _Entry]:
    entries: dict[str, _Entry] = {}
    current: _Entry | None = None
    for number, line in enumerate(lines, 1):
        statement, _, rest = line.split("#", 1)[0].strip().partition(" ")
        statement, _, tabbed = statement.partition("\t")
        rest = f"{tabbed} {rest}".strip()
        where = f"{path}:{number}"
        if statement == "newmtl":
            if not rest:
                raise SceneError(f"{where}: newmtl has no name; write newmtl NAME")
            current = entries[rest] = _Entry(number)
        elif statement in _STATEMENTS:
            if current is None:
                raise SceneError(f"{where}: {statement} comes before any newmtl; write newmtl NAME before it")
            _STATEMENTS[statement](current, where, number, rest)
        elif findings is not None and rest not in _WITHOUT_EFFECT.get(statement, ()) and statement:
            findings.add("statements", f"{where}: {statement} {rest[:40]} is not used")
    return entries


def _color(name: str) -> Callable[[_Entry, str, int, str], None]:
    def read(entry: _Entry, where: str, line: int, rest: str) -> None:
        words = rest.split()
        if words and words[0] in ("spectral", "xyz"):
            raise SceneError(f"{where}: {name} {words[0]} is not supported; give red, green and blue")
        values = numbers(where, name, words, 1, 3)
        if min(values) < 0:
            raise SceneError(f"{where}: {name} is {rest}, but a colour must not be negative")
        if len(values) == 2:
            raise SceneError(f"{where}: {name} has 2 numbers, but must have 1 or 3")
        setattr(entry, name.lower(), tuple(values * (3 if len(values) == 1 else 1)))

    return read


def _number(name: str) -> Callable[[_Entry, str, int, str], None]:
    def read(entry: _Entry, where: str, line: int, rest: str) -> None:
        (value,) = numbers(where, name, rest.split(), 1, 1)
        if value < 0:
            raise SceneError(f"{where}: {name} is {rest}, but must not be negative")
        setattr(entry, name.lower(), value)

    return read


def _map(entry: _Entry, where: str, line: int, rest: str) -> None:
    if not rest:
        raise SceneError(f"{where}: map_Kd names no file")
    entry.map_kd = line, rest


_STATEMENTS: dict[str, Callable[[_Entry, str, int, str], None]] = {
    "Kd": _color("Kd"),
    "Ks": _color("Ks"),
    "Ka": _color("Ka"),
    "Ni": _number("Ni"),
    "Ns": _number("Ns"),
    "map_Kd": _map,
}


def _report_material(entry: _Entry) -> Material:
    default = DEFAULT_MATERIAL
    return Material(
        ior=default.ior if entry.ka is None else entry.ka[0],
        alpha=default.alpha if entry.ni is None else entry.ni,
        specular=default.specular if entry.ks is None else entry.ks,
        diffuse=default.diffuse if entry.kd is None else entry.kd,
    )


def _standard_material(entry: _Entry) -> Material:
    return Material(
        ior=1.0 if entry.ni is None else entry.ni,
        alpha=math.sqrt(2 / ((entry.ns or 0.0) + 2)),
        specular=entry.ks or (0.0, 0.0, 0.0),
        diffuse=entry.kd or (0.8, 0.8, 0.8),
    )


def _texture(path: Path, line: int, rest: str, folder: Path | None, findings: Findings) -> str | None:
    """Return the picture that a map_Kd statement names, or None, with a warning, where there is none."""
    folders = [path.parent] if folder is None else [folder, path.parent]
    name = rest
    found = find(name, folders)
    if found is None:
        name = _without_options(rest)
        found = find(name, folders) if name else None
    if found is None:
        text = f"{path}:{line}: the texture {name or rest} {MISSING} {folders[0]}; Kd is used in its place"
        findings.add("textures", text)
        return None
    return str(found)


def _without_options(rest: str) -> str:
    """Return the file name of a map statement, which follows its options."""
    words = rest.split()
    while words and words[0] in _MAP_OPTIONS:
        least, most = _MAP_OPTIONS[words.pop(0)]
        for taken in range(most):
            if taken >= least and not _is_number(words[0] if words else ""):
                break
            words = words[1:]
    return " ".join(words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
