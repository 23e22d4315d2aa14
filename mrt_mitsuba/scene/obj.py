"""OBJ files: meshes with shared materials, and errors that name file and line.

Mitsuba's own ``obj`` plugin makes one mesh with one material of a whole file, so the reader is the project's
own. Runs of lines of the usual forms are recognised by one regular expression and turned into arrays at once,
a million triangles in two or three seconds; every other line is read by itself, with care. The time grows
with the size of the file whatever it holds: the lengths of numbers and gaps in the expression are bounded.
"""

from __future__ import annotations

import itertools
import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.scene.files import MISSING, decode, find, numbers, read_text, warn
from mrt_mitsuba.scene.model import Material, Mesh
from mrt_mitsuba.scene.mtl import CONVENTIONS, DEFAULT_MATERIAL, read_mtl

# Names, groups, smoothing, curves and display: nothing that is rendered here
_UNUSED = """g s o mg l p vp deg bmat step cstype curv curv2 surf parm trim hole scrv sp end con bevel
    c_interp d_interp lod shadow_obj trace_obj ctech stech call csh maplib usemap"""
_IGNORED = frozenset(_UNUSED.split())

_LINES_AT_ONCE = 4096  # regular expressions keep a state for each repetition
_GAP, _END = rb"[ \t]{1,99}", rb"[ \t]{0,99}\n"
_REAL = rb"[-+]?(?:\d{1,99}(?:\.\d{0,99})?|\.\d{1,99})(?:[eE][-+]?\d{1,9})?"
_INDEX = rb"-?\d{1,18}"  # what fits 64 bits
# Forms of a corner: the pattern, and what its indices are of
_CORNERS = {
    "c": (_INDEX, ("v",)),
    "t": (_INDEX + b"/" + _INDEX, ("v", "vt")),
    "n": (_INDEX + b"//" + _INDEX, ("v", "vn")),
    "tn": (_INDEX + b"/" + _INDEX + b"/" + _INDEX, ("v", "vt", "vn")),
}


def _run(keyword: bytes, word: bytes, count: int) -> bytes:
    """Return the pattern of up to some thousand lines of a keyword and ``count`` words."""
    return b"(?:%s%s%s){1,%d}" % (keyword, (_GAP + word) * count, _END, _LINES_AT_ONCE)


# The usual numbers of numbers: positions may have a weight, a colour or both behind them, which are not used
_RUNS = {f"v_{n}": _run(b"v", _REAL, n) for n in (3, 4, 6, 7)}
_RUNS |= {f"vt_{n}": _run(b"vt", _REAL, n) for n in (2, 3)} | {"vn_3": _run(b"vn", _REAL, 3)}
_RUNS |= {f"f_{n}_{form}": _run(b"f", word, n) for n in range(3, 7) for form, (word, _) in _CORNERS.items()}
_USED = {"v": 3, "vt": 2, "vn": 3}
_BLOCKS = re.compile(
    b"|".join(b"(?P<%s>%s)" % (k.encode(), v) for k, v in _RUNS.items()) + rb"|(?P<line>[^\n]*\n)"
)

# Letters of keywords, slashes and line ends as blanks: what is left are the numbers
_NUMBERS_ONLY = bytes(32 if chr(i) in "vtnf/\n" else i for i in range(256))


def read_obj(path: str | os.PathLike[str], *, convention: str = "report") -> tuple[Mesh, ...]:
    """Return the meshes of an OBJ file, one for each material that is used.

    Faces are ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, with positive or negative indices. One with more than
    three corners is cut into a fan around its first corner, which is right for convex faces. Normals are used
    by the convention "standard" for the faces that have them; else triangles are flat, and their normal
    follows from the winding. Material libraries are looked for next to the file and read by ``convention``
    (see ``read_mtl``); one that is missing is named in a warning. Faces of no known material get
    ``DEFAULT_MATERIAL``.

    Raises ``SceneError`` with file and line for what cannot be read, ``UsageError`` for an unknown
    convention.
    """
    return read_model(path, convention=convention)[0]


def read_model(
    path: str | os.PathLike[str], *, convention: str = "report"
) -> tuple[tuple[Mesh, ...], frozenset[str]]:
    """Return what ``read_obj`` does, and the paths of all files that belong to the model, used or not."""
    if convention not in CONVENTIONS:
        raise UsageError(f"convention={convention!r}: must be {' or '.join(CONVENTIONS)}")
    reader = _Reader(Path(path), convention)
    reader.read()
    textures = {material.texture for material in reader.materials.values() if material.texture is not None}
    return reader.meshes(), frozenset({os.fspath(path), *reader.libraries, *textures})


