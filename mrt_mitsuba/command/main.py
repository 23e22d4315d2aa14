"""The ``mrt`` command. Nothing heavy is imported before arguments and output files are checked."""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from mrt_mitsuba.command.interrupt import Terminated, ending_soon, leave_now
from mrt_mitsuba.command.options import Options, parse, usage
from mrt_mitsuba.errors import MrtError, MrtWarning, UsageError
from mrt_mitsuba.scene.model import FOCAL_RANGE, SIZE

INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM
# What printing fails with where the output goes to a full disk; pictures have errors of their own
FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO)
# An environment variable; set to anything, unexpected errors show where they came from
TRACEBACK = "MRT_TRACEBACK"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 1 for a failure, 2 for wrong usage, 130 when interrupted.

    Without arguments, those of the process are taken, and an interrupt ends the process at once.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    _open_closed_streams()
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        code = _guarded(words)
    if code in (INTERRUPTED, TERMINATED) and arguments is None:
        leave_now(code)  # the interpreter would wait for the kernels that run
    return code


def _open_closed_streams() -> None:
    """Let nothing that is opened later be taken for standard output or error, where a caller closed these."""
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            mode = "r" if name == "stdin" else "w"
            stream = open(os.devnull, mode)  # noqa: SIM115 - it stays open
            if stream.fileno() != descriptor:
                os.dup2(stream.fileno(), descriptor)
            setattr(sys, name, stream)


def _guarded(arguments: list[str]) -> int:
    """Run the command; whatever goes wrong becomes one line and an exit code."""
    try:
        with ending_soon(_end_by_force):
            code = _dispatch(arguments)
            sys.stdout.flush()
        return code
    except MrtError as error:
        return _fail(str(error), error.exit_code)
    except Terminated:
        return _fail("terminated", TERMINATED)
    except KeyboardInterrupt:
        return _fail("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # whoever read the output has gone; keep Python from complaining about it once more at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if error.errno not in FULL or error.filename is not None:
            return _unexpected(error)
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - or Python complains once more at exit
        return _fail(f"cannot print: {error.strerror}; send the output elsewhere", 1)
    except MemoryError:
        return _fail("out of memory: choose a smaller width, height or aa", 1)
    except Exception as error:
        return _unexpected(error)


def _unexpected(error: Exception) -> int:
    if os.environ.get(TRACEBACK):
        raise error
    return _fail(f"{type(error).__name__}: {error} (set {TRACEBACK}=1 to see where)", 1)


def _dispatch(arguments: list[str]) -> int:
    if not arguments:
        sys.stderr.write(usage())
        return UsageError.exit_code
    command, rest = arguments[0], arguments[1:]
    if command in COMMANDS:
        return COMMANDS[command](rest)
    return render(parse(arguments))


def render(options: Options) -> int:
    """Render and write what the options say."""
    from mrt_mitsuba.output.files import check_target

    for path in options.outputs():
        check_target(path)
    from mrt_mitsuba.rendering.api import render as render_scene
    from mrt_mitsuba.rendering.progress import Progress, TerminalProgress

    if options.quiet:
        warnings.simplefilter("ignore", MrtWarning)
    else:
        print(banner(options), flush=True)
    if options.log != "warn":
        from mrt_mitsuba import runtime
        from mrt_mitsuba.command import logs

        runtime.use(options.variant)
        logs.show(options.log)
    progress = Progress() if options.quiet else TerminalProgress(show_plan=options.plan == "show")
    start = time.perf_counter()
    scene: Any = options.scene if options.scene is not None else options.scene_number
    if options.shows_model():
        from mrt_mitsuba.scene.obj import obj_view

        scene = obj_view(scene, convention=options.convention, **options.model_arguments())
    result = render_scene(scene, progress=progress, **options.render_arguments())
    seconds = time.perf_counter() - start
    for path in options.outputs():
        result.save(path, tonemap=options.tonemap)
    if not options.quiet:
        print(f"Render time: {seconds:.6f}s")
    return 0


def banner(options: Options) -> str:
    """Return the parameters of the render, one per line."""
    size: tuple[object, object] = SIZE
    focus = options.focus(None, FOCAL_RANGE)
    if options.scene is None:
        from mrt_mitsuba.scene.report import report_scene

        scene = report_scene(options.scene_number)
        focus = options.focus(scene.focal_distance, scene.focal_range)
    elif not options.shows_model():
        size = "from the file", "from the file"
    lines = {
        "Scene": options.scene if options.scene is not None else options.scene_number,
        "Width": options.width or size[0],
        "Height": options.height or size[1],
        "AA": options.aa,
        "AA mode": options.aamode,
        "F distance": focus.distance or "off",
        "F range": focus.range if focus.distance else "off",
    }
    return "\n".join(f"{name + ':':<12}{value}" for name, value in lines.items())


def _help(arguments: list[str]) -> int:
    _no_arguments("help", arguments)
    sys.stdout.write(usage())
    return 0


def _version(arguments: list[str]) -> int:
    _no_arguments("--version", arguments)
    from mrt_mitsuba import __version__

    print(f"mrt-mitsuba {__version__}")
    return 0


def _doctor(arguments: list[str]) -> int:
    _no_arguments("doctor", arguments)
    from mrt_mitsuba.command import doctor

    return 0 if doctor.report() else 1


def _scenes(arguments: list[str]) -> int:
    _no_arguments("scenes", arguments)
    from mrt_mitsuba.scene.report import NUMBERS, report_scene

    for number in NUMBERS:
        print(f"{number}  {report_scene(number).title}")
    return 0


def _export(arguments: list[str]) -> int:
    flavor = "stock" if "--stock" in arguments else "mrt"
    words = list(arguments)
    if flavor == "stock":
        words.remove("--stock")
    if len(words) != 3 or words[1] != "--xml":
        raise UsageError("write mrt export SCENE --xml PATH [--stock]")
    number, path = parse(["export", words[0]]).scene_number, words[2]
    if not path:
        raise UsageError("PATH is empty: write mrt export SCENE --xml PATH [--stock]")
    from mrt_mitsuba.output.files import check_target

    check_target(path)
    from mrt_mitsuba.scene.export import write_xml

    write_xml(number, path, flavor=flavor)
    return 0


def _no_arguments(command: str, arguments: list[str]) -> None:
    if arguments:
        raise UsageError(f"unexpected argument {arguments[0]!r} after mrt {command}")


COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "help": _help,
    "-h": _help,
    "--help": _help,
    "--version": _version,
    "doctor": _doctor,
    "scenes": _scenes,
    "export": _export,
}


def _fail(message: str, code: int) -> int:
    print(f"mrt: {' '.join(message.split())}", file=sys.stderr)
    return code


def _end_by_force() -> None:
    from mrt_mitsuba.output.files import discard_unfinished

    discard_unfinished()
    newline = "\n" if sys.stderr.isatty() else ""  # below the progress bar
    print(f"{newline}mrt: interrupted", file=sys.stderr)


def _show_warning(message: Warning | str, category: type[Warning], *place: object, **more: object) -> None:
    print(f"mrt: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
