"""The sub-commands of ``mrt`` that are neither renders nor checks."""

from __future__ import annotations

import platform
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping
from importlib import metadata
from typing import Any

import mrt_mitsuba
from mrt_mitsuba import llvm
from mrt_mitsuba.command.options import TABLE, parse
from mrt_mitsuba.command.registry import COMMANDS
from mrt_mitsuba.errors import MrtError, SceneError, UsageError
from mrt_mitsuba.files.replacing import check_target
from mrt_mitsuba.scene.files import require_file
from mrt_mitsuba.scene.report import NUMBERS, report_scene

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

WIDTH = 100  # characters of a line of help
_COLUMN = 30  # where explanations start

# ------------------------------------------- What only prints ------------------------------------------


def usage() -> str:
    """The help text of the command."""
    options = {
        f"{name}={field.metadata['kind'].form}": f"{field.metadata['help']} "
        f"(default: {field.metadata['shown'] or field.default})"
        for name, field in TABLE.items()
    }
    commands = {f"{name} {form}".strip(): text for name, (form, text, _, _) in COMMANDS.items()}
    lines = [
        "usage: mrt FILENAME [SCENE] [name=value ...]",
        f"       mrt {' | '.join(COMMANDS)} ...",
        "",
        "Renders a scene and writes FILENAME.png and FILENAME.exr.",
        f"FILENAME has no extension; SCENE is {NUMBERS[0]} to {NUMBERS[-1]} (default: 0).",
    ]
    for title, entries in (("options", options), ("commands", commands)):
        lines += ["", f"{title}:"]
        for form, text in entries.items():
            if len(form) > _COLUMN - 3:
                lines.append(f"  {form}")
                form = ""
            entry = f"{form:<{_COLUMN - 3}} {text}"
            lines += textwrap.wrap(entry, WIDTH, initial_indent="  ", subsequent_indent=" " * _COLUMN)
    return "\n".join(lines) + "\n"


def show_help() -> int:
    """Print the help text."""
    sys.stdout.write(usage())
    return 0


def show_version() -> int:
    """Print the version of the package."""
    print(f"mrt-mitsuba {mrt_mitsuba.__version__}")
    return 0


def show_scenes() -> int:
    """Print number and title of every scene."""
    print("\n".join(f"{number}  {report_scene(number).title}" for number in NUMBERS))
    return 0


def doctor() -> int:
    """Print what is installed, which LLVM and why, which variants work, and the result of a tiny render.

    Return 0 if that passed, else 1.
    """
    print(f"mrt-mitsuba {mrt_mitsuba.__version__}, Python {platform.python_version()}, {platform.platform()}")
    installed = {each.metadata["Name"].lower(): each.version for each in metadata.distributions()}
    for package in ("mitsuba", "drjit", "numpy", "OpenEXR", "pillow", llvm.WHEEL):
        print(f"  {package:<20}{installed.get(package.lower(), 'not installed')}")
    choice = llvm.prepare()
    print("\n  passed over: ".join([choice.describe(), *choice.rejected]))
    start = time.perf_counter()
    try:
        import mitsuba as mi
        import numpy as np

        from mrt_mitsuba import runtime
        from mrt_mitsuba.rendering.api import render

        print(f"variants: {', '.join(runtime.usable_variants())}")
        reasons = {runtime.obstacle(variant): variant.split("_")[0] for variant in mi.variants()}
        reasons.pop(None, None)  # of those that work
        print("".join(f"  not {family}_*: {reason}\n" for reason, family in reasons.items()), end="")
        variant = runtime.use()
        image = np.asarray(render(0, width=16, height=12, aa=1, aamode="none").image)
        # the sky, exact to float32, above spheres and a plane, which differ in every channel
        if not (np.allclose(image[0], report_scene(0).sky, atol=1e-6) and np.ptp(image[-1]) > 0.01):
            raise MrtError(f"scene 0 has {image[0, 0]} at the top, {image[-1, 0]} to {image[-1, -1]} below")
    except (ImportError, MrtError, RuntimeError) as error:
        print(f"self-test: FAILED: {error}")
        return 1
    seconds = time.perf_counter() - start
    print(f"self-test: scene 0 at 16x12 in {variant}: passed, {seconds:.2f} s with start-up")
    return 0


# ------------------------------------------- What writes files -----------------------------------------


def export(place: str, /, *, xml: str, stock: str = "", **given: str) -> int:
    """Write a scene, a number or the path of a file, as XML."""
    scene_word = place if place.isdecimal() else f"scene={place}"
    options = parse(["export", scene_word, *(f"{name}={text}" for name, text in given.items())])
    kept = {name: getattr(options, name) for name in ("width", "height", "fresnel", "params")}
    kept |= options.model()
    strange = given.keys() - kept.keys() - (options.params or {}).keys()
    if strange:  # about the render, which is not in the file
        raise UsageError(
            f"{min(strange)} is of no use to mrt export. Usage: mrt export {COMMANDS['export'].form}"
        )
    from mrt_mitsuba.scene.export import write_xml

    check_target(xml, options.inputs())
    paths = write_xml(options.scene, xml, flavor="stock" if stock else "mrt", **kept)
    print(f"Wrote {' and '.join(paths)}")
    return 0


def sweep(out: str, path: str, *, workers: str | None = None, cluster: str | None = None) -> int:
    """Render the sweep that a TOML file describes; return 1 if a job failed."""
    settings = read_toml(path)
    refused = settings.keys() & {"out", "progress"}
    if refused:
        raise UsageError(f"{path}: {min(refused)} cannot be set in a file")
    count = int(workers) if workers and workers.isdecimal() else workers
    if count is not None:
        settings["workers"] = count
    if cluster is not None:
        settings["cluster"] = cluster
    grid = dict(_axes(settings.pop("grid", {})))
    scene = settings.pop("scene", None if "scene" in grid else 0)
    table = mrt_mitsuba.sweep(scene, out, grid=grid, **settings)
    print(table)
    for row in table.failed:
        print(f"failed: {', '.join(f'{key}={row[key]}' for key in table.keys)}: {row['error']}")
    return 1 if table.failed else 0


def _axes(grid: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """The axes of a grid; keys with a dot that have no quotes make tables in TOML."""
    if not isinstance(grid, Mapping):
        raise UsageError("grid must be a table: write [grid] and a line for each key")
    for key, values in grid.items():
        if isinstance(values, Mapping):
            yield from _axes(values, f"{before}{key}.")
        else:
            yield before + key, values


def read_toml(path: str) -> dict[str, Any]:
    """The tables of a TOML file; ``UsageError`` where it cannot be read."""
    try:
        require_file(path)
        with open(path, "rb") as file:
            return tomllib.load(file)
    except (SceneError, OSError, ValueError) as error:
        text = str(getattr(error, "strerror", None) or error).removeprefix(f"cannot read {path}: ")
        raise UsageError(f"cannot read {path}: {text}") from error
