"""The mrt command: what it prints and writes, its exit codes, and how it fails."""

from __future__ import annotations

import importlib
import inspect
import json
import os
import signal
import sys
import time
import types
import warnings
from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba.command import main as cli
from mrt_mitsuba.command import options, registry
from mrt_mitsuba.errors import MrtWarning, SceneError
from mrt_mitsuba.output import files as output
from mrt_mitsuba.validation.tools.compare import Difference


class Recorder:
    """Takes the place of the renderer; keeps what it was asked for."""

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error
        self.calls: list[tuple[object, dict]] = []

    def render(self, scene: object, *, progress, **arguments: object) -> Recorder:
        self.calls.append((scene, arguments))
        if self.error:
            raise self.error
        progress.plan("THE PLAN")
        with progress.stage("Rendering", 10) as advance:
            advance(10)
        with progress.stage("Anti-aliasing", 5, "Computing Anti aliasing..") as advance:
            advance(5)
        return self

    def save(self, *paths: str, tonemap: str) -> None:
        output.save(paths, np.full((2, 2, 3), 0.5, np.float32), tonemap=tonemap)


@pytest.fixture
def renderer(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    recorder = Recorder()
    monkeypatch.setitem(
        sys.modules, "mrt_mitsuba.rendering.api", types.SimpleNamespace(render=recorder.render)
    )
    return recorder


def test_render_writes_and_says_what_the_report_says(renderer: Recorder, tmp_path: Path, capsys) -> None:
    out = str(tmp_path / "out")
    assert cli.main([out, "3", "width=80", "height=60", "aa=2", "aamode=luma"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.exr", "out.png"]
    text, errors = capsys.readouterr()
    lines = text.splitlines()
    assert "Width:      80" in lines and "Height:     60" in lines and "AA:         2" in lines
    assert "AA mode:    luma" in lines and "F distance: 2.0" in lines and "F range:    2.0" in lines
    assert lines[-3] == "Computing Anti aliasing.."
    assert lines[-2] == f"Wrote {out}.png and {out}.exr"
    assert lines[-1].startswith("Render time: ") and lines[-1].endswith("s")
    float(lines[-1].removeprefix("Render time: ").removesuffix("s"))
    assert "PLAN" not in text and errors == ""
    ((scene, arguments),) = renderer.calls
    assert scene == 3
    assert (arguments["width"], arguments["aa"], arguments["aamode"]) == (80, 2, "luma")
    assert not {"filename", "scene", "format", "tonemap", "quiet", "plan"} & arguments.keys()


def test_quiet_prints_nothing(renderer: Recorder, tmp_path: Path, capsys) -> None:
    assert cli.main([str(tmp_path / "out"), "quiet=1", "plan=show", "format=png"]) == 0
    assert capsys.readouterr() == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]


@pytest.mark.parametrize(
    ("scene", "arguments", "distance"),
    [("0", [], "off"), ("3", [], "2.0"), ("4", [], "0.1"), ("3", ["focaldist=0"], "off")],
)
def test_banner_names_the_scenes_own_focus(
    renderer: Recorder, tmp_path: Path, capsys, scene: str, arguments: list[str], distance: str
) -> None:
    assert cli.main([str(tmp_path / "out"), scene, *arguments]) == 0
    assert f"F distance: {distance}\n" in capsys.readouterr().out


def test_listings(capsys) -> None:
    for words in (["help"], ["--help"], ["-h"]):
        assert cli.main(words) == 0
        text, errors = capsys.readouterr()
        assert text.startswith("usage: mrt FILENAME [SCENE] [name=value ...]") and errors == ""
    assert cli.main([]) == 2 and capsys.readouterr() == ("", text)
    assert cli.main(["scenes"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list("0123456789")


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (SceneError("no such file: a.xml"), 1, "mrt: no such file: a.xml\n"),
        (KeyboardInterrupt(), 130, "mrt: interrupted\n"),
        (MemoryError(), 1, "mrt: out of memory: choose a smaller width, height or aa\n"),
        (
            RuntimeError("first\nsecond"),
            1,
            "mrt: RuntimeError: first second (set MRT_TRACEBACK=1 to see where)\n",
        ),
    ],
)
def test_failures_are_one_line(
    renderer: Recorder, tmp_path: Path, monkeypatch, capsys, error: BaseException, code: int, text: str
) -> None:
    renderer.error = error
    assert cli.main([str(tmp_path / "out")]) == code
    assert capsys.readouterr().err == text
    assert list(tmp_path.iterdir()) == []
    if "MRT_TRACEBACK" in text:
        monkeypatch.setenv(cli.TRACEBACK, "1")
        with pytest.raises(RuntimeError, match="second"):
            cli.main([str(tmp_path / "out")])


@pytest.mark.parametrize(("quiet", "text"), [("0", "mrt: warning: slow\\nhere\n"), ("1", "")])
def test_warnings_are_one_line(
    renderer: Recorder, tmp_path: Path, monkeypatch, capsys, quiet: str, text: str
) -> None:
    def render(scene: object, **arguments: object) -> Recorder:
        warnings.warn("slow\nhere", MrtWarning, stacklevel=2)
        return renderer

    monkeypatch.setattr(sys.modules["mrt_mitsuba.rendering.api"], "render", render)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert cli.main([str(tmp_path / "out"), f"quiet={quiet}"]) == 0
    assert capsys.readouterr().err == text


def test_process_state_is_as_before(renderer: Recorder, tmp_path: Path) -> None:
    before = warnings.showwarning, signal.getsignal(signal.SIGTERM)
    cli.main([str(tmp_path / "out"), "quiet=1"])
    assert (warnings.showwarning, signal.getsignal(signal.SIGTERM)) == before


IN_A_RENDER = """
import sys, time, types
class Result:
    def save(self, path, tonemap):
        from mrt_mitsuba.output.replacing import replacing
        with replacing(path) as file:
            file.write(b"half")
            file.flush()
            work()
def render(*scene, **arguments):
    return Result()
{work}
sys.modules["mrt_mitsuba.rendering.api"] = types.SimpleNamespace(render=render)
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.command import options, registry
sys.exit(cli.main())
"""
# What the signal meets: Python code, or a Dr.Jit kernel that runs for minutes (a million steps per entry).
# Python waits for it there and then, or only at the end of the process.
SLEEP = """
def work():
    print("working", flush=True)
    time.sleep(60)
"""
KERNEL = """
def work():
    import mrt_mitsuba, drjit as dr
    from drjit.llvm import Float, UInt32
    x, i = dr.arange(Float, 1_000_000), UInt32(0)
    x, i = dr.while_loop((x, i), lambda x, i: i < 1_000_000, lambda x, i: (dr.sin(x) + 1, i + 1))
    print("working", flush=True)
    dr.eval(x)
    {wait}
"""


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
@pytest.mark.parametrize(
    "work",
    [SLEEP, KERNEL.format(wait="dr.sync_thread()"), KERNEL.format(wait="time.sleep(60)")],
    ids=["python", "kernel", "kernel next to python"],
)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_leaves_the_old_file_and_does_not_wait_for_the_kernel(
    start, tmp_path: Path, number: signal.Signals, code: int, work: str
) -> None:
    (tmp_path / "out.png").write_bytes(b"old")
    with start(sys.executable, "-c", IN_A_RENDER.format(work=work), "out", "format=png") as process:
        while "working" not in process.stdout.readline():
            assert process.poll() is None, process.stderr.read()
        time.sleep(0.3)  # into the kernel
        process.send_signal(number)
        process.wait(timeout=20)  # a third of the kernel's time
        errors = process.stderr.read()
    assert process.returncode == code, errors
    assert errors.startswith("mrt: ") and errors.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]
    assert (tmp_path / "out.png").read_bytes() == b"old"


def test_reader_that_goes_away(run_command) -> None:
    """``mrt help | head -1`` ends without complaint."""
    code = "import sys; from mrt_mitsuba.command.main import main; sys.exit(main())"
    done = run_command("sh", "-c", f"{sys.executable} -c '{code}' help | head -1")
    assert done.returncode == 0 and done.stdout.startswith("usage: mrt") and done.stderr == ""


def test_wrong_usage_starts_nothing_heavy(run_python) -> None:
    code = """
import sys
from mrt_mitsuba.command import main as cli
from mrt_mitsuba.command import options, registry
code = cli.main(["out", "width=0"])
print(code, [name for name in ("drjit", "mitsuba", "numpy", "OpenEXR", "PIL", "tqdm") if name in sys.modules])
"""
    assert run_python(code).stdout == "2 []\n"


class Terminal:
    """A stream that says it is a terminal."""

    def __init__(self) -> None:
        self.text = ""

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        pass


def test_bar_on_a_terminal_shows_the_time_left() -> None:
    from mrt_mitsuba.rendering.progress import TerminalProgress

    messages, bars = Terminal(), Terminal()
    with TerminalProgress(file=messages, bar_file=bars).stage("Rendering", 1000, "message") as advance:
        for _ in range(4):
            time.sleep(0.12)  # tqdm draws ten times a second at most
            advance(200)
    assert messages.text == "message\n"
    assert "Rendering:" in bars.text and "80%" in bars.text and "<00:00" in bars.text
    assert bars.text.endswith("\r")  # cleared at the end


def test_every_word_of_every_command_arrives() -> None:
    """A command declares its words in its form, and its function takes each of them by name."""
    for name, (form, _, home) in registry.ALL.items():
        module, _, function = home.partition(":")
        taken = inspect.signature(getattr(importlib.import_module(module), function)).parameters
        names = {key for key, each in taken.items() if each.kind is each.KEYWORD_ONLY}
        if "limits" in taken:
            names |= {*Difference.__dataclass_fields__, "flip"}
        assert set(registry.names_in(form)) - {"scene", "name"} <= names, name
        positional = [each for each in taken.values() if each.kind <= each.POSITIONAL_OR_KEYWORD]
        assert len(positional) == sum(w[0].isupper() for w in form.replace("--xml PATH", "").split()), name


def test_every_option_arrives_at_the_render_or_is_the_commands_own() -> None:
    own = {"scene", "format", "tonemap", "plan", "quiet", "log"}
    assert {*options.parse(["o"]).render_arguments(), *own} == {*options.TABLE, "params"}
    arguments = options.parse(["o", "layers=depth", "motion=1,2,3", "memory=4G"]).render_arguments()
    assert json.loads(json.dumps(arguments))["motion"] == [1, 2, 3]  # they go into the header as JSON
