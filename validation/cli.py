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
from typing import NamedTuple

from mrt_mitsuba import runtime
from mrt_mitsuba.errors import MrtError
from mrt_mitsuba.rendering.progress import Progress, TerminalProgress
from mrt_mitsuba.validation.tools import report
from mrt_mitsuba.validation.tools.kernels import own_cache
from mrt_mitsuba.validation.tools.study import Study


class Entry(NamedTuple):
    """A study of the command: its module, imported when it is run, and what ``--list`` says of it."""

    module: str
    about: str
    quick: int = 0  # seconds on two idle cores, about
    full: int = 0


STUDIES = {
    "laws": Entry("bsdf_laws", "does the material obey its own laws", 6, 60),
    "roughconductor": Entry("roughconductor", "is the material the function that Mitsuba's is", 10, 90),
    "stock": Entry("stock", "are light, gloss, mirrors, anti-aliasing what Mitsuba computes", 15, 60),
    "scenes": Entry("scenes", "are the report's scenes right, with a reason for each pixel off", 10, 60),
    "antialiasing": Entry("antialiasing", "does refining edges give the picture of refining all", 6, 60),
    "adaptive": Entry("adaptive", "are own scenes Mitsuba's, and errors as stated and cheap", 10, 180),
    "depth-of-field": Entry("depth_of_field", "what do the blur filters get wrong against a lens", 3, 60),
    "stability": Entry("stability", "where must float32 give out, and where does it not", 8, 60),
    "exhaustive": Entry("exhaustive", "how far off are formulas, over every float32 cosine", 2, 120),
    "error-vs-time": Entry("error_vs_time", "what does each setting buy for its time", 9, 480),
    "cost": Entry("cost", "where does the time of a render go, what does the plan save", 6, 120),
    "growth": Entry("growth", "how does time grow with pixels, objects, lights and bounces", 3, 180),
    "rivals": Entry("rivals", "how fast are our plugins against Mitsuba's own", 5, 120),
    "objects": Entry("objects", "how good are mesh cones, what do exact ones cost", 3, 60),
    "workers": Entry("workers", "how fast are sweeps on several processes, and are they equal", 5, 120),
    "acceleration": Entry("acceleration", "how does time grow with the number of objects", 9, 60),
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
        epilog=f"studies:\n{listing()}\n\n{SPEED[0]} also runs {', '.join(SPEED[1:])}.\n"
        "Exit code: 0 if every bound holds, 1 if one is missed or a study fails, 2 for wrong usage.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = [*STUDIES, "all"]
    parser.add_argument("study", nargs="+", choices=names, metavar="STUDY", help="one or more, or all")
    parser.add_argument("--list", action="version", version=listing(), help="list the studies and stop")
    parser.add_argument("--quick", action="store_true", help="fewer samples and cases")
    parser.add_argument("--out", type=Path, default=Path(FOLDER), metavar="DIR",
                        help=f"folder of the report, made if need be (default: {FOLDER})")  # fmt: skip
    return parser


def listing() -> str:
    """Return a line on each study, with how long it takes on two idle cores."""
    quick, full = (sum(getattr(e, name) for e in STUDIES.values()) for name in ("quick", "full"))
    lines = [f"  {'':<15}{'quick':>7}{'full':>8}"]
    for name, entry in {**STUDIES, "all": Entry("", "all of these", quick, full)}.items():
        lines.append(f"  {name:<15}{_spoken(entry.quick):>7}{_spoken(entry.full):>8}  {entry.about}")
    return "\n".join(lines)


def _spoken(seconds: int) -> str:
    return f"{seconds} s" if seconds < 100 else f"{round(seconds / 60)} min"


def _validate(options: argparse.Namespace) -> int:
    names = named(options.study)
    _check_extras()
    report.prepare(options.out, "summary.json", "index.html")
    seconds = sum(STUDIES[name].quick if options.quick else STUDIES[name].full for name in names)
    print(f"This takes about {_spoken(seconds)} on two idle cores.", file=sys.stderr)
    # With a cache of their own, studies of speed see how long compilation takes
    with nullcontext() if options.quick or not set(names) & set(SPEED) else own_cache():
        return _run(names, options)


def named(given: Sequence[str]) -> list[str]:
    """Return the studies that the given names stand for, each once, in the order of ``STUDIES``."""
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
        module = import_module(f"mrt_mitsuba.validation.studies.{STUDIES[name].module}")
        study.title = module.TITLE
        print(f"{name}: {study.title} ...", file=sys.stderr, flush=True)
        module.run(study, quick=quick)
    except Exception:
        failure = traceback.format_exc(limit=-4)
    seconds = time.perf_counter() - start
    gc.collect()  # scenes that live on, and memory that Dr.Jit keeps for reuse, slow down the next study
    if "drjit" in sys.modules:
        sys.modules["drjit"].flush_malloc_cache()
    return report.Outcome(study, seconds, failure)


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
