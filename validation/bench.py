"""``make bench``: the times that matter to a user, as JSON, compared with an earlier file.

For scenes 0 to 4 at 800x600, aa=4, every pixel supersampled: a warm render, its kernels one by one, the floor
of its rays alone, and the whole command with its default options; and this project's plugins against
Mitsuba's own. Seconds of two machines, or of one under another load, do not compare; ratios to the floor, and
to Mitsuba's plugins, of the same run do. Takes some five minutes.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import MrtError, UsageError
from mrt_mitsuba.output.replacing import replacing
from mrt_mitsuba.validation.tools import kernels, machine, turns
from mrt_mitsuba.validation.tools.report import prepare
from mrt_mitsuba.validation.tools.study import Goal


def _schema(title: str, notes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON schema of an object: ``notes`` has a description of each number, or a schema."""
    known = {k: {"type": "number", "description": v} if isinstance(v, str) else v for k, v in notes.items()}
    return {"type": "object", "title": title, "required": list(known), "properties": known}


_TEXT, _COUNT = {"type": "string"}, {"type": "integer"}
_COUNTS = {"type": "object", "additionalProperties": _COUNT}
KERNEL = _schema(
    "a kernel in one pass of the render",
    {
        "stage": _TEXT,
        "kind": {"type": "string", "description": "traces rays, computes, or Dr.Jit's name"},
        "hash": _TEXT,
        "launches": _COUNT,
        "size": {"type": "integer", "description": "threads of all launches"},
        "operations": {"type": "integer", "description": "length of the code"},
        "codegen": "seconds that Dr.Jit takes to write the code, every time",
        "compile": "seconds of the compiler, once",
        "seconds": "running, median",
    },
)
SCENE = _schema(
    "a scene, every pixel supersampled",
    {
        "render": "seconds, median of warm renders",
        "spread": "(slowest - fastest) / median",
        "kernels": "seconds in kernels, of one warm render",
        "compile": "seconds of the compiler in a first render",
        "floor": "seconds of the same rays through Mitsuba's queries",
        "render_to_floor": "median of ratios of render and floor, in turn",
        "rays_per_second": "of all kinds",
        "command": "seconds of the whole command, median, kernels in the cache",
        "command_first": "seconds of the whole command, with an empty cache",
        "rays": _COUNTS,
        "each_kernel": {"type": "array", "items": KERNEL},
    },
)
RIVALS = _schema(
    "ratios of seconds, ours over theirs, in turn",
    {
        "median": "of the ratios",
        "low": "lower quartile",
        "high": "upper quartile",
        "seconds": "ours, median",
        "other_seconds": "theirs, median",
        "goal": "what the ratio is to stay below",
    },
)
SCHEMA = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | _schema(
    "mrt-mitsuba benchmark",
    {
        "schema": {"const": 2},
        "machine": {"type": "object"},
        "versions": {"type": "object"},
        "options": {"type": "object"},
        "scenes": {"type": "object", "additionalProperties": SCENE},
        "rivals": {"type": "object", "additionalProperties": RIVALS},
    },
)
COMPARED = ("render", "kernels", "floor", "render_to_floor", "command")


@dataclass(frozen=True)
class Extent:
    """How much to measure."""

    width: int
    height: int
    aa: int
    scenes: Sequence[int]
    repeats: int
    rivals: Mapping[str, Any]  # that of the study


RIVALS_FULL = {"size": (400, 300), "spp": 16, "scenes": (0, 1, 2, 3, 4), "repeats": 5}
RIVALS_QUICK = {"size": (40, 30), "spp": 4, "scenes": (0,), "repeats": 1}
FULL = Extent(800, 600, 4, (0, 1, 2, 3, 4), 5, RIVALS_FULL)
QUICK = Extent(80, 60, 2, (3,), 1, RIVALS_QUICK)


def bench(extent: Extent = FULL) -> dict[str, Any]:
    """Measure; return what ``SCHEMA`` describes."""
    from mrt_mitsuba.validation.studies import rivals  # not before ``own_cache``

    mrt.register()
    options = {**asdict(extent), "aamode": "none"}
    return {
        "schema": 2,
        "machine": machine.machine(),
        "versions": machine.versions(),
        "options": json.loads(json.dumps(options)),  # as it is read back
        "scenes": {str(number): _scene(number, extent) for number in extent.scenes},
        "rivals": {one.pair.name: one.as_dict() for one in rivals.compare(rivals.Extent(**extent.rivals))},
    }


