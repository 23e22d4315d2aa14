"""``mrt doctor``: what is installed, which LLVM and why, which variants work, and a tiny render."""

from __future__ import annotations

import platform
import time
from importlib import metadata

import mrt_mitsuba
from mrt_mitsuba import llvm
from mrt_mitsuba.errors import MrtError

PACKAGES = ("mitsuba", "drjit", "numpy", "OpenEXR", "pillow", llvm.WHEEL)


def run() -> int:
    """Print the report line by line; return 0 if the self-test passed, else 1."""
    print(f"mrt-mitsuba {mrt_mitsuba.__version__}, Python {platform.python_version()}, {platform.platform()}")
    for package in PACKAGES:
        try:
            print(f"  {package:<20}{metadata.version(package)}")
        except metadata.PackageNotFoundError:
            print(f"  {package:<20}not installed")
    choice = llvm.prepare()
    print(choice.describe())
    for line in choice.rejected:
        print(f"  passed over: {line}")
    try:
        import mitsuba as mi

        from mrt_mitsuba import runtime

        print(f"variants: {', '.join(runtime.usable_variants())}")
        reasons = {runtime.obstacle(variant): variant.split("_")[0] for variant in mi.variants()}
        for reason, family in reasons.items():
            if reason:
                print(f"  not {family}_*: {reason}")
        print(f"self-test: {self_test()}")
    except (ImportError, MrtError, RuntimeError) as error:
        print(f"self-test: FAILED: {error}")
        return 1
    return 0


def self_test() -> str:
    """Render scene 0 at 16x12; return a line that says how it went; raise ``MrtError`` if it went wrong."""
    import numpy as np

    from mrt_mitsuba.rendering.api import render
    from mrt_mitsuba.runtime import use
    from mrt_mitsuba.scene.report import report_scene

    start = time.perf_counter()
    variant = use()
    image = np.asarray(render(0, width=16, height=12, aa=1, aamode="none").image)
    seconds = time.perf_counter() - start
    if image.shape != (12, 16, 3) or not np.isfinite(image).all():
        raise MrtError(f"the picture has the shape {image.shape} or holds values that are not finite")
    if not np.allclose(image[0], report_scene(0).sky, atol=1e-6):  # exact but for float32
        raise MrtError(f"the top row should show the sky {report_scene(0).sky} but has {image[0, 0]}")
    if np.ptp(image[-1]) < 0.01:  # spheres and plane differ by far more in every channel
        raise MrtError("the bottom row shows nothing but one colour")
    return f"scene 0 at 16x12 in {variant}: passed, {seconds:.2f} s with start-up"
