"""Check a GPU: compare pictures with another variant's, and run the device tests in processes of their own.

``make device-check`` runs it in ``cuda_ad_rgb`` against ``llvm_ad_rgb``. Where pictures differ, it names the
worst pixel and follows its samples ray by ray, both variants from the same ray, to the first value that
differs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime

SIZE = {"width": 160, "height": 120}
SMALL = {"width": 24, "height": 18}  # in scalar variants, which trace one ray at a time
SECONDS = 300  # after which no more tests are started
ROUNDING = 2e-4  # relative, of float32 values computed in another order of operations
TURNED = 0.01  # fraction of pixels that may differ by more: a rounding decides at edges and shadow borders
MEAN = 1e-4  # mean difference of pictures, in linear values
AA = 4
BOUNCES = 10
BOX = "cornell"
Values = dict[str, np.ndarray]


def scene_dict(name: str, size: dict[str, Any]) -> dict[str, Any]:
    """Return a numbered scene as a dict."""
    return mrt.scene_dict(int(name), **size)


def picture(name: str, variant: str, size: dict[str, Any]) -> np.ndarray:
    """Render a numbered scene by the report's lattice, or Mitsuba's Cornell box, [H, W, 3]."""
    options: dict[str, Any] = {**size, "aamode": "none", "variant": variant}
    if name == BOX:
        runtime.use(variant)
        return mrt.render(mi.cornell_box(), aa=1, spp=16, **options).image
    return mrt.render(int(name), aa=AA, focaldist=0, **options).image


def relative(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return differences over 1 + the largest value of a pixel, [H, W]."""
    return np.abs(one - other).max(-1) / (1 + np.abs(other).max(-1))


def camera_ray(scene: mi.Scene, x: float, y: float) -> dict[str, Any]:
    """Return the ray through a place on the film, from 0 to 1."""
    ray, _ = scene.sensors()[0].sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(x, y), mi.Point2f(0.5))
    return {"origin": ray.o, "direction": ray.d}


def at_ray(scene: mi.Scene, origin: Sequence[float], direction: Sequence[float]) -> dict[str, Any]:
    """Return what a ray brings and, where it hits, what it meets and the mirror ray from there."""
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    hit = scene.ray_intersect(ray)
    radiance = scene.integrator().sample(scene, sampler, mi.RayDifferential3f(ray))[0]
    found = {"radiance": mi.unpolarized_spectrum(radiance)}
    if not np.ravel(hit.is_valid())[0]:
        return found
    mirrored = hit.to_world(mi.reflect(hit.wi))
    place = {"hit distance": hit.t, "geometric normal": hit.n, "shading normal": hit.sh_frame.n}
    return {**place, "direction": mirrored, "origin": hit.spawn_ray(mirrored).o, **found}


def first_difference(name: str, pixel: Sequence[int], variants: Sequence[str], size: dict[str, Any]) -> str:
    """Follow the samples of a pixel, given as row and column, to the first value that differs.

    Each ray is that of the second variant, so that a difference is made where it is found.
    """
    scenes = {}
    for variant in variants:
        runtime.use(variant)
        scenes[variant] = mi.load_dict(scene_dict(name, size))

    def in_both(measure: Callable[..., dict[str, Any]], *arguments: Any) -> list[Values]:
        sides = []
        for variant, scene in scenes.items():
            runtime.use(variant)
            found = measure(scene, *arguments)
            sides.append({key: np.array(value, np.float64).ravel() for key, value in found.items()})
        return sides

    row, column = pixel
    for number in range(AA * AA):
        down, right = divmod(number, AA)
        x = (column + 0.5 + right / AA) / size["width"]
        y = (row + 0.5 - down / AA) / size["height"]
        way = f"sample {number}, from the camera"
        one, other = in_both(camera_ray, x, y)
        for bounce in range(BOUNCES):
            if one.keys() != other.keys():
                return f"{way}: a hit in one variant only"
            for key, value in other.items():
                if not relative(one[key], value) <= ROUNDING:
                    return f"{way}: {key} {one[key]} against {value}"
            if "origin" not in other:
                break
            ray = [other[key].tolist() for key in ("origin", "direction")]
            way = f"sample {number}, bounce {bounce}, ray {ray[0]} → {ray[1]}"
            one, other = in_both(at_ray, *ray)
    return "no value of a single ray differs: look at how samples are summed, or at the rays' order"


def compare_pictures(variants: Sequence[str], names: Sequence[str]) -> Iterator[bool]:
    """Print a line for each scene; yield True for each that agrees."""
    size = SMALL if any(variant.startswith("scalar") for variant in variants) else SIZE
    for name in names:
        one, other = (picture(name, variant, size) for variant in variants)
        off = relative(one, other)
        turned = float((off > ROUNDING).mean())
        mean = float(np.abs(one - other).mean())
        agrees = mean <= MEAN and turned <= TURNED
        found = (
            f"mean difference {mean:.2e}, {turned:.2%} of pixels above {ROUNDING:g}, largest {off.max():.2e}"
        )
        print(f"scene {name}: {found}: {'same' if agrees else 'DIFFERS'}", flush=True)
        if not agrees:
            row, column = divmod(int(off.argmax()), off.shape[1])
            print(
                f"  worst pixel: row {row}, column {column}: {one[row, column]} against {other[row, column]}"
            )
            if name != BOX:
                print(f"  {first_difference(name, (row, column), variants, size)}", flush=True)
        yield agrees


def run_tests(device: str, tests: Sequence[str], deadline: float) -> Iterator[bool]:
    """Run files of device tests, each in a process whose crash costs the test that crashed it.

    Print a line for each file and for each test that fails; yield whether all of a file passed.
    """
    marked = "device and not package and not slow"
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", "-m", marked]
    run = partial(subprocess.run, env=os.environ | {"MRT_DEVICE": device}, capture_output=True, text=True)
    for test in tests:
        left = deadline - time.monotonic()
        if left <= 0:
            print(f"{test}: not run, {SECONDS} s are over", flush=True)
            continue
        try:
            done = run([*command, test], timeout=left)
        except subprocess.TimeoutExpired:
            print(f"{test}: ended at the time limit", flush=True)
            yield False
            continue
        if done.returncode == 5:  # no device tests
            continue
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        ending = done.stdout.strip().rpartition("\n")[2]
        print(f"{test}: {ending}", *failed, sep="\n  ", flush=True)
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
    results = [*compare_pictures(variants, options.scenes)]
    results += run_tests(options.variant.partition("_")[0], options.tests, deadline)
    print(f"{sum(results)} of {len(results)} hold")
    return int(not all(results))


if __name__ == "__main__":
    sys.exit(main())
