"""The ``mrt-validate`` command: run studies, show their bounds, write the report."""

from __future__ import annotations

import argparse
import gc
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from mrt_mitsuba import __version__
from mrt_mitsuba.errors import MrtError, needs_extra
from mrt_mitsuba.rendering.progress import TerminalProgress

if TYPE_CHECKING:
    from mrt_mitsuba.validation.study import Study

# By name, which is that of a module: what --list says of it; how long a quick and a full run take, about, on
# two idle cores
STUDIES = {
    "roughconductor": ("is the material the function that Mitsuba's is", "10 s", "90 s"),
    "stock": ("are light, gloss and mirrors what Mitsuba computes", "15 s", "60 s"),
    "scenes": ("are the report's scenes right, with a reason for each pixel off", "10 s", "60 s"),
    "adaptive": ("what does an error cost next to the best sampler", "90 s", "25 min"),
    "stability": ("where must float32 give out, and where does it not", "16 s", "2 min"),
    "error-vs-time": ("what does each setting buy for its time", "9 s", "20 min"),
    "needs": ("what do scenes not need, and what would it cost", "9 s", "60 s"),
}
EXTRAS = ("matplotlib", "jinja2", "scipy", "mpmath", "flip_evaluator")
INTERRUPTED = 128 + signal.SIGINT


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 1 where a bound is missed or a study fails, 130 interrupted.

    Wrong usage ends the process with 2, as argparse does it.
    """
    parser = argparse.ArgumentParser(
        prog="mrt-validate",
        description="Compare the renderer with Mitsuba, with exact numbers and with itself.",
        epilog=f"studies:\n{listing()}\n\n"
        "Exit code: 0 if every bound holds, 1 if one is missed or a study fails, 2 for wrong usage.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("study", nargs="+", choices=[*STUDIES, "all"], metavar="STUDY", help="one or more, or all")
    add("--version", action="version", version=f"mrt-validate {__version__}")
    add("--list", action="version", version=listing(), help="list the studies and stop")
    add("--quick", action="store_true", help="fewer samples and cases")
    add("--ablate", action="store_true", help="adaptive: what each of its stages brings")
    about = "folder of the report, made if need be (default: validation-report)"
    add("--out", type=Path, default=Path("validation-report"), metavar="DIR", help=about)
    options = parser.parse_args(arguments)
    names = [name for name in STUDIES if name in options.study or "all" in options.study]
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *more, **_: _say(f"warning: {message}")
        try:
            return int(not run_studies(names, options.out, quick=options.quick, ablate=options.ablate))
        except MrtError as error:
            _say(error)
            return error.exit_code
        except KeyboardInterrupt:
            _say("interrupted; no report was written")
            return INTERRUPTED


def run_studies(names: Sequence[str], out: Path, *, quick: bool, ablate: bool = False) -> bool:
    """Run studies in the default variant, print each and write the report; return whether all passed.

    What a study raises becomes its failure. Raises ``MrtError``.
    """
    with needs_extra():
        for name in EXTRAS:
            import_module(name)
    # Not before: NumPy needs a working folder under some Pythons
    from mrt_mitsuba.validation.page import prepare_folder, save_report
    from mrt_mitsuba.validation.study import Study

    prepare_folder(out)
    studies = []
    for name in names:
        study = Study(name, name, TerminalProgress(unit="step"))
        run_study(study, quick=quick, ablate=ablate)
        print(study, flush=True)
        studies.append(study)
    save_report(out, *studies, quick=quick)
    print(f"\nReport: {out / 'index.html'}")
    return all(study.passed for study in studies)


def run_study(study: Study, *, quick: bool, ablate: bool = False) -> None:
    """Run a study, with its title, failure and seconds."""
    import drjit as dr

    from mrt_mitsuba import runtime

    start = time.perf_counter()
    try:
        runtime.use(runtime.default_variant())
        name = "ablation" if ablate and study.name == "adaptive" else study.name.replace("-", "_")
        module = import_module(f"mrt_mitsuba.validation.studies.{name}")
        study.title = module.TITLE
        took = STUDIES[study.name][1 if quick else 2]
        print(f"{study.name}: {study.title}: about {took} ...", file=sys.stderr, flush=True)
        module.run(study, quick=quick)
    except Exception:
        study.failure = traceback.format_exc(limit=-4)
    study.seconds = time.perf_counter() - start
    gc.collect()  # scenes that live on, and memory kept for reuse, slow down the next study
    dr.flush_malloc_cache()


def listing() -> str:
    """Return a line on each study, with how long it takes on two idle cores."""
    lines = [f"  {'':<15}{'quick':>7}{'full':>8}"]
    for name, (about, quick, full) in STUDIES.items():
        lines.append(f"  {name:<15}{quick:>7}{full:>8}  {about}")
    return "\n".join(lines)


def _say(message: object) -> None:
    print(f"mrt-validate: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
