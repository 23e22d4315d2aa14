"""The examples of the README run as they stand."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

README = (Path(__file__).parents[2] / "README.md").read_text()
PYTHON = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
SHELL = "".join(re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL))
COMMANDS = re.findall(r"^mrt ([^#\n]*)", SHELL, flags=re.MULTILINE)


@pytest.mark.parametrize("code", PYTHON, ids=lambda code: code.splitlines()[0])
def test_python_examples_run(code, run_python):
    done = run_python(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("words", COMMANDS)
def test_commands_run(words, mrt_command, tmp_path):
    arguments = shlex.split(words)
    done = mrt_command(*arguments)
    assert done.returncode == 0, done.stderr
    if arguments[0] == "picture":
        assert {path.name for path in tmp_path.iterdir()} == {"picture.png", "picture.exr"}
