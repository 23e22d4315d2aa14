"""``make bench``: the times that matter to a user, as JSON, compared with an earlier file.

For scenes 0 to 4 at 800x600, aa=4, every pixel supersampled: a warm render, its compilation, the floor of
its rays alone, and the whole command with its default options. Seconds of two machines, or of one under
another load, do not compare; ratios to the floor of the same run do.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import UsageError

from .floor import floor
from .knobs import load
from .warm import measure

SCHEMA = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "mrt-mitsuba benchmark",
    "type": "object",
    "required": ["schema", "machine", "versions", "options", "scenes"],
    "properties": {
        "schema": {"const": 1},
        "machine": {
            "type": "object",
            "properties": {"cores": {"type": "integer"}, "system": {"type": "string"}},
        },
        "versions": {"type": "object", "additionalProperties": {"type": "string"}},
        "options": {"type": "object"},
        "scenes": {
            "type": "object",
            "additionalProperties": {
                "type": "object",
                "required": [
                    "render",
                    "spread",
                    "kernels",
                    "compile",
                    "floor",
                    "render_to_floor",
                    "command",
                    "rays",
                ],
                "properties": {
                    "render": {"type": "number", "description": "seconds, median of warm renders"},
                    "spread": {"type": "number", "description": "(slowest - fastest) / median"},
                    "kernels": {"type": "number", "description": "seconds in kernels, of one warm render"},
                    "compile": {
                        "type": "number",
                        "description": "seconds of compilation in the first render",
                    },
                    "floor": {
                        "type": "number",
                        "description": "seconds of the same rays through Mitsuba's queries",
                    },
                    "render_to_floor": {"type": "number"},
                    "command": {"type": "number", "description": "seconds of the whole command, median"},
                    "rays": {"type": "object", "additionalProperties": {"type": "integer"}},
                },
            },
        },
    },
}
SCENES = (0, 1, 2, 3, 4)
COMPARED = ("render", "kernels", "floor", "render_to_floor", "command")


def bench(
    *, width: int = 800, height: int = 600, aa: int = 4, scenes: Sequence[int] = SCENES, repeats: int = 5
) -> dict[str, Any]:
    """Measure; return what ``SCHEMA`` describes."""
    mrt.register()
    options = {"width": width, "height": height, "aa": aa}
    return {
        "schema": 1,
        "machine": {"cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"},
        "versions": _versions(),
        "options": {**options, "aamode": "none", "repeats": repeats},
        "scenes": {str(number): _scene(number, options, repeats) for number in scenes},
    }


def _versions() -> dict[str, str]:
    import drjit as dr
    import mitsuba as mi

    llvm = ".".join(map(str, dr.detail.llvm_version()))
    return {
        "mrt-mitsuba": mrt.__version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": llvm,
        "python": platform.python_version(),
    }


def _scene(number: int, options: Mapping[str, int], repeats: int) -> dict[str, Any]:
    scene = load(mrt.scene_dict(number, width=options["width"], height=options["height"]))
    how = {"aa": options["aa"], "aamode": "none"}
    warm = measure({"render": partial(mrt.render, scene, **how)}, repeats=repeats)["render"]
    kernels = mrt.render(scene, **how).timings.kernels
    under = floor(scene, repeats=repeats, **how)
    del scene
    gc.collect()  # scenes that stay alive slow down the kernels of later ones
    command = statistics.median(_command(number, options) for _ in range(max(1, repeats // 2)))
    return {
        "render": warm.seconds,
        "spread": warm.spread,
        "kernels": kernels,
        "compile": warm.result.timings.compile,
        "floor": under.seconds,
        "render_to_floor": warm.seconds / under.seconds,
        "command": command,
        "rays": under.rays,
    }


def _command(number: int, options: Mapping[str, int]) -> float:
    """Seconds of the command with its default options but for the size."""
    with tempfile.TemporaryDirectory() as folder:
        size = [f"{name}={options[name]}" for name in ("width", "height", "aa")]
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "mrt_mitsuba.cli", f"{folder}/out", str(number), *size],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        return time.perf_counter() - start


def table(now: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> str:
    """The figures as text; with an earlier run, each followed by its ratio to then."""
    lines = ["scene " + "".join(f"{name:>20}" for name in COMPARED)]
    for number, found in now["scenes"].items():
        earlier = (before or {"scenes": {}})["scenes"].get(number)
        cells = [
            f"{found[name]:.3f}" + (f" ({found[name] / earlier[name]:.2f}x)" if earlier else "")
            for name in COMPARED
        ]
        lines.append(f"{number:<6}" + "".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)


def read(path: Path) -> dict[str, Any]:
    """An earlier run. Raises ``UsageError`` for a file that is none."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot compare with {path}: {error}") from error
    if not isinstance(found, dict) or found.get("schema") != 1 or "scenes" not in found:
        raise UsageError(f"cannot compare with {path}: it is no file of this benchmark (schema 1)")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write JSON, and compare."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path("bench.json"), help="file to write (default: bench.json)"
    )
    parser.add_argument("--compare", type=Path, help="an earlier file; ratios above 1 are slower")
    parser.add_argument(
        "--quick", action="store_true", help="small pictures: a trial of the benchmark, not a measurement"
    )
    parser.add_argument("--schema", action="store_true", help="print the JSON schema of the file and stop")
    given = parser.parse_args(arguments)
    if given.schema:
        print(json.dumps(SCHEMA, indent=2))
        return 0
    try:
        before = read(given.compare) if given.compare else None
    except UsageError as error:
        parser.error(str(error))
    now = bench(width=80, height=60, aa=2, scenes=(0, 3), repeats=1) if given.quick else bench()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(now, indent=2) + "\n")
    print(table(now, before))
    if before and before["options"] != now["options"]:
        print("The earlier file was measured with other options: its ratios mean little.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
