"""Check a GPU: compare pictures with another variant's, and run the device tests in processes of their own.

``make device-check`` runs it in ``cuda_ad_rgb`` against ``llvm_ad_rgb``. Where pictures differ, it names the
worst pixel and follows its samples ray by ray, both variants from the same ray, to the first value that
differs.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime

SIZE = (160, 120)  # width and height
SMALL = (24, 18)  # in scalar variants, which trace one ray at a time
AA = 4
SECONDS = 300  # after which nothing more is started
ROUNDING = 2e-4  # relative, of float32 values computed in another order of operations
TURNED = 0.01  # fraction of pixels that may differ by more: a rounding decides at edges and shadow borders
MEAN = 1e-4  # mean difference of pictures, in linear values
BOUNCES = 10
Values = dict[str, np.ndarray]


def scene_dict(name: str, size: tuple[int, int]) -> dict[str, Any]:
    """Return a numbered scene, or Mitsuba's Cornell box, as a dict."""
    if name != "cornell":
        return mrt.scene_dict(int(name), width=size[0], height=size[1])
    nodes = mi.cornell_box()
    nodes["sensor"]["film"].update(width=size[1], height=size[1], rfilter={"type": "box"})
    return nodes


def picture(name: str, variant: str, size: tuple[int, int]) -> np.ndarray:
    """Render a scene in a variant, [H, W, 3]: the numbered ones by the report's lattice."""
    runtime.use(variant)
    if name == "cornell":
        return mrt.render(scene_dict(name, size), aamode="none", aa=1, spp=16).image
    options: dict[str, Any] = {
        "width": size[0],
        "height": size[1],
        "aa": AA,
        "aamode": "none",
        "focaldist": 0,
    }
    return mrt.render(int(name), **options).image


def relative(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return differences over 1 + the largest value of a pixel, [H, W]."""
    return np.abs(one - other).max(-1) / (1 + np.abs(other).max(-1))


def camera_ray(scene: mi.Scene, x: float, y: float) -> Values:
    """Return the ray through a position in pixels, y downwards."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().size()
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(x / width, y / height), mi.Point2f(0.5))
    return as_arrays({"ray origin": ray.o, "ray direction": ray.d})


def at_ray(scene: mi.Scene, start: Values) -> Values:
    """Return what a ray brings and, where it hits, what it meets and the mirror ray from there."""
    origin, direction = (start[name].tolist() for name in ("ray origin", "ray direction"))
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
    hit = scene.ray_intersect(ray)
    found: dict[str, Any] = {}
    if np.ravel(hit.is_valid())[0]:
        mirrored = hit.to_world(mi.reflect(hit.wi))
        found = {"hit distance": hit.t, "hit position": hit.p, "geometric normal": hit.n}
        found |= {"shading normal": hit.sh_frame.n, "ray direction": mirrored}
        found["ray origin"] = hit.spawn_ray(mirrored).o
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    radiance = scene.integrator().sample(scene, sampler, mi.RayDifferential3f(ray))[0]
    return as_arrays(found | {"radiance": mi.unpolarized_spectrum(radiance)})


def as_arrays(values: dict[str, Any]) -> Values:
    return {name: np.array(value, np.float64).ravel() for name, value in values.items()}


def difference(one: Values, other: Values) -> str:
    """Return the first value that differs, in words, or ""."""
    if one.keys() != other.keys():
        return "a hit in one variant only"
    for name, value in other.items():
        if not relative(one[name], value) <= ROUNDING:
            return f"{name} {one[name]} against {value}"
    return ""


def first_difference(
    name: str, pixel: tuple[int, int], variants: tuple[str, str], size: tuple[int, int]
) -> str:
    """Follow the samples of a pixel, given as row and column, to the first value that differs.

    Each ray is that of the second variant, so that a difference is made where it is found.
    """
    scenes = []
    for variant in variants:
        runtime.use(variant)
        scenes.append(mi.load_dict(scene_dict(name, size)))

    def in_both(measure: Any, *arguments: Any) -> list[Values]:
        sides = []
        for variant, scene in zip(variants, scenes, strict=True):
            runtime.use(variant)
            sides.append(measure(scene, *arguments))
        return sides

    row, column = pixel
    for number in range(AA * AA):
        down, right = divmod(number, AA)
        sides = in_both(camera_ray, column + 0.5 + right / AA, row + 0.5 - down / AA)
        found = difference(*sides)
        if found:
            return f"sample {number}: {found}"
        for bounce in range(BOUNCES):
            ray = sides[1]
            sides = in_both(at_ray, ray)
            found = difference(*sides)
            if found:
                way = f"{ray['ray origin']} → {ray['ray direction']}"
                return f"sample {number}, bounce {bounce}, ray {way}: {found}"
            if "ray origin" not in sides[1]:
                break
    return "no value of a single ray differs: look at how samples are summed, or at the rays' order"


