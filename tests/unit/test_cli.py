"""The mrt command in this process: what it prints and writes, its exit codes, failures, interrupts."""

from __future__ import annotations

import inspect
import json
import signal
import sys
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from cases import Cases
from PIL import Image

from mrt_mitsuba.command import main as cli
from mrt_mitsuba.command import options, registry
from mrt_mitsuba.errors import MrtError, MrtWarning, SceneError
from mrt_mitsuba.files.images import to_8bit
from mrt_mitsuba.rendering import api

SMALL = ("width=16", "height=12")


@pytest.mark.parametrize(("picture", "says"), [(None, "no kernel"), (np.zeros((12, 16, 3)), "scene 0 has")])
def test_a_self_test_that_fails_is_a_failure(monkeypatch, capsys, picture, says):
    def broken(*scene: object, **options: object) -> object:
        if picture is None:
            raise MrtError("no kernel")
        return SimpleNamespace(image=picture)

    monkeypatch.setattr(api, "render", broken)
    assert cli.main(["doctor"]) == 1
    assert f"self-test: FAILED: {says}" in capsys.readouterr().out


def test_render_writes_and_says_what_the_report_says(tmp_path, capsys):
    before = warnings.showwarning, signal.getsignal(signal.SIGTERM)
    out = str(tmp_path / "out")
    assert cli.main([out, "3", *SMALL, "aa=2", "aamode=luma"]) == 0
    text, errors = capsys.readouterr()
    *lines, wrote, last = text.splitlines()
    values = {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}
    expected = {"Width": "16", "Height": "12", "AA": "2", "AA mode": "luma", "F distance": "2.0"}
    assert expected.items() <= values.items()
    assert "Computing Anti aliasing.." in lines
    assert errors == ""
    assert wrote == f"Wrote {out}.png and {out}.exr"
    float(last.removeprefix("Render time: ").removesuffix("s"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.exr", "out.png"]
    assert (warnings.showwarning, signal.getsignal(signal.SIGTERM)) == before


def test_quiet_prints_nothing(tmp_path, capsys):
    words = [*SMALL, "quiet=1", "plan=show", "format=png", "tonemap=srgb"]
    assert cli.main([str(tmp_path / "out"), *words]) == 0
    assert capsys.readouterr() == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]
    with Image.open(tmp_path / "out.png") as png:
        shown = to_8bit(api.render(0, width=16, height=12).image, "srgb")
        assert np.array_equal(np.asarray(png), shown)


def test_listings(capsys):
    for words in (["help"], ["--help"], ["-h"], []):
        assert cli.main(words) == (0 if words else 2)
        text = capsys.readouterr()[0 if words else 1]
        assert text.startswith("usage: mrt FILENAME [SCENE] [name=value ...]")
    assert cli.main(["scenes"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list("0123456789")


failures = Cases()
failures(SceneError("no such file: a.xml"), 0, 1, "no such file: a.xml\n")
failures(KeyboardInterrupt(), 0, 130, "interrupted\n")
failures(MemoryError(), 0, 1, "out of memory: choose a smaller width, height or aa\n")
failures(RuntimeError("a\nb"), 0, 1, "RuntimeError: a b (set MRT_TRACEBACK=1 to see where)\n")
failures(MrtWarning("slow\nhere"), 0, 1, "warning: slow\\nhere\n")
failures(MrtWarning("slow\nhere"), 1, 1, "")


@pytest.mark.parametrize(("error", "quiet", "code", "text"), failures)
def test_failures_and_warnings_are_one_line(tmp_path, monkeypatch, capsys, error, quiet, code, text):
    def render(scene: object, **arguments: object) -> None:
        if isinstance(error, MrtWarning):
            warnings.warn(error, stacklevel=2)
            raise SceneError("after the warning")
        raise error

    monkeypatch.setattr(api, "render", render)
    words = [str(tmp_path / "out"), f"quiet={quiet}"]
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert cli.main(words) == code
    lines = capsys.readouterr().err.replace("mrt: after the warning\n", "")
    assert lines == (f"mrt: {text}" if text else "")
    assert list(tmp_path.iterdir()) == []
    if "MRT_TRACEBACK" in text:
        monkeypatch.setenv(cli.TRACEBACK, "1")
        with pytest.raises(RuntimeError):
            cli.main(words)


def test_what_is_not_installed_is_named_with_the_way_to_install_it(run_python):
    """By the command and from Python, where the tools of validation are missing."""
    text = "scipy is not installed: pip install 'mrt-mitsuba[validation]'"
    begin = "import sys; sys.modules['scipy'] = None\n"
    command = "from mrt_mitsuba.command import main as cli; sys.exit(cli.main(['check', '0']))"
    assert run_python(begin + command, code=1).stderr == f"mrt: {text}\n"
    found = run_python(begin + "import mrt_mitsuba as mrt; mrt.check_bsdf", code=1).stderr
    assert found.endswith(f"mrt_mitsuba.errors.MrtError: {text}\n")
    assert found.count("Traceback") == 1


# What Ctrl-C meets: a Dr.Jit kernel that runs for minutes (a million steps per entry), next to Python
IN_A_RENDER = """
import sys, time, types
class Result:
    def save(self, path, **how):
        from mrt_mitsuba.files.replacing import replacing
        with replacing(path) as (file,):
            file.write(b"half")
            file.flush()
            work()
def work():
    {work}
sys.modules["mrt_mitsuba.rendering.api"] = types.SimpleNamespace(render=lambda *scene, **arguments: Result())
from mrt_mitsuba.command import main as cli
sys.exit(cli.main())
"""
KERNEL = """
    import mrt_mitsuba, drjit as dr
    from drjit.llvm import Float, UInt32
    x, i = dr.arange(Float, 1_000_000), UInt32(0)
    x, i = dr.while_loop((x, i), lambda x, i: i < 1_000_000, lambda x, i: (dr.sin(x) + 1, i + 1))
    print("working", flush=True)
    dr.eval(x)
    time.sleep(300)
    """


def test_ctrl_c_leaves_the_old_file_and_does_not_wait_for_the_kernel(start, tmp_path):
    (tmp_path / "out.png").write_bytes(b"old")
    with start(sys.executable, "-c", IN_A_RENDER.format(work=KERNEL), "out", "format=png") as process:
        while "working" not in process.stdout.readline():
            assert process.poll() is None, process.stderr.read()
        time.sleep(0.3)  # into the kernel
        process.send_signal(signal.SIGINT)
        process.wait(timeout=100)  # a third of the kernel's time
        errors = process.stderr.read()
    assert process.returncode == 130, errors
    assert errors == "mrt: interrupted\n"
    assert [path.name for path in tmp_path.iterdir()] == ["out.png"]
    assert (tmp_path / "out.png").read_bytes() == b"old"


@pytest.mark.parametrize("name", registry.COMMANDS)
def test_every_word_of_a_command_is_explained(name, capsys):
    forms = registry.command_parser(name).forms
    for asking in ([name, "--help"], ["help", name]):
        assert cli.main(asking) == 0
        text = capsys.readouterr().out
        assert text.startswith(f"usage: mrt {name}")
        assert all(f"\n  {each}={form}" in text for each, form in forms.items())


def test_every_option_arrives_at_the_render_or_is_the_commands_own():
    own = {"scene", "plugins", "format", "tonemap", "compression", "plan", "quiet"}
    assert {*options.parse(["o"]).render_arguments(), *own} == {*options.TABLE, "params"}
    assert set(options.parse(["o"]).render_arguments()) <= set(inspect.signature(api.render).parameters)
    arguments = options.parse(["o", "layers=depth", "motion=1,2,3", "memory=4G"]).render_arguments()
    assert json.loads(json.dumps(arguments))["motion"] == [1, 2, 3]  # they go into the header as JSON
    of_xml = options.parse(["o", "scene=a.xml", "target=1%", "fov=40"])  # a target is no point to look at
    assert (str(of_xml.error), of_xml.params) == ("1%", {"fov": "40"})
