"""Hostile files, signals, threads and small machines: nothing breaks, hangs, or runs code of theirs."""

from __future__ import annotations

import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
from cases import but_slow
from nodes import TRIANGLE, scene_xml

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import SceneError

pytestmark = pytest.mark.attack
MRT = Path(sys.executable).with_name("mrt")
ROUNDS = int(os.environ.get("MRT_ATTACK_ROUNDS", "1"))  # what depends on chance is tried so many times more

TRAP = """
#include <stdlib.h>
#include <fcntl.h>
__attribute__((constructor)) static void run(void) { open(getenv("MRT_TRAP"), O_CREAT | O_WRONLY, 0600); }
"""
RENDER_FILES = """
import sys, mrt_mitsuba as mrt
for path in sys.argv[1:]:
    try:
        mrt.render(path, aa=1, integrator="path")
        print(path, "rendered")
    except mrt.SceneError as error:
        print(path, error)
try:
    mrt.render({"type": "scene", "sensor": {"type": "perspective"}, "shape": {"type": "wicked"}}, aa=1)
except mrt.SceneError as error:
    print("dict", error)
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_no_native_code_from_the_folders_of_process_and_scene(run_python, mrt_command, tmp_path):
    trap = tmp_path / "trap.so"
    sign = tmp_path / "it ran"
    (tmp_path / "trap.c").write_text(TRAP)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", trap, tmp_path / "trap.c"], check=True, timeout=60)
    for folder in (tmp_path, tmp_path / "scene", tmp_path / "more"):
        (folder / "plugins").mkdir(parents=True)
        for name in ("sphere", "diffuse", "hdrfilm", "path", "scene", "constant", "wicked"):
            shutil.copy(trap, folder / "plugins" / f"{name}.so")
    files = {
        "known": "<shape type='sphere'><bsdf type='diffuse'/></shape>",
        "unknown": "<shape type='wicked'/>",
        "by_path": "<path value='more'/><shape type='sphere'><bsdf type='diffuse'/></shape>",
        "by_parameter": "<default name='kind' value='wicked'/><shape type='$kind'/>",
        "by_place": "<shape type='../../scene/plugins/wicked'/>",
    }
    for name, text in files.items():
        (tmp_path / "scene" / f"{name}.xml").write_text(scene_xml(text))
    done = run_python(RENDER_FILES, *(f"scene/{name}.xml" for name in files), MRT_TRAP=str(sign))
    lines = dict(line.split(" ", 1) for line in done.stdout.splitlines())
    assert not sign.exists(), lines
    assert lines["scene/known.xml"] == lines["scene/by_path.xml"] == "rendered"
    for name in ("scene/unknown.xml", "scene/by_parameter.xml", "dict"):
        assert "native code that is not Mitsuba's" in lines[name]
    words = ("out", "3", "width=8", "height=6", "quiet=1")
    mrt_command(*words, MRT_TRAP=str(sign))
    plugins = tmp_path / "plugins"
    (plugins / "wicked.so").rename(plugins / "mrt_bsdf.so")  # looked for there first
    done = mrt_command(*words, MRT_TRAP=str(sign), code=1)
    assert "native code that is not Mitsuba's" in done.stderr
    assert not sign.exists()


READ_MODELS = """
import sys, warnings
warnings.simplefilter("ignore")
from mrt_mitsuba.scene.obj import read_obj
points = b"v 0 0 0\\nv 1 0 0\\nv 0 1 0\\n"
limit = 2**18
for text in (
    b"v " + b"1" * 200_000 + b" 0 0\\nf 1 2 3\\n",
    b"v " + b"1" * 100_000 + b"." + b"1" * 100_000 + b" 0 0\\nf 1 2 3\\n",
    b"v" + b" " * 100_000 + b"1" + b" " * 100_000 + b"x\\nf 1 2 3\\n",
    b"#" + b"x" * (limit - 2) + b"\\nf 1 2 \\\\\\n3\\n",
    b"#" + b"x" * limit + b"\\nf 1 2 3\\n",
    b"f" + b" 1 2 3" * (10 * limit // 6) + b"\\n",
    b"f 1 2" + b" \\\\\\n" * 100_000 + b" 3\\n",
    b"mtllib none.mtl\\n" * 200_000 + b"\\n \\n# x\\ng y\\n" * 1_000_000 + b"f 1 2 3\\n",
):
    with open("a.obj", "wb") as file:
        file.write(points + text)
    try:
        print(len(read_obj("a.obj")[0]))
    except Exception as error:
        print(type(error).__name__, error)
"""


def test_time_to_read_a_model_grows_with_its_size(run_python):
    """The first alone took half an hour; ``run_python`` waits two minutes."""
    lines = run_python(READ_MODELS).stdout.splitlines()
    assert [line.split()[0] for line in lines] == [*["SceneError"] * 3, "1", *["SceneError"] * 2, "1", "1"], (
        lines
    )
    for line in lines[4:6]:
        assert "at most 262144 are read" in line
    assert all(len(line) < 200 for line in lines)


@pytest.mark.parametrize("depth", [1000, 100_000])
def test_deep_nesting_is_refused(variant, depth):
    scene: dict[str, Any] = {}
    for _ in range(depth):
        scene = {"type": "scene", "inner": scene}
    with pytest.raises(SceneError, match="nested more than 256 levels"):
        mrt.render(scene, aa=1)


KINDS = {
    "sensor": "perspective thinlens orthographic radiancemeter irradiancemeter distant batch",
    "film": "hdrfilm specfilm",
    "sampler": "independent stratified multijitter orthogonal ldsampler",
    "rfilter": "box tent gaussian mitchell catmullrom lanczos",
    "integrator": "path direct volpath volpathmis ptracer prb prb_basic prb_projective prbvolpath aov depth "
    "moment direct_projective volprim_rf_basic stokes mrt_whitted",
    "emitter": "area constant directional directionalarea envmap point projector spot sunsky mrt_light",
}
AROUND = """sensor:perspective sensor:batch film:hdrfilm shape:sphere bsdf:diffuse integrator:stokes
integrator:moment"""
NUMBERS_IN = {"sampler": "sample_count", "rfilter": "stddev radius lobes", "film": "width crop_width"}
LIMITS = ("width=8", "height=6"), ("target=0.5", "maxspp=64", "maxseconds=3"), ("aamode=noise", "spp=16")
VARIANTS = ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_spectral_polarized", "llvm_ad_mono_polarized")


def odd_scenes() -> list[str]:
    """Return what is put next to a ball and a sky: each plugin alone, in others, and with odd numbers."""
    node = "<{0} type='{1}'>{{}}</{0}>"
    found = [node.format(kind, name) for kind, names in KINDS.items() for name in names.split()]
    outer = ["{}"] + [node.format(*each.split(":")) for each in AROUND.split()]
    placed = [around.format(each.format("")) for each in found for around in outer]
    for kind, names in NUMBERS_IN.items():
        for name, value in itertools.product(names.split(), ("0", "-1", "1e9", "nan", "2147483648")):
            number = f"<{'float' if kind == 'rfilter' else 'integer'} name='{name}' value='{value}'/>"
            inside = [each.format(number) for each in found if each.startswith(f"<{kind}")]
            film = "<film type='hdrfilm'>{}</film>" if kind == "rfilter" else "{}"
            placed += [f"<sensor type='perspective'>{film.format(each)}</sensor>" for each in inside]
    return placed


ODD = list(itertools.product(odd_scenes(), LIMITS, VARIANTS))
random.Random(1).shuffle(ODD)


@pytest.mark.parametrize("place", range(min(8 * ROUNDS, len(ODD))))
def test_every_plugin_in_every_place(mrt_command, tmp_path, place):
    """A picture, or one line that says why not; no crash, and no hang."""
    inside, words, variant = ODD[place]
    ball = "<shape type='sphere'/><emitter type='constant'/>"
    (tmp_path / "a.xml").write_text(f"<scene version='3.0.0'>{inside}{ball}</scene>")
    words = ("out", "scene=a.xml", f"variant={variant}", "quiet=1", "memory=1G", *words)
    done = mrt_command(*words, code=None)
    left = sorted(path.name for path in tmp_path.iterdir())
    assert done.returncode in (0, 1, 2), (inside, done.stderr)
    assert "MRT_TRACEBACK" not in done.stderr, (inside, done.stderr)
    assert left == (["a.xml", "out.exr", "out.png"] if done.returncode == 0 else ["a.xml"]), inside
    assert done.stderr.count("\n") == (done.returncode != 0), (inside, done.stderr)


@pytest.mark.parametrize("name", ["n" * 300, "closed/m", "pipe", "folder"])
def test_unreadable_library_and_texture_are_warnings(variant, tmp_path, name):
    """A mode of 0 does not keep the superuser out; a folder of that name stands for it."""
    (tmp_path / "closed").mkdir(mode=0o000)
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "m.mtl").write_text(f"newmtl m\nKd 1 0 0\nmap_Kd {name}\n")
    model = tmp_path / "m.obj"
    model.write_text(f"mtllib {name}\nmtllib m.mtl\n" + TRIANGLE)
    with pytest.warns(mrt.MrtWarning) as caught:
        assert mrt.render(str(model), width=4, height=3, aa=1).image.shape == (3, 4, 3)
    assert [" is missing or may not be read" in str(w.message) for w in caught] == [True, True]


def test_messages_are_printable_short_and_few(variant, tmp_path):
    model = tmp_path / "m.obj"
    for text in (f"v 0 0 {'z' * 200_000}", "\x1b]0;owned\x07 1", "f 1 2 \u202e3", "usemtl \x9b31m\nx"):
        model.write_text(text + "\n")
        with pytest.raises(SceneError) as caught, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mrt.render(str(model), aa=1)
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 1000
    faces = "".join(f"usemtl m\x1b{i}\nf 1 2 3\n" for i in range(20_000))
    model.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + faces)
    with pytest.warns(mrt.MrtWarning) as warned:
        mrt.render(str(model), width=4, height=3, aa=1)
    assert len(warned) == 1
    assert "19999 more materials" in str(warned[0].message)
    assert str(warned[0].message).isprintable()


THREADS = """
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
import mrt_mitsuba as mrt
start = Barrier(8)
def work(number):
    start.wait()
    return mrt.render(number % 4, width=40, height=30, aa=2).image.sum()
with ThreadPoolExecutor(8) as pool:
    found = list(pool.map(work, range(8)))
print(found[:4] == found[4:], len(set(found)))
"""


# The command as its script starts it, with a line once Python has left its own start behind
STARTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
print(flush=True)
from mrt_mitsuba.command import start
sys.exit(start())
"""


@pytest.mark.parametrize("attempt", range(3 * ROUNDS))
def test_a_signal_leaves_both_pictures_old_or_new(start, tmp_path, attempt):
    old = [tmp_path / "out.png", tmp_path / "out.exr"]
    for path in old:
        path.write_bytes(b"old")
    rng = random.Random(attempt)
    number = signal.SIGINT
    words = ("out", "3", "width=64", "height=48", "aa=1", "quiet=1")
    with start(sys.executable, "-c", STARTED, *words) as process:
        process.stdout.readline()
        time.sleep(rng.uniform(0, 1.1))
        process.send_signal(number)
        code = process.wait(timeout=120)
        errors = process.stderr.read()
    # outside of its work, at the very start or end, the command dies as any program
    assert code in (0, 130, -number) and "Traceback" not in errors, errors
    assert len({path.read_bytes() == b"old" for path in old}) == 1
    assert sorted(tmp_path.iterdir()) == sorted(old)


EDITED = """
import random, sys, threading, time
import numpy as np
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi
grey, own = {"type": "rgb", "value": 0.5}, {"type": "mrt_bsdf"}
materials = [own | {"diffuse_reflectance": grey}, {"type": "diffuse", "reflectance": grey}]
shapes = {f"ball{i}": {"type": "sphere", "center": [i - 2, 0, 5], "radius": 0.5, "bsdf": materials[i % 2]}
          for i in range(4)}
film = {"type": "hdrfilm", "width": 32, "height": 24}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "mrt_whitted"}, "sensor": {"type": "perspective", "film": film},
    "light": {"type": "point", "position": [0, 4, 0]}, "cube": {"type": "cube", "bsdf": own},
    "cone": {"type": "mrt_cone", "apex": [0, 2, 6], "base_center": [0, 0, 6], "radius": 0.5}, **shapes})
doors = {"mrt": lambda: mrt.render(scene).image, "mi": lambda: np.array(mi.render(scene, spp=4))}
render, params = doors[sys.argv[1]], mi.traverse(scene)
keys = [key for key in params.keys() if key.endswith(("reflectance.value", "positions", "apex"))]
before, first, edits, done = {key: type(params[key])(params[key]) for key in keys}, render(), 0, False
def edit():
    global edits
    while not done:
        for key in keys:
            params[key] = before[key] * (1 + edits % 5 / 50)
            time.sleep(0.01 * random.random())
        params.update()
        edits += 1
thread = threading.Thread(target=edit)
thread.start()
rendered = 0
while rendered < 4 or edits < 4:
    render()
    rendered += 1
done = True
thread.join()
for key in keys:
    params[key] = before[key]
params.update()
print(len(keys) > 5, np.array_equal(render(), first))
"""


INTERRUPTED = """
import os, signal, sys, threading, time
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background
mi.set_log_level(mi.LogLevel.Error)
options = {"width": 80, "height": 60, "aa": 2, "integrator": "path", "spp": 4}
scene = mi.load_dict(mrt.scene_dict(3, width=160, height=120))
doors = {"mrt": lambda: mrt.render(3, **options), "mi": lambda: mi.render(scene, spp=4).numpy()}
render = doors[sys.argv[1]]
interrupts = {"mrt": KeyboardInterrupt, "mi": (KeyboardInterrupt, RuntimeError)}  # as Dr.Jit has them
render()
start = time.perf_counter()
render()
length = time.perf_counter() - start
found = []
for part in range(24):
    killer = threading.Timer(length * part / 20, os.kill, (os.getpid(), signal.SIGINT))
    try:
        killer.start()
        render()
        found.append("done")
        killer.join()
        time.sleep(0.01)
    except interrupts[sys.argv[1]]:
        found[part:] = ["interrupted"]
    except Exception as error:
        found.append(repr(error))
    killer.join()
print(set(found) - {"done"})
"""


PROGRAMS = {
    "first renders of several threads": (THREADS, "", "True 4\n"),
    "a scene that another thread edits": (EDITED, "mrt", "True True\n"),
    "the same by mi.render": (EDITED, "mi", "True True\n"),
    "Ctrl-C in mi.render": (INTERRUPTED, "mi", "{'interrupted'}\n"),
    "Ctrl-C in a render is always an interrupt": (INTERRUPTED, "mrt", "{'interrupted'}\n"),
}


@pytest.mark.parametrize(
    "name", but_slow(PROGRAMS, {"a scene that another thread edits", "the same by mi.render"})
)
@pytest.mark.parametrize("attempt", range(ROUNDS))
def test_threads_and_interrupts(run_python, name, attempt):
    code, door, said = PROGRAMS[name]
    assert run_python(code, door).stdout == said
