"""``mrt FILENAME [SCENE] [name=value ...]``: render and write the picture."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import time
import warnings
from collections.abc import Iterator
from typing import Any

from mrt_mitsuba.command.options import Options
from mrt_mitsuba.errors import MrtWarning, printable
from mrt_mitsuba.interrupts import held
from mrt_mitsuba.rendering.settings import NOISE
from mrt_mitsuba.scene.model import FOCAL_RANGE, SIZE, is_obj


def run(options: Options) -> int:
    """Render and write what the options say; return the exit code."""
    from mrt_mitsuba.output.replacing import check_target
    from mrt_mitsuba.runtime import check_start

    check_start()
    for path in options.outputs():
        check_target(path, [] if options.scene is None else [options.scene])
    with _loading():
        with held():  # it imports Dr.Jit
            from mrt_mitsuba.rendering.api import render
        from mrt_mitsuba import runtime
        from mrt_mitsuba.rendering.progress import Progress, TerminalProgress

        if options.quiet:
            warnings.simplefilter("ignore", MrtWarning)
        else:
            print(banner(options), flush=True)
        runtime.use(options.variant)
    if options.log != "warn":
        from mrt_mitsuba.command import logs

        logs.show(options.log)
    progress = Progress() if options.quiet else TerminalProgress(show_plan=options.plan == "show")
    start = time.perf_counter()
    scene: Any = options.scene if options.scene is not None else options.scene_number
    if is_obj(scene):
        from mrt_mitsuba.scene.placement import model_scene

        scene = model_scene(scene, **options.model())
        for path in options.outputs():  # at once, not after the render
            check_target(path, scene.files)
    result = render(scene, progress=progress, **options.render_arguments())
    seconds = time.perf_counter() - start
    result.save(*options.outputs(), tonemap=options.tonemap)
    if not options.quiet:
        if result.error is not None:
            print(f"Error: {result.error}, {result.rounds[-1].spp:.1f} rays a pixel")
        print(f"Wrote {printable(' and '.join(options.outputs()))}")
        print(f"Render time: {seconds:.6f}s")
    return 0


@contextlib.contextmanager
def _loading() -> Iterator[None]:
    """Spare the start what it does not need: a tenth of it is a search for garbage among what is loaded to
    stay, and threads for NumPy's linear algebra wait busily for work."""
    if "mitsuba" in sys.modules or not gc.isenabled():
        yield
        return
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def banner(options: Options) -> str:
    """Return the parameters of the render, one per line."""
    focus = options.focus(None, FOCAL_RANGE)
    if options.scene is None:
        from mrt_mitsuba.scene.report import report_scene

        scene = report_scene(options.scene_number)
        focus = options.focus(scene.focal_distance, scene.focal_range)
    own_film = options.scene is not None and not is_obj(options.scene)
    width, height = ("from the file", "from the file") if own_film else SIZE
    aamode = options.aamode or (NOISE if options.rmse else None)
    lines = {
        "Scene": options.scene_number if options.scene is None else printable(options.scene),
        "Width": options.width or width,
        "Height": options.height or height,
        "AA": options.aa or ("as noise needs" if aamode == NOISE else "from the file" if own_film else 4),
        "AA mode": aamode or ("from the file" if own_film else "sobel"),
        "F distance": focus.distance or "off",
        "F range": focus.range if focus.distance else "off",
    }
    return "\n".join(f"{name + ':':<12}{value}" for name, value in lines.items())
