"""The examples of the README run as they stand."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README.read_text(), flags=re.DOTALL)
PYTHON = [code for language, code in BLOCKS if language == "python"]
COMMANDS = [
    line.split("#")[0].strip()
    for language, code in BLOCKS
    if language == "sh"
    for line in code.splitlines()
    if line.startswith("mrt ")
]


@pytest.mark.parametrize("code", PYTHON, ids=lambda code: code.splitlines()[0])
def test_python_examples_run(code, run_python):
    done = run_python(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_run(command, run_python, tmp_path):
    _, *arguments = shlex.split(command)
    code = "import sys; from mrt_mitsuba.command.main import main; sys.exit(main(sys.argv[1:]))"
    done = run_python(code, *arguments)
    assert done.returncode == 0, done.stderr
    written = {path.name for path in tmp_path.iterdir()}
    if arguments[0] == "picture":
        assert written == {"picture.png", "picture.exr"}


def test_every_option_named_exists():
    from mrt_mitsuba.command.options import TABLE

    named = {
        name
        for _, code in BLOCKS
        for name in re.findall(r"\b(\w+)=", code.split("```")[0])
        if "mrt picture" in code
    }
    assert named and named <= set(TABLE)
