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
from contextlib import nullcontext
from importlib import import_module, util
from pathlib import Path

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress
from mrt_mitsuba.validation.tools import report
from mrt_mitsuba.validation.tools.kernels import own_cache
from mrt_mitsuba.validation.tools.study import Study

# A study by its name on the command line: the module of this package that runs it, imported when it is run
STUDIES = {
    "laws": "bsdf_laws",
    "roughconductor": "roughconductor",
    "stock": "stock",
    "scenes": "scenes",
    "antialiasing": "antialiasing",
    "depth-of-field": "depth_of_field",
    "stability": "stability",
    "error-vs-time": "error_vs_time",
    "cost": "cost",
    "growth": "growth",
    "rivals": "rivals",
    "objects": "objects",
    "acceleration": "acceleration",
}
# All about speed; the first name stands for all of them
SPEED = ("error-vs-time", "cost", "growth", "rivals")
EXTRAS = ("matplotlib", "jinja2", "scipy", "mpmath", "flip_evaluator")
FOLDER = "validation-report"
INTERRUPTED = 128 + signal.SIGINT


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 1 where a bound is missed or a study fails, 130 interrupted.

    Wrong usage ends the process with 2, as argparse does it.
    """
    options = _parser().parse_args(arguments)
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            return _validate(options)
        except MrtError as error:
            return _fail(str(error), error.exit_code)
        except KeyboardInterrupt:
            return _fail("interrupted; no report was written", INTERRUPTED)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mrt-validate",
        description="Compare the renderer with Mitsuba, with exact numbers and with itself.",
        epilog="Exit code: 0 if every bound holds, 1 if one is missed or a study fails, 2 for wrong usage.",
    )
    parser.add_argument(
        "study",
        nargs="+",
        choices=[*STUDIES, "all"],
        metavar="STUDY",
        help=f"one or more of: {', '.join(STUDIES)}; or all. error-vs-time is all studies of speed: "
        f"{', '.join(SPEED[1:])} as well",
    )
    parser.add_argument(
        "--quick", action="store_true", help="fewer samples and cases: under two minutes in all"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(FOLDER),
        metavar="DIR",
        help=f"folder of the report, made if need be (default: {FOLDER})",
    )
    return parser


def _validate(options: argparse.Namespace) -> int:
    names = _named(options.study)
    _check_extras()
    report.prepare(options.out, "summary.json", "index.html")
    # With a cache of their own, studies of speed can tell how long compilation takes
    own = nullcontext() if options.quick or not set(names) & set(SPEED) else own_cache()
    with own:
        return _run(names, options)


def _named(given: Sequence[str]) -> list[str]:
    """The studies that the names given stand for, each once, in the order of ``STUDIES``."""
    chosen = {*given, *(SPEED if SPEED[0] in given else ())}
    return [name for name in STUDIES if name in chosen or "all" in chosen]


def _run(names: Sequence[str], options: argparse.Namespace) -> int:
    import matplotlib

    matplotlib.use("Agg")  # no window, whatever the user's settings say
    progress = TerminalProgress(unit="step")
    outcomes = [run_study(name, quick=options.quick, progress=progress) for name in names]
    print(report.terminal_table(outcomes), flush=True)
    report.write(options.out, outcomes, report.header(quick=options.quick))
    print(f"\nReport: {options.out / 'index.html'}")
    return 0 if all(outcome.passed for outcome in outcomes) else 1


def run_study(name: str, *, quick: bool, progress: Progress | None = None) -> report.Outcome:
    """Run one of ``STUDIES`` in the default variant. What it raises becomes its failure."""
    study = Study(name, name, progress or Progress())
    start, failure = time.perf_counter(), ""
    try:
        runtime.use(runtime.default_variant())
        module = import_module(f"mrt_mitsuba.validation.studies.{STUDIES[name]}")
        study.title = module.TITLE
        print(f"{name}: {study.title} ...", file=sys.stderr, flush=True)
        module.run(study, quick=quick)
    except Exception:
        failure = traceback.format_exc(limit=-4)
    seconds = time.perf_counter() - start
    _tidy_up()
    return report.Outcome(study, seconds, failure)


def _tidy_up() -> None:
    """Scenes that live on, and memory that Dr.Jit keeps for reuse, slow down the next study."""
    gc.collect()
    if "drjit" in sys.modules:
        sys.modules["drjit"].flush_malloc_cache()


def _check_extras() -> None:
    missing = [name for name in EXTRAS if util.find_spec(name) is None]
    if missing:
        packages = " ".join(name.replace("_", "-") for name in missing)
        raise MrtError(f"{packages} missing: {sys.executable} -m pip install {packages}")


def _fail(message: str, code: int) -> int:
    print(f"mrt-validate: {' '.join(message.split())}", file=sys.stderr)
    return code


def _show_warning(message: Warning | str, category: type[Warning], *place: object, **more: object) -> None:
    print(f"mrt-validate: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