def compare_pictures(variants: tuple[str, str], names: list[str], deadline: float) -> Iterator[bool]:
    """Print a line for each scene; yield True for each that agrees."""
    size = SMALL if any(variant.startswith("scalar") for variant in variants) else SIZE
    for name in names:
        if time.monotonic() > deadline:
            print(f"scene {name}: not compared, {SECONDS} s are over", flush=True)
            continue
        one, other = (picture(name, variant, size) for variant in variants)
        off = relative(one, other)
        turned = float((off > ROUNDING).mean())
        mean = float(np.abs(one - other).mean())
        agrees = mean <= MEAN and turned <= TURNED
        print(
            f"scene {name}: mean difference {mean:.2e}, {turned:.2%} of pixels above {ROUNDING:g}, largest "
            f"{off.max():.2e}: {'same' if agrees else 'DIFFERS'}",
            flush=True,
        )
        if not agrees:
            worst = np.unravel_index(int(off.argmax()), off.shape)
            row, column = int(worst[0]), int(worst[1])
            print(
                f"  worst pixel: row {row}, column {column}: {one[row, column]} against {other[row, column]}"
            )
            if name != "cornell":
                print(f"  {first_difference(name, (row, column), variants, size)}", flush=True)
        yield agrees


def run_tests(device: str, tests: list[str], deadline: float) -> Iterator[bool]:
    """Run files of device tests, each in its process, and those of a file that crashed one by one.

    Print a line for each; yield True for each that passed.
    """
    environment = os.environ | {"MRT_DEVICE": device}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-m",
        "device and not package and not slow",
        "--no-header",
    ]
    for test in tests:
        left = deadline - time.monotonic()
        if left <= 0:
            print(f"{test}: not run, {SECONDS} s are over", flush=True)
            continue
        try:
            done = subprocess.run(
                [*command, test], env=environment, capture_output=True, text=True, timeout=left
            )
        except subprocess.TimeoutExpired:
            print(f"{test}: ended at the time limit", flush=True)
            yield False
            continue
        crashed = done.returncode < 0
        if done.returncode == 5:  # no device tests
            continue
        said = done.stdout.strip().splitlines()
        ending = signal.Signals(-done.returncode).name if crashed else (said or [""])[-1]
        print(f"{test}: {'CRASHED with ' if crashed else ''}{ending}", flush=True)
        if crashed and "::" not in test:
            listed = subprocess.run(
                [*command, "--collect-only", test],
                env=environment,
                capture_output=True,
                text=True,
                timeout=60,
            )
            each = [
                f"{test}::{line.split('::', 1)[1]}" for line in listed.stdout.splitlines() if "::" in line
            ]
            yield from run_tests(device, each, deadline)
        yield done.returncode == 0


def main() -> int:
    """Run the check; return the exit code: 1 if a picture differs or a test fails."""
    parser = argparse.ArgumentParser(prog="make device-check", description=__doc__)
    parser.add_argument("--variant", default="cuda_ad_rgb", help="variant to check")
    parser.add_argument("--reference", default="llvm_ad_rgb", help="variant to compare it with")
    parser.add_argument("--scenes", nargs="*", default=[*map(str, range(10)), "cornell"])
    parser.add_argument("--tests", nargs="*", help="test files; none: all of tests/")
    options = parser.parse_args()
    for variant in (options.variant, options.reference):
        problem = runtime.obstacle(variant)
        if problem:
            print(f"device-check: {variant} cannot run here: {problem}", file=sys.stderr)
            return 1
    deadline = time.monotonic() + SECONDS
    files = [str(file) for file in sorted(Path("tests").rglob("test_*.py"))]
    tests = files if options.tests is None else options.tests
    results = list(compare_pictures((options.variant, options.reference), options.scenes, deadline))
    results += run_tests(options.variant.partition("_")[0], tests, deadline)
    print(f"{sum(results)} of {len(results)} hold")
    return int(not all(results))


if __name__ == "__main__":
    sys.exit(main())
