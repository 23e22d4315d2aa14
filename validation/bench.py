"""``make bench``: the times that matter to users, as JSON, compared with an earlier file or version.

The start of the command against a bare start of Mitsuba; scenes 0 to 4 at 800x600, many objects, renders to
an error and small renders; and this project's plugins against Mitsuba's own. You cannot compare seconds from
two machines, or under two loads, but you can compare ratios of the same run. With ``--before``, every render
takes turns with an earlier version. Takes about ten minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError, UsageError
from mrt_mitsuba.files.replacing import replacing
from mrt_mitsuba.validation import renders
from mrt_mitsuba.validation.study import in_turns, machine, prepare_folder, ratio, ratio_of

START_GOAL = 1.7
DEVICE_SIZES = (800, 600), (4096, 4096)
# What any program on Mitsuba waits for: import, variant, one kernel
BARE = """
from mrt_mitsuba import llvm
import mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
dr.eval(dr.arange(mi.Float, 16) + dr.opaque(mi.Float, 1))
dr.sync_thread()
"""

# A row has "seconds"; compared with another side, it has those of ``ratio_of``, and a "goal" of the ratio.
# "to then": how many times the ratio, or else the seconds, are those of an earlier file
COLUMNS = ("seconds", "other_seconds", "ratio", "low", "high", "goal", "to then")
Row = dict[str, float]


def rows(given: argparse.Namespace) -> Iterator[tuple[str, Row]]:
    """Measure; yield each row with its name."""
    from mrt_mitsuba.validation.studies import speed

    if given.device:
        runtime.use(given.device)
        for width, height in DEVICE_SIZES:
            for pair in speed.against_mitsuba(speed.Extent(width, height, 1, range(5), given.turns, 1)):
                yield f"{pair.name}, {width}x{height}", speed.compare(pair, given.turns)[0]
        return
    yield "mrt out 0 / a bare start of Mitsuba", start(given.turns)
    yield from cases(given)
    for pair in () if given.small else speed.against_mitsuba(speed.FULL):
        yield pair.name, speed.compare(pair, given.turns)[0] | {"goal": pair.goal}


def start(turns: int) -> Row:
    """The seconds of the command against those of a bare start, as after installation."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}

    def python(*arguments: str) -> partial[Any]:
        silent: dict[str, Any] = {"check": True, "stdout": subprocess.DEVNULL, "timeout": 600}
        return partial(subprocess.run, [sys.executable, *arguments], env=environment, **silent)

    with tempfile.TemporaryDirectory() as folder:
        command = python("-m", "mrt_mitsuba.command.main", f"{folder}/out", "0", "quiet=1")
        return ratio(command, python("-c", BARE), repeats=turns) | {"goal": START_GOAL}


def cases(given: argparse.Namespace) -> Iterator[tuple[str, Row]]:
    """Yield the cases of ``renders``, each side in a process of its own, in turns."""
    names = [name for name in renders.CASES if "small" in name or not given.small]

    def measure(python: str, turn: int) -> dict[str, float]:
        command = [python, str(renders.__file__), *names]
        ran = subprocess.run(command, check=True, stdout=subprocess.PIPE, timeout=3600)
        return dict(json.loads(ran.stdout.splitlines()[-1]))

    pythons = [sys.executable, *([given.before] if given.before else [])]
    found = in_turns([partial(measure, python) for python in pythons], given.turns)
    for name in names:
        times = [[run[name] for run in side] for side in found]
        yield name, ratio_of(*times) if given.before else {"seconds": statistics.median(times[0])}


def read(path: Path) -> dict[str, Row]:
    """The rows of an earlier run. Raises ``UsageError`` for any other file."""
    try:
        return dict(json.loads(path.read_text())["rows"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UsageError(f"cannot compare with {path}: it is not a file of this benchmark") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write JSON, and compare."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    add = parser.add_argument
    add("--out", type=Path, default=Path("bench.json"), help="file to write (default: bench.json)")
    add("--compare", type=Path, help="a file of the same options; ratios above 1 are slower than then")
    add("--small", action="store_true", help="the start of the command and small renders alone")
    add("--before", metavar="PYTHON", help="a Python that has an earlier version, to take turns with")
    add("--turns", type=int, default=7, help="how often each side is measured (default: 7)")
    add("--device", metavar="VARIANT", help="against Mitsuba's integrators in a variant, such as cuda_ad_rgb")
    given = parser.parse_args(arguments)
    try:
        before = read(given.compare) if given.compare else {}
        prepare_folder(given.out.parent, given.out.name)
        print(62 * " " + "".join(f"{column:>14}" for column in COLUMNS))
        found = {}
        for name, row in rows(given):
            key = "ratio" if "ratio" in row else "seconds"
            then = before.get(name, {}).get(key)
            found[name] = row | ({"to then": row[key] / then} if then else {})
            cells = (f"{found[name][c]:>14.4g}" if c in found[name] else 14 * " " for c in COLUMNS)
            print(f"{name:<62}{''.join(cells)}".rstrip(), flush=True)
    except UsageError as error:
        parser.error(str(error))
    except MrtError as error:
        print(f"make bench: {error}", file=sys.stderr)
        return error.exit_code
    now = {"machine": machine(), "options": {"device": given.device, "turns": given.turns}, "rows": found}
    with replacing(given.out) as (file,):
        file.write(json.dumps(now, indent=2).encode() + b"\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
