"""The sub-commands of ``mrt`` that are neither renders nor checks."""

from __future__ import annotations

import contextlib
import platform
import sys
import time
from collections.abc import Iterator, Mapping
from importlib import metadata
from typing import Any

import mrt_mitsuba
from mrt_mitsuba import llvm
from mrt_mitsuba.command.options import checked, render_parser
from mrt_mitsuba.command.registry import COMMANDS, command_parser
from mrt_mitsuba.errors import MrtError, SceneError, UsageError, printable, reason
from mrt_mitsuba.files.images import read_channels
from mrt_mitsuba.files.replacing import check_target
from mrt_mitsuba.options import check, integer
from mrt_mitsuba.scene.files import require_file
from mrt_mitsuba.scene.report import NUMBERS, report_scene

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# ------------------------------------------- What only prints ------------------------------------------


def usage() -> str:
    """Return the help text of the command."""
    rows = "".join(f"  {name:<15} {command.text}\n" for name, command in COMMANDS.items())
    return f"{render_parser().format_help()}\ncommands ('mrt COMMAND --help' says more):\n{rows}"


def show_help(command: str | None = None) -> int:
    """Print the help text of ``mrt``, or of a sub-command."""
    if command is not None and command not in COMMANDS:
        raise UsageError(f"no command {command!r}: choose one of {', '.join(COMMANDS)}")
    sys.stdout.write(command_parser(command).format_help() if command else usage())
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
    for package in ("mitsuba", "drjit", "numpy", "OpenEXR", "pillow", llvm.WHEEL):
        with contextlib.suppress(metadata.PackageNotFoundError):  # the wheel of LLVM may be missing
            print(f"  {package:<20}{metadata.version(package)}")
    choice = llvm.prepare()
    print(choice.describe())
    start = time.perf_counter()
    try:
        import numpy as np

        from mrt_mitsuba import runtime
        from mrt_mitsuba.rendering.api import render

        print(f"variants: {', '.join(runtime.usable_variants())}")
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


def info(file: str) -> int:
    """Print size, channels and header of an EXR."""
    planes, headers = read_channels(file)
    channel, plane = next(iter(planes.items()))
    print(f"{printable(file)}: {plane.shape[1]}x{plane.shape[0]} pixels, {len(planes)} channels")
    print(f"channels: {printable(', '.join(planes))}")
    for name, value in headers[channel].items():
        if name != "channels":
            value = [part.tolist() for part in value] if isinstance(value, tuple) else value
            print(f"  {printable(name):<20} {printable(str(value))}")
    return 0


# ------------------------------------------- What writes files -----------------------------------------


def export(scene: int | str, xml: str, stock: bool = False, **given: Any) -> int:
    """Write a scene as XML."""
    options = checked("export", {"scene": scene, **given})
    if options.error:
        raise UsageError("target is an error here, and a file holds none: give the point to look at, X,Y,Z")
    kept = {name: getattr(options, name) for name in ("width", "height", "fresnel", "params")}
    kept |= options.model()
    from mrt_mitsuba.scene.export import write_xml

    check_target(xml, options.inputs())
    paths = write_xml(options.scene, xml, flavor="stock" if stock else "mrt", **kept)
    print(f"Wrote {' and '.join(paths)}")
    return 0


def sweep(out: str, file: str, *, workers: str | None = None, **given: Any) -> int:
    """Render the sweep that a TOML file describes; return 1 if a job failed."""
    settings = read_toml(file)
    refused = settings.keys() & {"out", "progress"}
    if refused:
        raise UsageError(f"{file}: {min(refused)} cannot be set in a file")
    if workers is not None:
        settings["workers"] = check("workers", integer(1, 65535), workers, text=True)
    settings |= given
    grid = dict(_axes(settings.pop("grid", {})))
    scene = settings.pop("scene", None if "scene" in grid else 0)
    table = mrt_mitsuba.sweep(scene, out, grid=grid, **settings)
    print(table)
    for row in table.failed:
        print(f"failed: {', '.join(f'{key}={row[key]}' for key in table.keys)}: {row['error']}")
    return 1 if table.failed else 0


def _axes(grid: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the axes of a grid; keys with a dot that have no quotes are nested tables in TOML."""
    if not isinstance(grid, Mapping):
        raise UsageError("grid must be a table: write [grid] and a line for each key")
    for key, values in grid.items():
        if isinstance(values, Mapping):
            yield from _axes(values, f"{before}{key}.")
        else:
            yield before + key, values


def read_toml(path: str) -> dict[str, Any]:
    """Return the tables of a TOML file; raise ``UsageError`` if it cannot be read."""
    try:
        require_file(path)
        with open(path, "rb") as file:
            return tomllib.load(file)
    except (SceneError, OSError, ValueError) as error:
        text = reason(error).removeprefix(f"cannot read {path}: ")
        raise UsageError(f"cannot read {path}: {text}") from error
