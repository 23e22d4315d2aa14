"""Fixtures shared by all tiers of tests."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from mrt_mitsuba import runtime  # before anything imports mitsuba or drjit: it chooses the LLVM library

# --hypothesis-profile=long for the thorough run. No deadline: a busy machine is not a failure. Without a
# database and with fixed seeds, a run neither depends on an earlier one nor leaves anything behind.
settings.register_profile("short", max_examples=200, deadline=None, derandomize=True, database=None)
settings.register_profile("long", max_examples=10_000, deadline=None, database=None)
settings.load_profile("short")

# A shell has Ctrl-C ignored in what it runs in the background, and so would all that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def run_command(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run a command in a process and a folder of its own: ``run_command(*words, VARIABLE=value)``.

    It must end with ``code``, if not None. A variable set to None is taken out of the environment.
    ``DRJIT_LIBLLVM_PATH`` is out unless given.
    """

    def run(
        *words: object, code: int | None = 0, **variables: str | None
    ) -> subprocess.CompletedProcess[str]:
        given = os.environ | {"DRJIT_LIBLLVM_PATH": None} | variables
        environ = {key: value for key, value in given.items() if value is not None}
        done = subprocess.run(
            words, cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=300, check=False
        )
        assert code in (None, done.returncode), done.stdout + done.stderr
        return done

    return run


# Where tests in a vectorised variant run: "llvm", or "cuda" with make device-check
DEVICE = os.environ.get("MRT_DEVICE", "llvm")
FAST = runtime.FAST.replace("llvm", DEVICE)


def pytest_sessionstart() -> None:
    """End at once where the device that was asked for is not there: skipped tests would look like success."""
    problem = runtime.obstacle(f"{DEVICE}_ad_rgb")
    if problem and "MRT_DEVICE" in os.environ:
        pytest.exit(f"MRT_DEVICE={DEVICE}: {problem}", returncode=1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "variant" in getattr(item, "fixturenames", ()):
            item.add_marker("device")


@pytest.fixture
def run_python(run_command: Callable[..., Any]) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run Python code in the same way: ``run_python(code, *arguments, VARIABLE=value)``."""
    return functools.partial(run_command, sys.executable, "-c")


@pytest.fixture
def mrt_command(run_command: Callable[..., Any]) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the installed ``mrt`` in the same way, as after installation: LLVM is found by the package."""
    return functools.partial(run_command, Path(sys.executable).with_name("mrt"))


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., contextlib.AbstractContextManager[subprocess.Popen[str]]]:
    """Start a command in the test's folder: ``with start(*words) as process``; it ends with the block.

    It is killed after five minutes.
    """

    @contextlib.contextmanager
    def started(*words: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
        pipes = {name: subprocess.PIPE for name in ("stdout", "stderr")}
        with subprocess.Popen(words, cwd=tmp_path, text=True, **pipes | options) as process:
            limit = threading.Timer(300, process.kill)
            limit.start()
            try:
                yield process
            finally:
                limit.cancel()
                process.kill()

    return started


@pytest.fixture(autouse=True)
def fast_first() -> None:
    """Every test begins in the fast variant, whatever the one before has left; or in none."""
    if (mi := sys.modules.get("mitsuba")) and mi.variant() not in (None, FAST):
        runtime.use(FAST)


@pytest.fixture
def variant(request: pytest.FixtureRequest) -> Iterator[str]:
    """A Mitsuba variant with the plugins: ``llvm_ad_rgb``, or what a test asks for by an indirect parameter;
    of ``MRT_DEVICE`` in place of LLVM.

    Skips where it cannot run here. Afterwards the fast one is current.
    """
    name = getattr(request, "param", runtime.FAST).replace("llvm", DEVICE)
    if problem := runtime.obstacle(name):
        pytest.skip(problem)
    yield runtime.use(name)
    runtime.use(name if runtime.obstacle(FAST) else FAST)
