"""MTL files: what a material library of an OBJ file says, in the report's reading and in the standard one."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from mrt_mitsuba.errors import SceneError
from mrt_mitsuba.options import StrPath
from mrt_mitsuba.scene.files import MISSING, decode, find, read_text, warn_of
from mrt_mitsuba.scene.model import LARGEST, Color, Material

# What the statements mean, by convention: fields of ``Material``
CONVENTIONS = {
    "report": {"Ka": "ior", "Ni": "alpha", "Ks": "specular", "Kd": "diffuse", "map_Kd": "texture"},
    "standard": {"Ni": "ior", "Ns": "alpha", "Ks": "specular", "Kd": "diffuse", "map_Kd": "texture"},
}

# The report's material of everything before the first usemtl
DEFAULT_MATERIAL = Material(
    ior=1.1022, alpha=0.0579, specular=(0.286, 0.235, 0.128), diffuse=(1.0, 0.766, 0.762)
)

_STANDARD = Material(ior=1.0, alpha=1.0, specular=(0.0, 0.0, 0.0), diffuse=(0.8, 0.8, 0.8))

# What exporters write of statements that are not used, where it changes nothing; numbers without their zeros
_WITHOUT_EFFECT = {"d 1", "Tr 0", "illum 0", "illum 1", "illum 2", "sharpness 60", "Ke 0 0 0", "Tf 1 1 1"}


def read_mtl(path: StrPath, *, convention: str = "report", folder: Path | None = None) -> dict[str, Material]:
    """The materials of an MTL file by name.

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
    fields = CONVENTIONS[convention]
    findings: dict[str, list[str]] = {}
    blocks: dict[str, dict[str, Any]] = {}
    block: dict[str, Any] | None = None
    for number, line in enumerate(decode(read_text(path)).split("\n"), 1):
        words = line.partition("#")[0].strip().split(maxsplit=1)
        statement, text = [*words, "", ""][:2]
        where = f"{path}:{number}"
        if statement == "newmtl":
            if not text:
                raise SceneError(f"{where}: newmtl has no name; write newmtl NAME")
            block = blocks[text] = {}
        elif statement in ("Kd", "Ks", "Ka", "Ni", "Ns", "map_Kd"):
            if block is None:
                raise SceneError(f"{where}: {statement} comes before any newmtl; write newmtl NAME before it")
            value = _value(statement, text, where, folder or path.parent, path.parent, findings)
            if statement in fields:
                block[fields[statement]] = value
        # the report's reading defines itself; from the standard's, statements may be missing
        elif convention == "standard" and statement:
            plain = re.sub(r"\.0+\b", "", f"{statement} {text}")
            if plain not in _WITHOUT_EFFECT:
                findings.setdefault("statements", []).append(f"{where}: {statement} {text[:40]} is not used")
    warn_of(findings)
    default = DEFAULT_MATERIAL if convention == "report" else _STANDARD
    return {name: replace(default, **block) for name, block in blocks.items()}


def _value(
    statement: str, text: str, where: str, folder: Path, library: Path, findings: dict[str, list[str]]
) -> Color | float | str | None:
    """A colour, an index, a roughness, or the path of a picture; None, with a finding, if it is missing.

    Raises ``SceneError`` for anything else.
    """
    words = text.split()
    if statement == "map_Kd":
        if not text:
            raise SceneError(f"{where}: map_Kd names no file")
        names = [text]
        if text.startswith("-"):  # options of some words before the name, which may have blanks in it
            names += [" ".join(words[k:]) for k in range(1, min(len(words), 32))]
        for name in names:
            picture = find(name, [folder, library])
            if picture is not None:
                return str(picture)
        missing = f"{where}: the texture {text} {MISSING} {folder}; Kd is used in its place"
        findings.setdefault("textures", []).append(missing)
        return None
    counts = {1: "one number"}
    if statement[0] == "K":
        counts = {1: "one", 3: "three numbers"}
    try:
        values = list(map(float, words))
    except ValueError:
        values = []
    if len(values) not in counts or not all(0 <= v <= LARGEST for v in values):
        must = f"must be {' or '.join(counts.values())}, finite and not negative, but is"
        raise SceneError(f"{where}: {statement} {must} {text[:80]!r}")
    if statement == "Ns":
        return math.sqrt(2 / (values[0] + 2))
    if statement in ("Kd", "Ks"):
        return values[0], values[len(values) // 2], values[-1]
    return values[0]