def _scene(number: int, extent: Extent) -> dict[str, Any]:
    from mrt_mitsuba.validation.tools.costs import scene_cost

    found = scene_cost(number, (extent.width, extent.height), extent.aa, repeats=extent.repeats)
    gc.collect()  # scenes that stay alive slow down the kernels of later ones
    kernels.forget()
    first, *commands = (_command(number, extent) for _ in range(1 + max(1, extent.repeats // 2)))
    return {
        "render": found.warm.seconds,
        "spread": found.warm.spread,
        "kernels": found.in_kernels,
        "compile": found.compile,
        "floor": found.floor.other_seconds,
        "render_to_floor": found.floor.median,
        "rays_per_second": found.rays_per_second,
        "command": statistics.median(commands),
        "command_first": first,
        "rays": found.recorded,
        "each_kernel": [asdict(k) for k in found.each],
    }


def _command(number: int, extent: Extent) -> float:
    """Return the seconds of the command with its default options but for the size."""
    with tempfile.TemporaryDirectory() as folder:
        size = [f"{name}={getattr(extent, name)}" for name in ("width", "height", "aa")]
        command = [sys.executable, "-m", "mrt_mitsuba.command.main", f"{folder}/out", str(number)]
        return turns.seconds([*command, *size])


def table(now: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> str:
    """Return the figures as text; with an earlier run, each followed by its ratio to then."""
    earlier = before or {"scenes": {}, "rivals": {}}
    lines = ["scene " + "".join(f"{name:>20}" for name in COMPARED)]
    for number, found in now["scenes"].items():
        then = earlier["scenes"].get(number, {})
        cells = [_cell(found[name], then.get(name)) for name in COMPARED]
        lines.append(f"{number:<6}" + "".join(f"{cell:>20}" for cell in cells))
    width = max(map(len, now["rivals"]), default=0)
    lines += ["", f"{'ours / theirs':<{width}}{'ratio of seconds':>20}    quartiles      goal"]
    for name, found in now["rivals"].items():
        cell = _cell(found["median"], earlier["rivals"].get(name, {}).get("median"))
        verdict = Goal(name, found["median"], found["goal"], low=found["low"], high=found["high"]).verdict
        quartiles = f"{found['low']:.2f} to {found['high']:.2f}"
        lines.append(f"{name:<{width}}{cell:>20}    {quartiles}  {found['goal']:g} {verdict}")
    return "\n".join(lines)


def _cell(value: float, earlier: float | None) -> str:
    return f"{value:.3f}" + (f" ({value / earlier:.2f}x)" if earlier else "")


def read(path: Path) -> dict[str, Any]:
    """Return an earlier run. Raises ``UsageError`` for a file that is none."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot compare with {path}: {error}") from error
    whole = isinstance(found, dict) and found.keys() >= set(SCHEMA["required"])
    if not whole or found["schema"] != 2:
        raise UsageError(f"cannot compare with {path}: it is not a file of this benchmark (schema 2)")
    return found


def _special(given: argparse.Namespace) -> int:
    """Measure small renders, or a device; write JSON."""
    from mrt_mitsuba.validation.tools import device_bench

    if given.small:
        waits = turns.waits(given.before, given.turns)
        print(turns.table(waits))
        found = turns.as_dicts(waits)
    else:
        print(device_bench.HEADER)
        rows = []
        extent = device_bench.QUICK if given.quick else device_bench.FULL
        try:
            for row in device_bench.measure(given.device, extent):
                print(row, flush=True)
                rows.append(row)
        except MrtError as error:
            print(f"make bench-gpu: {error}", file=sys.stderr)
            return error.exit_code
        found = device_bench.as_dicts(rows)
    with replacing(given.out) as file:
        file.write(json.dumps(found, indent=2).encode() + b"\n")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write JSON, and compare."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    add = parser.add_argument
    add("--out", type=Path, default=Path("bench.json"), help="file to write (default: bench.json)")
    add("--compare", type=Path, help="an earlier file; ratios above 1 are slower")
    add("--quick", action="store_true", help="small pictures: a trial of the benchmark, not a measurement")
    add("--small", action="store_true", help="the start of the command and small renders alone, in turns")
    add("--before", metavar="PYTHON", help="with --small: a Python that has an earlier version")
    add("--turns", type=int, default=7, help="with --small: processes of each side (default: 7)")
    add("--device", metavar="VARIANT", help="against Mitsuba's integrators in a variant, such as cuda_ad_rgb")
    add("--schema", action="store_true", help="print the JSON schema of the file and stop")
    given = parser.parse_args(arguments)
    if given.schema:
        print(json.dumps(SCHEMA, indent=2))
        return 0
    try:
        before = read(given.compare) if given.compare else None
        prepare(given.out.parent, given.out.name)
    except UsageError as error:
        parser.error(str(error))
    except MrtError as error:
        print(f"make bench: {error}", file=sys.stderr)
        return error.exit_code
    if given.small or given.device:
        return _special(given)
    with kernels.own_cache():  # seconds of compilation are then the compiler's
        now = bench(QUICK if given.quick else FULL)
    with replacing(given.out) as file:
        file.write(json.dumps(now, indent=2).encode() + b"\n")
    print(table(now, before))
    if before and before["options"] != now["options"]:
        print("The earlier file was measured with other options: its ratios mean little.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