@dataclass
class _Reader:
    path: Path
    convention: str
    materials: dict[str, Material] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.arrays: dict[str, list[np.ndarray]] = {"v": [], "vt": [], "vn": []}
        self.counts = {"v": 0, "vt": 0, "vn": 0}
        # Of faces of as many corners, one on each line: indices from 0, int64 [F, corners], −1 for none, of
        # "v", "vt" and "vn"; the material; the first line
        self.faces: list[tuple[dict[str, np.ndarray], str | None, int]] = []
        self.material: str | None = None
        self.line = 1
        self.unknown_materials: set[str] = set()
        self.findings: dict[str, list[str]] = {}
        self.libraries: set[str] = set()

    def fail(self, text: str, line: int | None = None) -> None:
        raise SceneError(f"{self.path}:{self.line if line is None else line}: {text}")

    # ------------------------------------------ Statements ---------------------------------------------

    def read(self) -> None:
        data = read_text(self.path)
        for match in _BLOCKS.finditer(data):
            kind, *form = str(match.lastgroup).split("_")
            if kind == "line":
                self._statement(match[0])
                self.line += 1
                continue
            lines = match[0].count(b"\n")
            words = match[0].translate(_NUMBERS_ONLY)
            if kind == "f":
                indices = np.fromstring(words, np.int64, sep=" ").reshape(lines, int(form[0]), -1)
                self._add_faces(indices, _CORNERS[form[1]][1])
            else:
                values = np.fromstring(words, np.float64, sep=" ").reshape(lines, -1)
                self._add_values(kind, values[:, : _USED[kind]])
            self.line += lines

    def _statement(self, text: bytes) -> None:
        """Read one line of a form that is not covered by the runs."""
        words = decode(text.split(b"#", 1)[0]).split()
        if not words:
            return
        keyword = words.pop(0)
        where = f"{self.path}:{self.line}"
        if keyword == "v":
            if len(words) == 5:
                self.fail("v has 5 numbers, but must have 3, 4 (with w), 6 or 7 (with a colour)")
            self._add_values("v", np.array([numbers(where, "v", words, 3, 7)[:3]]))
        elif keyword == "vt":
            self._add_values("vt", np.array([[*numbers(where, "vt", words, 1, 3), 0.0][:2]]))
        elif keyword == "vn":
            self._add_values("vn", np.array([numbers(where, "vn", words, 3, 3)]))
        elif keyword == "f":
            self._face(words)
        elif keyword == "usemtl":
            name = self.material = _rest(text, "usemtl")
            if not name:
                self.fail("usemtl has no name; write usemtl NAME")
            if name not in self.materials and name not in self.unknown_materials:
                self.unknown_materials.add(name)
                self.findings.setdefault("materials", []).append(
                    f"{where}: no library has the material {name!r}; it gets the default"
                )
        elif keyword == "mtllib":
            self._library(_rest(text, "mtllib"))
        elif keyword not in _IGNORED:
            self.fail(
                f"unknown statement {keyword[:40]!r}; expected v, vt, vn, f, usemtl, mtllib or the like"
            )

    def _add_values(self, kind: str, values: np.ndarray) -> None:
        with np.errstate(over="ignore"):
            narrow = values.astype(np.float32)
        if not np.isfinite(narrow).all():
            row = int(np.argmin(np.isfinite(narrow).all(axis=1)))
            self.fail(f"{kind} holds a number that is too large for a float32", self.line + row)
        self.arrays[kind].append(narrow)
        self.counts[kind] += len(values)

    # ------------------------------------------ Faces --------------------------------------------------

    def _face(self, words: list[str]) -> None:
        """Read a face of any number of corners, in any of the four forms."""
        if len(words) < 3:
            self.fail(f"f has {len(words)} corners, but must have 3 or more")
        corners, forms = [], set()
        for word in words:
            parts = word.split("/")
            well = len(parts) <= 3 and all(re.fullmatch(r"([-+]?[0-9]{1,18})?", part) for part in parts)
            if not well or not parts[0]:
                self.fail(f"f has the corner {word[:40]!r}, but must have v, v/vt, v//vn or v/vt/vn")
            forms.add(tuple(kind for kind, part in zip(("v", "vt", "vn"), parts, strict=False) if part))
            corners.append([int(part) for part in parts if part])
        if len(forms) > 1:
            self.fail(f"f has corners of different forms: {' '.join(words)[:80]}; give all the same indices")
        self._add_faces(np.array([corners], np.int64), forms.pop())

    def _add_faces(self, indices: np.ndarray, kinds: tuple[str, ...]) -> None:
        """Add faces [F, corners, kinds of index], their indices counted from 0."""
        resolved = {}
        for k, kind in enumerate(kinds):
            index = indices[:, :, k]
            resolved[kind] = np.where(index > 0, index - 1, index + self.counts[kind])
            wrong = (index == 0) | (resolved[kind] < 0)
            if wrong.any():
                row = int(np.argmax(wrong.any(axis=1)))
                bad = int(index[row][wrong[row]][0])
                reason = (
                    f"only {self.counts[kind]} came before"
                    if bad
                    else "indices count from 1, or back from -1"
                )
                self.fail(f"f has the {kind} index {bad}: {reason}", self.line + row)
        missing = dict.fromkeys(("vt", "vn"), np.full_like(resolved["v"], -1))
        self.faces.append((missing | resolved, self.material, self.line))

    # ---------------------------------------- Materials ------------------------------------------------

    def _library(self, rest: str) -> None:
        if not rest:
            self.fail("mtllib has no name; write mtllib FILE")
        folder = self.path.parent
        for name in [rest] if find(rest, [folder]) else rest.split():
            found = find(name, [folder])
            if found is None:
                text = f"{self.path}:{self.line}: the material library {name} {MISSING} {folder}"
                self.findings.setdefault("libraries", []).append(f"{text}; its materials get the default")
            else:
                self.libraries.add(str(found))
                self.materials |= read_mtl(found, convention=self.convention, folder=folder)

    # ------------------------------------------ Result -------------------------------------------------

    def meshes(self) -> tuple[Mesh, ...]:
        """Return one mesh for each material, in the order of their first use."""
        warn(self.findings)
        for kind, (index, _, line) in itertools.product(_USED, self.faces):
            beyond = index[kind] >= self.counts[kind]
            if beyond.any():
                row = int(np.argmax(beyond.any(axis=1)))
                bad = int(index[kind][row][beyond[row]][0]) + 1
                self.fail(f"f has the {kind} index {bad}, but the file has {self.counts[kind]}", line + row)
        points, uvs, normals = (
            np.concatenate(self.arrays[kind] or [np.empty((0, _USED[kind]), np.float32)]) for kind in _USED
        )
        by_material: dict[tuple[Material, bool], list[dict[str, np.ndarray]]] = {}
        for index, name, _ in self.faces:
            material = self.materials.get(name or "", DEFAULT_MATERIAL)
            if index["vt"][0, 0] < 0:
                material = replace(material, texture=None)  # no coordinates to look it up
            smooth = self.convention == "standard" and index["vn"][0, 0] >= 0
            by_material.setdefault((material, smooth), []).append(index)
        if not by_material:
            raise SceneError(f"{self.path}: has no faces; export the model with its geometry")
        return tuple(
            _mesh(points, uvs, normals if smooth else None, faces, material)
            for (material, smooth), faces in by_material.items()
        )


