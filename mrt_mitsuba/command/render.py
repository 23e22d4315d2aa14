"""``mrt FILENAME [SCENE] [name=value ...]``: render and write the picture."""

from __future__ import annotations

import gc
import os
import sys
import time
import warnings

from mrt_mitsuba.command.options import Options
from mrt_mitsuba.command.registry import import_plugins
from mrt_mitsuba.errors import MrtWarning, printable
from mrt_mitsuba.files.replacing import check_target
from mrt_mitsuba.interrupts import defer_signals
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress


def run(options: Options) -> int:
    """Render a scene and write its picture; return the exit code."""
    for path in options.outputs():
        check_target(path, options.inputs())
    # A tenth of the start is a search for garbage among what is loaded to stay, and threads for NumPy's
    # linear algebra wait busily for work
    spared = "mitsuba" not in sys.modules and gc.isenabled()
    if spared:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        gc.disable()
    if options.quiet:
        warnings.simplefilter("ignore", MrtWarning)
    with defer_signals():
        from mrt_mitsuba import runtime

        runtime.use(options.variant)
        import_plugins(options.plugins)
        from mrt_mitsuba.rendering.api import render
    if spared:
        gc.freeze()
        gc.enable()
    progress = Progress() if options.quiet else TerminalProgress(show_plan=options.plan == "show")
    start = time.perf_counter()
    result = render(options.scene, progress=progress, **options.render_arguments())
    seconds = time.perf_counter() - start
    result.save(*options.outputs(), tonemap=options.tonemap, compression=options.compression)
    if not options.quiet:
        if result.error is not None:
            target = result.error.target
            aim = "" if target is None else f"; target {target:.3g}"
            print(f"Error: {result.error}, {result.rounds[-1].spp:.1f} spp{aim}")
        print(f"Wrote {printable(' and '.join(options.outputs()))}")
        print(f"Render time: {seconds:.6f}s")
    return 0
