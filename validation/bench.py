"""``make bench``: seconds of renders that matter to users, in turns with an earlier version (``--before``).

You cannot compare seconds from two machines, or under two loads, but ratios of the same run. Each side runs
in a process of its own, by public names only, which the earlier version has, too.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import timeit
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import mrt_mitsuba as mrt

# isort: split
import mitsuba as mi  # after ours, which finds LLVM for it

Nodes = dict[str, Any]
Run = Callable[[], object]
Case = Callable[[], Run]  # makes a run

ONE_RAY: Nodes = {"aamode": "none", "aa": 1, "lattice": "report", "focaldist": 0}
SUPERSAMPLED: Nodes = ONE_RAY | {"aa": 4}
SIZE: Nodes = {"width": 400, "height": 300}
SMALL: Nodes = {"width": 64, "height": 48}


def with_lights(number: int) -> Nodes:
    """Return scene 4, small, with so many point lights."""
    nodes = mrt.scene_dict(4, width=160, height=120)
    positions = np.outer(np.arange(number), (0.754877666, 0.569840296, 0.362378)) % 1 * 10 + 1
    for i, position in enumerate(positions.tolist()):  # also in place of its own three
        intensity = {"type": "rgb", "value": 6 / number}
        nodes[f"light_{i}"] = {"type": "mrt_light", "position": position, "intensity": intensity}
    return nodes


def with_triangles(number: int) -> Nodes:
    """Return scene 0 on a heap of so many small triangles."""
    rng = np.random.default_rng(5)
    corners = rng.uniform((-3, -0.2, -3), (3, 0.1, 3), (number, 1, 3)) + rng.normal(0, 0.003, (number, 3, 3))
    nodes = mrt.scene_dict(0, **SIZE)
    nodes["plane_0"] = {
        "type": "mrt_mesh",
        "positions": mi.Bitmap(corners.reshape(1, -1, 3).astype(np.float32)),
        "faces": mi.Bitmap(np.arange(3 * number, dtype=np.uint32).reshape(1, -1, 3)),
        "bsdf": {"type": "ref", "id": "material_4"},
    }
    return nodes


def with_cones(number: int) -> Nodes:
    """Return the room of scene 4 with so many cones in place of its spheres."""
    room = mrt.scene_dict(4, **SIZE)
    nodes = {name: node for name, node in room.items() if not name.startswith("sphere")}
    rng = np.random.default_rng(5)
    bases = rng.uniform((1, 0, 1), (7.5, 6.5, 7.5), (number, 3))
    tips = bases + rng.normal(0, 0.2, (number, 3))
    for i, (tip, base) in enumerate(zip(tips.tolist(), bases.tolist(), strict=True)):
        cone = {"type": "mrt_cone", "apex": tip, "base_center": base, "radius": 0.15}
        nodes[f"cone_{i}"] = cone | {"bsdf": {"type": "ref", "id": "material_0"}}
    return nodes


def render(nodes: Callable[..., Nodes], *arguments: Any, options: Nodes, **size: int) -> Run:
    """Return a render of a scene that is loaded once."""
    return partial(mrt.render, mi.load_dict(nodes(*arguments, **size)), **options)


def prepared() -> Run:
    """Return a prepared render."""
    return mrt.prepare(mi.load_dict(mrt.scene_dict(3, **SMALL)), **ONE_RAY)


def command() -> Run:
    """Return a run of ``mrt out 0`` in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    words = [sys.executable, "-m", "mrt_mitsuba.command.main", f"{tempfile.mkdtemp()}/out", "0", "quiet=1"]
    return partial(subprocess.run, words, check=True, env=environment, stdout=subprocess.DEVNULL)


LARGE: Nodes = {"options": SUPERSAMPLED, "width": 800, "height": 600}
CASES: dict[str, Case] = {f"scene {n}": partial(render, mrt.scene_dict, n, **LARGE) for n in range(5)}
CASES |= {
    "a million triangles": partial(render, with_triangles, 10**6, options=SUPERSAMPLED),
    "200 lights": partial(render, with_lights, 200, options=ONE_RAY),
    "a thousand cones": partial(render, with_cones, 1000, options=SUPERSAMPLED),
    "small, loaded": partial(render, mrt.scene_dict, 3, options=ONE_RAY, **SMALL),
    "small, prepared": prepared,
    "mrt out 0": command,
}


def seconds(case: Case) -> float:
    """Return the mean seconds of warm runs of a case, over 0.2 s or one run."""
    run = case()
    for _ in range(3):
        run()
    number, taken = timeit.Timer(run).autorange()
    return taken / number


def measured(words: Sequence[str], turn: int) -> dict[str, float]:
    """Return the seconds of cases, by name, from a process of their own."""
    ran = subprocess.run(words, check=True, stdout=subprocess.PIPE, timeout=3600)
    return dict(json.loads(ran.stdout.splitlines()[-1]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure cases, print a row for each, and write them as JSON."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    add = parser.add_argument
    add("cases", nargs="*", metavar="CASE", help=f"by default all: {', '.join(CASES)}")
    add("--out", type=Path, default=Path("bench.json"), help="file to write (default: bench.json)")
    add("--before", metavar="PYTHON", help="a Python that has an earlier version, to take turns with")
    add("--turns", type=int, default=7, help="how often each side is measured (default: 7)")
    add("--variant", default="llvm_ad_rgb", help="of Mitsuba (default: llvm_ad_rgb)")
    add("--measure", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    names = given.cases or list(CASES)
    if unknown := [name for name in names if name not in CASES]:
        parser.error(f"unknown case {unknown[0]!r}: choose from {', '.join(CASES)}")
    if given.measure:
        mi.set_variant(given.variant)
        mrt.register()
        print(json.dumps({name: seconds(CASES[name]) for name in names}))
        return 0
    from mrt_mitsuba.validation.timing import in_turns, ratio_of

    words = [__file__, "--measure", "--variant", given.variant, *names]
    pythons = [sys.executable, given.before or sys.executable]
    found, before = in_turns([partial(measured, [python, *words]) for python in pythons], given.turns)
    rows = {}
    for name in names:
        rows[name] = ratio_of([run[name] for run in found], [run[name] for run in before])
        print(f"{name:<20}" + "".join(f"  {key} {value:.4g}" for key, value in rows[name].items()))
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