def _mesh(
    points: np.ndarray,
    uvs: np.ndarray,
    normals: np.ndarray | None,
    faces: list[dict[str, np.ndarray]],
    material: Material,
) -> Mesh:
    """Return the mesh of some faces, with the vertices that they use."""
    v, vt, vn = (np.concatenate([_triangles(f[kind]) for f in faces]) for kind in _USED)
    if material.texture is None and normals is None:
        used = np.zeros(len(points), bool)
        used[v] = True
        new = np.cumsum(used, dtype=np.uint32) - np.uint32(1)  # the vertices used, in their order
        return Mesh(points[used], new[v], material)
    # Each corner becomes a vertex: a point may have another texture or normal in another triangle
    index = np.arange(v.size, dtype=np.uint32).reshape(-1, 3)
    textured = None if material.texture is None else uvs[vt.ravel()]
    smooth = None if normals is None else normals[vn.ravel()]
    return Mesh(points[v.ravel()], index, material, textured, smooth)


def _triangles(index: np.ndarray) -> np.ndarray:
    """Return fans [F (n − 2), 3] around the first corners of faces [F, n]."""
    corners = index.shape[1]
    if corners == 3:
        return index
    fan = [index[:, [0, k, k + 1]] for k in range(1, corners - 1)]
    return np.stack(fan, axis=1).reshape(-1, 3)


def _rest(text: bytes, keyword: str) -> str:
    """Return what follows a keyword, blanks inside it included."""
    return decode(text).strip()[len(keyword) :].strip()
