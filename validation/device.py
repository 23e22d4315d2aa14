"""Check a GPU: compare pictures with another variant's, and run the device tests in processes of their own.

``make device-check`` runs it in ``cuda_ad_rgb`` against ``llvm_ad_rgb``. Where pictures differ, it names the
worst pixel and the first layer that differs there.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime

SIZE = {"width": 160, "height": 120}
SMALL = {"width": 24, "height": 18}  # in scalar variants, which trace one ray at a time
SECONDS = 300  # after which nothing more is started
ROUNDING = 2e-4  # relative, of float32 values computed in another order of operations
TURNED = 0.01  # fraction of pixels that may differ by more: a rounding decides at edges and shadow borders
MEAN = 1e-4  # mean difference of pictures, in linear values
LAYERS = ("depth", "normal", "albedo", "direct", "reflection", "bounces")  # in the order of their making
BOX = "cornell"


def picture(name: str, variant: str, size: dict[str, int]) -> mrt.Result:
    """Render a numbered scene by the report's lattice with its layers, or Mitsuba's Cornell box."""
    runtime.use(variant)
    options: dict[str, Any] = {**size, "aamode": "none", "variant": variant}
    if name == BOX:
        return mrt.render(mi.cornell_box(), aa=1, spp=16, **options)
    return mrt.render(int(name), aa=4, focaldist=0, layers=LAYERS, **options)


def relative(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return differences over 1 + the largest value of a pixel, [H, W]."""
    one, other = (np.nan_to_num(np.atleast_3d(values), posinf=1e6) for values in (one, other))
    return np.abs(one - other).max(-1) / (1 + np.abs(other).max(-1))


def first_layer(one: mrt.Result, other: mrt.Result, pixel: tuple[int, int]) -> str:
    """Return the first layer that differs in a pixel, given as row and column, and its values."""
    for name in sorted(one.layers, key=lambda name: LAYERS.index(name.partition(".")[0])):
        values = one.layers[name], other.layers[name]
        if relative(*values)[pixel] > ROUNDING:
            return f"{name} is {values[0][pixel]} against {values[1][pixel]}"
    return "no layer differs: look at how samples are summed"


def compare_pictures(variants: Sequence[str], names: Sequence[str], deadline: float) -> Iterator[bool]:
    """Print a line for each scene; yield True for each that agrees."""
    size = SMALL if any(variant.startswith("scalar") for variant in variants) else SIZE
    for name in names:
        if time.monotonic() > deadline:
            print(f"scene {name}: not compared, {SECONDS} s are over", flush=True)
            continue
        one, other = (picture(name, variant, size) for variant in variants)
        off = relative(one.image, other.image)
        turned = float((off > ROUNDING).mean())
        mean = float(np.abs(one.image - other.image).mean())
        agrees = mean <= MEAN and turned <= TURNED
        found = (
            f"mean difference {mean:.2e}, {turned:.2%} of pixels above {ROUNDING:g}, largest {off.max():.2e}"
        )
        print(f"scene {name}: {found}: {'same' if agrees else 'DIFFERS'}", flush=True)
        if not agrees:
            row, column = divmod(int(off.argmax()), off.shape[1])
            where = f"row {row}, column {column}: {one.image[row, column]} against {other.image[row, column]}"
            print(f"  worst pixel: {where}; {first_layer(one, other, (row, column))}", flush=True)
        yield agrees


def run_tests(device: str, files: Sequence[str], deadline: float) -> Iterator[bool]:
    """Run files of device tests, each in its process; print a line and yield whether it passed."""
    environment = os.environ | {"MRT_DEVICE": device}
    marked = "device and not package and not slow"
    for file in files:
        left = deadline - time.monotonic()
        if left <= 0:
            print(f"{file}: not run, {SECONDS} s are over", flush=True)
            continue
        command = [sys.executable, "-m", "pytest", "-q", "--no-header", "-m", marked, file]
        try:
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=left)
        except subprocess.TimeoutExpired:
            print(f"{file}: ended at the time limit", flush=True)
            yield False
            continue
        if done.returncode == 5:  # no device tests
            continue
        ending = (done.stdout.strip().splitlines() or [""])[-1]
        if done.returncode < 0:  # by a signal; pytest has written where
            tests = re.findall(r"in (test_\w+)$", done.stderr, re.MULTILINE) or ["no test"]
            ending = f"CRASHED with {signal.Signals(-done.returncode).name} in {tests[0]}"
        print(f"{file}: {ending}", flush=True)
        yield done.returncode == 0


def main() -> int:
    """Run the check; return the exit code: 1 if a picture differs or a test fails."""
    parser = argparse.ArgumentParser(prog="make device-check", description=__doc__)
    parser.add_argument("--variant", default="cuda_ad_rgb", help="variant to check")
    parser.add_argument("--reference", default="llvm_ad_rgb", help="variant to compare it with")
    parser.add_argument("--scenes", nargs="*", default=[*map(str, range(10)), BOX])
    parser.add_argument(
        "--tests", nargs="*", default=[str(p) for p in sorted(Path("tests").rglob("test_*.py"))]
    )
    options = parser.parse_args()
    variants = options.variant, options.reference
    for variant in variants:
        if problem := runtime.obstacle(variant):
            print(f"device-check: {variant} cannot run here: {problem}", file=sys.stderr)
            return 1
    deadline = time.monotonic() + SECONDS
    results = [*compare_pictures(variants, options.scenes, deadline)]
    results += run_tests(options.variant.partition("_")[0], options.tests, deadline)
    print(f"{sum(results)} of {len(results)} hold")
    return int(not all(results))


if __name__ == "__main__":
    sys.exit(main())
