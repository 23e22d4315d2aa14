"""OBJ files: meshes with shared materials, errors that name file and line, and a camera and lights for them.

Mitsuba's own ``obj`` plugin makes one mesh with one material of a whole file, so the reader is the project's
own. One regular expression recognises runs of lines of one form, which are turned into arrays at once, a
million triangles in two or three seconds; a line with a comment or more blanks is a run of its own. The time
grows with the size of the file whatever it holds: the lengths of numbers and gaps in the expression are
bounded.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from mrt_mitsuba.errors import SceneError, UsageError
from mrt_mitsuba.options import StrPath, check
from mrt_mitsuba.scene.files import MISSING, decode, find, read_text, warn_of
from mrt_mitsuba.scene.model import BLUE_SKY, CONVENTION, Camera, Light, Material, Mesh, Scene
from mrt_mitsuba.scene.mtl import DEFAULT_MATERIAL, find_material, read_mtl
from mrt_mitsuba.scene.polygons import triangulate

# Numbers of each kind of values that are used: positions may have a weight, a colour or both behind them
_USED = {"v": 3, "vt": 2, "vn": 3}
_FORMS = {
    "v": "v must have 3 to 7 numbers",
    "vt": "vt must have 1 to 3 numbers",
    "vn": "vn must have 3 numbers",
    "f": "f must have 3 corners or more, all v, v/vt, v//vn or v/vt/vn",
}
# Names, groups, smoothing, curves and display, which are not rendered
_UNRENDERED_WORDS = """g s o mg l p vp deg bmat step cstype curv curv2 surf parm trim hole scrv sp end con
    bevel c_interp d_interp lod shadow_obj trace_obj ctech stech call csh maplib usemap"""
_UNRENDERED = frozenset(_UNRENDERED_WORDS.split())

_GAP = rb"[ \t]{1,99}"
_END = rb"[ \t]{0,99}\n"
_REAL = rb"[-+]?(?:\d{1,99}(?:\.\d{0,99})?|\.\d{1,99})(?:[eE][-+]?\d{1,9})?"
_INDEX = rb"[-+]?\d{1,18}"  # what fits 64 bits
# Forms of a corner: the pattern, and the columns of ``_USED`` that its indices refer to
_CORNERS = {
    "c": (_INDEX, [0]),
    "t": (_INDEX + b"/" + _INDEX, [0, 1]),
    "n": (_INDEX + b"//" + _INDEX, [0, 2]),
    "tn": (_INDEX + b"/" + _INDEX + b"/" + _INDEX, [0, 1, 2]),
}


def _run(name: str, word: bytes) -> bytes:
    """Return the pattern of a run of lines with the same keyword and number of words.

    "f_3_tn": up to 4096 lines of f and three words. "f_0_tn": a single line of f and seven words or more, as
    regular expressions keep a state for each repetition.
    """
    keyword, count, *_ = name.split("_")
    words = (_GAP + word) * int(count)
    most = 4096
    if int(count) == 0:
        words = b"(?:%s){7,}" % (_GAP + word)
        most = 1
    return b"(?P<%s>(?:%s%s%s){1,%d})" % (name.encode(), keyword.encode(), words, _END, most)


_VALUE_RUNS = "v_3 v_4 v_5 v_6 v_7 vt_1 vt_2 vt_3 vn_3"
_RUNS = [_run(name, _REAL) for name in _VALUE_RUNS.split()]
_RUNS += [_run(f"f_{n}_{form}", word) for n in (3, 4, 5, 6, 0) for form, (word, _) in _CORNERS.items()]
# Runs of lines without data; any other line is matched alone
_SKIPPED = rb"(?P<skipped>(?:[ \t]{0,99}(?:#[^\n]*|(?:g|s|o|l|p|mg)[ \t][^\n]*)?\n){1,4096})"
_BLOCKS = re.compile(b"|".join([*_RUNS, _SKIPPED, rb"(?P<line>[^\n]*\n)"]))

# Letters of keywords, slashes and line ends as blanks: what is left are the numbers
_NUMBERS_ONLY = bytes(32 if chr(i) in "vtnf/\n" else i for i in range(256))


def read_obj(path: StrPath, *, convention: str = "report") -> tuple[tuple[Mesh, ...], frozenset[str]]:
    """Return the meshes of an OBJ file, one for each material that is used, and the paths of all its files.

    Faces are ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, with positive or negative indices. One with more than
    three corners is cut into triangles, also where it is not convex. Normals are used by the convention
    "standard" for the faces that have them; else triangles are flat, and their normal follows from the
    winding. Material libraries are looked for next to the file and read by ``convention`` (see ``read_mtl``);
    one that is missing is named in a warning, and so are unknown statements. Faces of no known material get
    ``DEFAULT_MATERIAL``.

    Raises ``SceneError`` with file and line for what cannot be read, ``UsageError`` for an unknown
    convention.
    """
    check("convention", CONVENTION, convention)
    reader = _Reader(Path(path), convention)
    for block in _BLOCKS.finditer(read_text(reader.path)):
        reader.read(block)
        reader.line += block[0].count(b"\n")
    textures = filter(None, (each.texture for each in reader.materials.values()))
    return reader.meshes(), frozenset({os.fspath(path), *reader.libraries, *textures})


class _Reader:
    """State of reading a file."""

    def __init__(self, path: Path, convention: str) -> None:
        self.path = path
        self.convention = convention
        self.line = 1
        self.values = {kind: [np.empty((0, used), np.float32)] for kind, used in _USED.items()}
        self.counts = np.zeros(len(_USED), np.int64)  # of the values read so far, by kind
        # Runs of faces with the same number of corners, one on each line: indices from 0, int64 [F, corners,
        # kinds]; the kinds, as in ``_CORNERS``; the material; the first line
        self.faces: list[tuple[np.ndarray, list[int], str, int]] = []
        self.material = ""
        self.materials: dict[str, Material] = {}
        self.named: dict[str, str] = {}  # by the name of a material, where it was used first
        self.libraries: set[str] = set()
        self.statements: set[str] = set()  # names of libraries that were looked for
        self.findings: dict[str, list[str]] = {}

    def fail(self, text: str, line: int) -> NoReturn:
        raise SceneError(f"{self.path}:{line}: {text}")

    def note(self, kind: str, text: str) -> None:
        """Record a finding for the warning after reading; ``kind``: a plural noun."""
        self.findings.setdefault(kind, []).append(f"{self.path}:{self.line}: {text}")

    def read(self, block: re.Match[bytes]) -> None:
        """Read a run of lines."""
        kind, *form = str(block.lastgroup).split("_")
        if kind == "skipped":
            return
        if kind == "line":
            self._statement(block[0])
            return
        lines = block[0].count(b"\n")
        words = block[0].translate(_NUMBERS_ONLY)
        if kind == "f":
            _, kinds = _CORNERS[form[1]]
            index = np.fromstring(words, np.int64, sep=" ").reshape(lines, -1, len(kinds))
            backwards = np.where(index < 0, index + self.counts[kinds], -1)
            faces = np.where(index > 0, index - 1, backwards)
            self.faces.append((faces, kinds, self.material, self.line))
            return
        values = np.fromstring(words, np.float64, sep=" ").reshape(lines, -1)
        if kind == "v" and values.shape[1] > 4 and "vertices" not in self.findings:
            self.note("vertices", "colours of vertices are not used")
        values = values[:, : _USED[kind]]
        used = np.zeros((lines, _USED[kind]), np.float32)
        with np.errstate(over="ignore"):
            used[:, : values.shape[1]] = values
        large = ~np.isfinite(used).all(axis=1)
        if large.any():
            self.fail(f"{kind} has a number that is too large for a float32", self.line + large.argmax())
        self.values[kind].append(used)
        self.counts[[*_USED].index(kind)] += lines

    def _statement(self, text: bytes) -> None:
        """Read one line of another form."""
        keyword, *words = decode(text.split(b"#", 1)[0]).split() or [""]
        name = decode(text).strip()[len(keyword) :].strip()
        where = f"{self.path}:{self.line}"
        if keyword in _FORMS:
            plain = " ".join([keyword, *(word.rstrip("/") for word in words)])
            again = _BLOCKS.fullmatch(plain.encode() + b"\n")
            if again is None or again.lastgroup == "line":
                self.fail(f"{_FORMS[keyword]}, but is {plain[:80]!r}", self.line)
            self.read(again)
        elif keyword in ("usemtl", "mtllib") and not name:
            self.fail(f"{keyword} has no name; write {keyword} NAME", self.line)
        elif keyword == "usemtl":
            self.material = name
            self.named.setdefault(name, where)
        elif keyword == "mtllib" and name not in self.statements:
            self.statements.add(name)
            self._libraries(name)
        elif keyword and keyword not in _UNRENDERED and keyword != "mtllib":
            self.note("statements", f"the statement {keyword[:40]!r} is unknown and is skipped")

    def _libraries(self, text: str) -> None:
        """Read the libraries that a statement names; of materials of one name, the first counts."""
        folder = self.path.parent
        plain = text.partition("#")[0].strip()
        whole = [name for name in (text, plain) if find(name, [folder])][:1]
        pieces = re.findall(r"\S.*?\.mtl(?=\s|$)", plain, re.IGNORECASE)  # each may have blanks in it
        for name in whole or pieces or [plain]:
            library = find(name, [folder])
            if library is None:
                text = f"the material library {name} {MISSING} {folder}; its materials get the default"
                self.note("libraries", text)
            elif str(library) not in self.libraries:
                self.libraries.add(str(library))
                self.materials = read_mtl(library, convention=self.convention, folder=folder) | self.materials

    def meshes(self) -> tuple[Mesh, ...]:
        """Return a mesh for each material, in the order of first use."""
        found = {text: find_material(self.materials, text) for text in self.named}
        unknown = [
            f"{where}: no library has the material {text!r}; it gets the default"
            for text, where in self.named.items()
            if found[text] is None
        ]
        values = [np.concatenate(arrays) for arrays in self.values.values()]
        parts: dict[tuple[Material, bool], list[np.ndarray]] = {}
        for faces, kinds, name, line in self.faces:
            counts = self.counts[kinds]
            for row, corner, k in np.argwhere((faces < 0) | (faces >= counts))[:1]:
                index = faces[row, corner, k] + 1
                kind = [*_USED][kinds[k]]
                problem = f"the {kind} index {index}, but the file has {counts[k]}"
                if index < 1:
                    problem = (
                        f"a {kind} index of 0, or before the first; indices count from 1, or back from -1"
                    )
                self.fail(f"f has {problem}", line + row)
            used = self.materials.get(found.get(name) or "", DEFAULT_MATERIAL)
            if 1 not in kinds:  # no coordinates to look it up
                used = replace(used, texture=None, texture_range=(0.0, 1.0))
            corners = np.zeros((*faces.shape[:2], len(_USED)), np.int64)  # [F, corners, kinds]
            corners[:, :, kinds] = faces
            cut, crossing = triangulate(values[0][corners[:, :, 0]])
            for row in np.flatnonzero(crossing)[:1]:
                self.line = line + int(row)
                self.note("faces", "the face crosses itself, or is too large; it may be drawn in part")
            triangles = np.take_along_axis(corners[:, None], cut[..., None], axis=2)
            smooth = self.convention == "standard" and 2 in kinds
            parts.setdefault((used, smooth), []).append(triangles.reshape(-1, 3, len(_USED)))
        warn_of(self.findings | {"materials": unknown})
        if not parts:
            raise SceneError(f"{self.path}: has no faces; export the model with its geometry")
        return tuple(_mesh(values, np.concatenate(cuts), *which) for which, cuts in parts.items())


def _mesh(values: Sequence[np.ndarray], triangles: np.ndarray, material: Material, smooth: bool) -> Mesh:
    """Return the mesh of triangles [T, 3, kinds of values], with the vertices that they use."""
    points, uvs, normals = values
    v, vt, vn = np.moveaxis(triangles, -1, 0)
    if material.texture is None and not smooth:
        kept = np.zeros(len(points), bool)
        kept[v] = True
        new = np.cumsum(kept, dtype=np.uint32) - np.uint32(1)  # the vertices used, in their order
        return Mesh(points[kept], new[v], material)
    # Each corner becomes a vertex: a point may have another texture or normal in another triangle
    scale, offset = np.array([material.scale, material.offset], np.float32)
    faces = np.arange(v.size, dtype=np.uint32).reshape(-1, 3)
    return Mesh(
        vertices=points[v.ravel()],
        faces=faces,
        material=material,
        uvs=None if material.texture is None else uvs[vt.ravel()] * scale + offset,
        normals=normals[vn.ravel()] if smooth else None,
    )


# ------------------------------------------- Camera and lights -----------------------------------------


def obj_scene(path: StrPath, *, convention: str = "report", **view: Any) -> Scene:
    """Return the scene of an OBJ file; by default, camera and lights are placed by the model's size.

    The camera stands in front, towards +z, a little above and to the right, and sees all of it; a light is up
    on each side, the right one brighter. Textures are looked up by ``convention``, too. ``view``: ``camera``,
    ``target`` and ``up`` (vectors) and ``fov`` (horizontal, in degrees), as ``render`` takes them. Raises
    ``UsageError`` for a camera that sees nothing, and what ``read_obj`` raises.
    """
    meshes, files = read_obj(path, convention=convention)
    low = np.min([m.vertices.min(axis=0) for m in meshes], axis=0).astype(float)
    high = np.max([m.vertices.max(axis=0) for m in meshes], axis=0).astype(float)
    radius = float(np.linalg.norm(high - low)) / 2 or 1.0
    # a ball of radius 1 fills a view of 45° height, that of 60° width in a 4:3 picture, from 2.6 away
    radii = np.array([(0, 0, 0), (1.0, 0.8, 2.4), (4, 5, 4), (-4, 3, 5)])
    places = (low + high) / 2 + radius * radii
    center, eye, right, left = map(tuple, places.tolist())
    fields = {"camera": "position", "fov": "hfov"}
    given = {fields.get(name, name): value for name, value in view.items()}
    camera = replace(Camera(eye, center), **given)
    problem = camera.problem()
    if problem:
        raise UsageError(problem)
    return Scene(
        title=os.path.basename(path),
        camera=camera,
        sky=BLUE_SKY,
        lights=(Light(right, (2.5, 2.5, 2.5)), Light(left, (1.0, 1.0, 1.2))),
        meshes=meshes,
        texturing=convention,
        files=files,
    )
