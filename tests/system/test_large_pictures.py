"""Pictures rendered in parts: within the memory allowed, the same bit for bit, and ended soon by a signal."""

from __future__ import annotations

import json
import os
import sys

import drjit as dr
import pytest
from cases import Cases

import mrt_mitsuba as mrt
from mrt_mitsuba import machine

SIZE = {"width": 131, "height": 97}  # rows and columns that no part divides
FOCUS = {"focaldist": 2.0, "focalrange": 0.5}
ways = Cases()
LAYERS = ["normal", "reflection", "blur"]
FOUND = [*LAYERS, "edges"]


def way(**options: object) -> None:
    ways(options)


way(aamode="none", **FOCUS, layers=LAYERS)
way(aamode="luma", **FOCUS, layers=FOUND, lattice="centered")
way(aamode="sobel", **FOCUS, layers=FOUND)
way(aamode="geometry", **FOCUS, layers=FOUND, lattice="centered")
way(aamode="none", integrator="path", spp=2, focaldist=2.0, seed=5)
way(aamode="sobel", integrator="path", spp=2, focaldist=2.0, seed=5)
way(aamode="sobel", focaldist=0, layers=["samples"])
way(aamode="sobel", lattice="film")
way(aamode="noise", spp=16, aa=None)
way(motion=(0.2, 0, 0.1), motionsamples=3, layers=["albedo"])


@pytest.mark.parametrize("options", ways, ids=str)
def test_parts_and_threads_change_no_bit(monkeypatch, options):
    scene = mrt.scene_dict(3, **SIZE) if "integrator" in options else 3
    options = {**({} if "integrator" in options else SIZE), "aa": 2, "count_rays": True, **options}
    whole = mrt.render(scene, **options)
    threads = dr.thread_count()
    monkeypatch.setattr(machine, "MAX_BAND", 41 * SIZE["width"])  # of a part of a filter
    monkeypatch.setattr(machine, "MAX_WAVEFRONT", 9_011)
    dr.set_thread_count(1)
    try:
        parts = mrt.render(scene, **options)
    finally:
        dr.set_thread_count(threads)
    assert parts.kernel_launches > whole.kernel_launches
    assert dict(parts.rays) == dict(whole.rays)
    assert parts.image.tobytes() == whole.image.tobytes()
    assert parts.layers.keys() == whole.layers.keys()
    for name, values in parts.layers.items():
        assert values.tobytes() == whole.layers[name].tobytes(), name


PEAK = """
import hashlib, json
import mrt_mitsuba as mrt
import drjit as dr

def status(name):
    with open("/proc/self/status") as file:
        return 1024 * int(dict(line.split(":", 1) for line in file)[name].split()[0])

def render(size, memory):
    RENDER
    return hashlib.sha256(result.image.tobytes()).hexdigest()

render(64, "1G")  # what the program takes for itself, kernels included
dr.flush_malloc_cache()
start, found = status("VmRSS"), []
for memory in ("LEAST", "4G"):  # the least that is accepted, and plenty
    picture = render(SIZE, memory)
    found.append([picture, status("VmHWM") - start])
print(json.dumps(found))
"""


REPORT = """
    result = mrt.render(3, width=size, height=size, aa=2, aamode="sobel", memory=memory)
    result.save("a.png")
    result.save("a.exr")"""
FILM = """
    film = {"type": "hdrfilm", "width": size, "height": size}  # its filter reaches two pixels far
    ball = {"type": "sphere", "bsdf": {"type": "mrt_bsdf"}}
    scene = {"type": "scene", "ball": ball, "sky": {"type": "constant"}}
    scene["sensor"] = {"type": "perspective", "film": film}
    result = mrt.render(scene, integrator="path", aamode="noise", spp=16, memory=memory)"""


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs Linux to measure memory")
@pytest.mark.parametrize(
    ("code", "size", "least", "more"),
    [
        pytest.param(REPORT, 1536, 112, 1.5, id="report"),
        pytest.param(FILM, 512, 470, 0.4, id="film", marks=pytest.mark.slow),
    ],
)
def test_peak_memory_stays_within_the_budget(run_python, code, size, least, more):
    """With room for it, the same picture takes more: the bound is kept by the parts, not by luck."""
    done = run_python(PEAK.replace("RENDER", code).replace("SIZE", str(size)).replace("LEAST", f"{least}M"))
    (tiled, bounded), (whole, most) = json.loads(done.stdout)
    budget = least * 2**20
    assert bounded < budget
    assert most > more * budget
    assert tiled == whole


# The signal comes from within, so that it is never too late
SOON = """
import os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)
def signal_soon():
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
"""
COMMAND = "from mrt_mitsuba.command import main as cli\nsys.exit(cli.main())\n"

# A picture that does not compress takes seconds to write, and one in narrow bands as long to blur
WRITING = """
import types
import numpy as np
from mrt_mitsuba.files import images as output
class Result:
    def save(self, path, tonemap, compression):
        image = np.random.default_rng(0).random((3000, 4000, 3), np.float32)
        signal_soon()
        output.save(path, image)
sys.modules["mrt_mitsuba.rendering.api"] = types.SimpleNamespace(render=lambda *scene, **options: Result())
"""
BLURRING = """
import time
from mrt_mitsuba import machine
from mrt_mitsuba.rendering.progress import TerminalProgress
from contextlib import contextmanager
machine.MAX_BAND = 1
@contextmanager
def stage(self, title, total, message=""):
    if title == "Depth of field":
        signal_soon()
    yield lambda steps: time.sleep(0.02)  # for each of 125 bands: the signal must come before the last
TerminalProgress.stage = stage
"""


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (WRITING, ("format=png",)),
        (WRITING, ("format=exr",)),
        (BLURRING, ("3", "width=300", "height=3000", "aa=1")),
    ],
    ids=["png", "exr", "blur"],
)
def test_ctrl_c_in_the_middle_is_acted_on(start, tmp_path, code, words):
    """Python comes to act on the signal while it writes and between bands."""
    with start(sys.executable, "-c", SOON + code + COMMAND, "out", *words) as process:
        _, errors = process.communicate(timeout=250)
        assert process.returncode == 130, errors
        assert errors == "mrt: interrupted\n"
    assert list(tmp_path.iterdir()) == []
