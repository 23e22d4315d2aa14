"""Programs that never use our plugins: ``mrt.register()`` leaves Mitsuba to them as it was."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mrt_mitsuba import runtime

pytestmark = pytest.mark.skipif(runtime.obstacle(runtime.FAST) is not None, reason="needs LLVM")

LOOK = """
import inspect, pickle, sys
import mrt_mitsuba as mrt
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")

def functions():
    yield mi, ("render", "load_dict", "load_file", "load_string")
    yield mi.SceneParameters, ("update", "__setitem__")
    yield mi.AdjointIntegrator, ("render",)

def tried(function, *arguments):
    try:
        return function(*arguments)
    except Exception as error:
        return type(error).__name__

def refusal(function, *arguments):
    try:
        function(*arguments)
    except Exception as error:
        return error

def look():
    facts = {}
    for owner, names in functions():
        for name in names:
            function = getattr(owner, name)
            facts[name, str(owner)] = (
                *(getattr(function, key) for key in ("__name__", "__qualname__", "__module__", "__doc__")),
                str(tried(inspect.signature, function)),
            )
    nothing = mi.traverse(mi.load_dict({"type": "sphere"}))
    nothing.__setitem__(key="to_world", value=mi.Transform4f())
    nothing.update(values={"to_world": mi.Transform4f()})
    # What is wrong with a call, in words of Mitsuba's or Python's
    facts["wrong calls"] = [
        (type(error).__name__, str(error))
        for owner, names in functions() for name in names for given in [(), (3,), (3, 4)]
        for error in [refusal(getattr(owner, name), *given)]
    ]
    facts["arguments"] = inspect.getfullargspec(mi.render), inspect.getfullargspec(mi.SceneParameters.update)
    facts["pickle"] = pickle.dumps(mi.render), pickle.dumps(mi.SceneParameters.update)
    assert pickle.loads(facts["pickle"][0]) is mi.render
    return facts

def same():
    return [getattr(owner, name) for owner, names in functions() for name in names]
"""

NAMES = """
before, functions_before = look(), same()
mrt.register()
after = look()
print(*[key for key in before if before[key] != after[key]], sep="\\n")
mrt.register(guard=False)
print(all(a is b for a, b in zip(same(), functions_before, strict=True)))
print("render" in vars(mi.AdjointIntegrator), mi.render is sys.modules["mitsuba.python.util"].render)
mrt.register()
print(all(a is not b for a, b in zip(same(), functions_before, strict=True)))
mi.render = theirs = lambda *given: None
mrt.register(guard=False)
print(mi.render is theirs)
"""


def test_names_signatures_and_pickles_stay(run_python):
    """And with ``guard=False`` the functions are Mitsuba's own again, or those that others put there."""
    assert run_python(LOOK + NAMES).stdout.split("\n") == ["", "True", "False True", "True", "True", ""]


CALLS = """
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi
text = '''<scene version="3.0.0">
    <default name="source" value="1"/><default name="kind" value="sphere"/>
    <shape type="$kind"><float name="radius" value="$source"/></shape></scene>'''
with open("a.xml", "w") as file:
    file.write(text)

def radius(scene):
    return round(float(scene.bbox().max[0]), 5)

print(radius(mi.load_file("a.xml", source="3")), radius(mi.load_file(path="a.xml", source="2")))
print(radius(mi.load_string(value=text)), radius(mi.load_string(text, source="4", parallel=False)))
ball = {"type": "scene", "a": {"type": "sphere", "radius": 5.0}}
print(radius(mi.load_dict(dict=ball)), radius(mi.load_dict(ball, True, optimize=False)))
for load in (mi.load_dict, mi.load_file):
    for arguments in ((), (3,)):
        try:
            load(*arguments)
        except TypeError as error:
            print(str(error).split("(")[0])
"""


def test_loaders_take_all_that_they_took(run_python):
    lines = run_python(CALLS).stdout.splitlines()
    assert lines[:3] == ["3.0 2.0", "1.0 4.0", "5.0 5.0"]
    assert lines[3:] == [*["load_dict"] * 2, *["load_file"] * 2]


FILES = """
import os, resource
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi
os.mkdir("folder")
os.symlink("/dev/zero", "zeros.xml")
resource.setrlimit(resource.RLIMIT_AS, (2**33, 2**33))
for path in ("/dev/zero", "zeros.xml", "folder", "missing.xml"):
    try:
        print(path, len(mi.load_file(path).shapes()))
    except RuntimeError as error:
        print(path, "refused")
    except MemoryError:
        print(path, "refused")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 2**21, path  # KiB
"""


REFUSED = ("/dev/zero", "zeros.xml", "folder", "missing.xml")


def test_files_are_read_no_further_than_needed(run_python):
    """Zeros without end were read until memory ended; ``run_python`` waits five minutes."""
    lines = run_python(FILES).stdout.splitlines()
    assert lines == [f"{path} refused" for path in REFUSED]


THREADS = """
import threading
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi

class Threaded(mi.SamplingIntegrator):
    def __init__(self, props):
        mi.SamplingIntegrator.__init__(self, props)
        self.inner = mi.load_dict({"type": "direct"})

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        found = []
        def work():
            found.append(mi.render(scene, integrator=self.inner, spp=2))
            parameters = mi.traverse(scene)
            key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))
            parameters[key] = [0.1, 0.2, 0.3]
            parameters.update()
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        return found[0]

    def sample(self, *arguments):
        return self.inner.sample(*arguments)

mi.register_integrator("threaded", Threaded)
mi.load_dict({"type": "mrt_bsdf"})  # there are some of ours
for kind in ("diffuse", "mrt_bsdf"):
    key = "reflectance" if kind == "diffuse" else "diffuse_reflectance"
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "threaded"}, "light": {"type": "constant"},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 6}},
        "ball": {"type": "sphere", "center": [0, 0, 4],
                 "bsdf": {"type": kind, key: {"type": "rgb", "value": 0.5}}}})
    print(mi.render(scene).shape)
    around = {"type": "aov", "aovs": "depth:depth", "nested": scene.integrator()}
    print(mi.render(scene, integrator=mi.load_dict(around), spp=2).shape)
"""


def test_an_integrator_may_render_in_threads_of_its_own(run_python):
    """It waited for ever for its own render to end, also inside of ``aov``."""
    assert run_python(THREADS).stdout.splitlines() == ["(6, 8, 3)", "(6, 8, 4)"] * 2


WRAPPERS = """
import functools
import mrt_mitsuba as mrt
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
calls = []

def counted(function):
    @functools.wraps(function)
    def call(*args, **given):
        calls.append(function.__name__)
        return function(*args, **given)
    return call

mi.load_dict, mi.load_string = counted(mi.load_dict), counted(mi.load_string)
theirs = mi.load_dict
mrt.register()
cone = {"type": "mrt_cone", "apex": [0, 1, 0], "base_center": [0, 0, 0], "segments": 3}
scene = {"type": "scene"} | {f"c{k}": cone | {"radius": 1 + k / 1500} for k in range(1500)}
print(len(mi.load_dict(scene).shapes()), "load_dict" in calls)
mi.load_dict = counted(mi.load_dict)  # and around ours
calls.clear()
mrt.register()
print(len(mi.load_dict(scene).shapes()), calls.count("load_dict"))
mrt.register(guard=False)
calls.clear()
print(len(mi.load_dict({"type": "scene", "a": cone}, parallel=False).shapes()), calls.count("load_dict"))
mrt.register()
print(len(mi.load_dict(scene).shapes()))
"""


@pytest.mark.slow
def test_somebody_elses_wrapper_is_not_taken_for_ours(run_python):
    """Without ours, so many cones end in a RecursionError."""
    assert run_python(WRAPPERS).stdout.splitlines() == ["1500 True", "1500 2", "1 2", "1500"]


KINDS_OF_WRAPPERS = """
import functools, sys
import mrt_mitsuba as mrt
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
home = sys.modules["mitsuba.python.util"]
theirs = home.render

def plain(function):
    return lambda *args, **given: function(*args, **given)

def in_itself(function):
    def call(*args, **given):
        return function(*args, **given)
    call.__wrapped__ = call
    return call

def looking_up(function):
    return functools.wraps(function)(lambda *args, **given: home.render(*args, **given))

film = {"type": "hdrfilm", "width": 4, "height": 4}
scene = {"type": "scene", "integrator": {"type": "mrt_whitted"}, "light": {"type": "mrt_light"},
         "sensor": {"type": "perspective", "film": film}}
for wrap in (plain, in_itself, looking_up):
    mi.render = wrapped = wrap(theirs)
    mrt.register()
    print(mi.render(mi.load_dict(scene), spp=1).shape, mi.render is not wrapped)
    mrt.register(guard=False)
    print(mi.render is wrapped, home.render is theirs)
"""


def test_wrappers_of_any_kind_stay_and_are_found_again(run_python):
    """One that has itself inside was followed for ever, and one that looks Mitsuba's up called itself."""
    lines = run_python(KINDS_OF_WRAPPERS).stdout.splitlines()
    assert lines == ["(4, 4, 3) True", "True True"] * 3


STORM = """
import random, signal, threading
import mrt_mitsuba as mrt
import mitsuba as mi
mi.set_variant("scalar_rgb")
mrt.register()
parameters = mi.traverse(mi.load_dict({"type": "sphere"}))
key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))
signal.signal(signal.SIGALRM, signal.default_int_handler)
for _ in range(1000):
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(2e-5, 2e-4))
        while True:
            parameters[key] = 0.3
    except KeyboardInterrupt:
        pass
thread = threading.Thread(target=lambda: parameters.update({key: 0.2}), daemon=True)
thread.start()
thread.join(20)
print(thread.is_alive())
"""


def test_interrupts_leave_no_lock_held(run_python):
    """One of 23 did, between taking it and noting so; other threads then waited for ever."""
    assert run_python(STORM).stdout.split() == ["False"]


SWITCH = """
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi
for variant in ("scalar_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)  # by Mitsuba's own door
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film},
                          "light": {"type": "mrt_light"}})
    try:
        mi.load_dict({"type": "ptracer"}).render(scene, scene.sensors()[0], spp=1)
    except NotImplementedError as error:
        print(variant, str(error).split(":")[0])
"""


def test_changes_follow_the_variant(run_python):
    names = re.findall(
        r"((?:scalar|llvm)_\w+) mrt_light", run_python(SWITCH).stdout
    )  # among what Mitsuba logs
    assert names == ["scalar_rgb", "llvm_ad_mono", "llvm_ad_rgb"]


INTERRUPT = """
import os, signal, sys, threading
import mrt_mitsuba as mrt
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
render = mi.render
if len(sys.argv) > 3:  # somebody else's, which does not say what it is around
    mi.render = lambda *args: render(*args)
mrt.register()
box = mi.cornell_box()
nested = {"type": sys.argv[1]}
scene = mi.load_dict(box | {"integrator": {
    "type": "mrt_adaptive", "target": 1e-6, "max_spp": 10**6, "max_seconds": 60.0, "nested": nested}})
threading.Timer(float(sys.argv[2]), lambda: os.kill(os.getpid(), signal.SIGINT)).start()
try:
    mi.render(scene)
except BaseException as error:
    print(type(error).__name__, signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""


@pytest.mark.parametrize("nested", ["path"])
@pytest.mark.parametrize("delay", [0.3, 2.0])
def test_ctrl_c_during_mrt_adaptive_is_a_keyboard_interrupt(run_python, nested, delay):
    lines = run_python(INTERRUPT, nested, str(delay)).stdout.splitlines()
    assert lines[-1].endswith("KeyboardInterrupt True")  # after what Mitsuba logs


def test_ctrl_c_passes_a_wrapper_without_a_signature(run_python):
    """Ours did not find the scene among the arguments of such a function, and stood aside."""
    lines = run_python(INTERRUPT, "path", "2.0", "wrapped").stdout.splitlines()
    assert lines[-1].endswith("KeyboardInterrupt True")


def test_every_change_is_on_the_page() -> None:
    from mrt_mitsuba.mitsuba_changes import PATCHES

    page = (Path(__file__).resolve().parents[2] / "docs" / "plugins.rst").read_text()
    for change in PATCHES:
        assert f"``{change.where}``" in page
        assert change.what
        assert change.why


NESTED = """
import sys
import mrt_mitsuba as mrt
mrt.register()
import mitsuba as mi
film = {"type": "hdrfilm", "width": 4, "height": 4}
inner = {"type": "mrt_adaptive", "nested": {"type": "path"}}
outer = {"type": sys.argv[1], "inner": inner} | ({"aovs": "d:depth"} if sys.argv[1] == "aov" else {})
scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}, "integrator": outer,
                      "light": {"type": "constant"}})
try:
    mi.render(scene, spp=4)
except Exception as error:
    while error:
        print(error)
        error = error.__cause__
"""


@pytest.mark.parametrize("outer", ["aov", "moment"])
def test_mrt_adaptive_says_that_it_is_no_part_of_another(run_python, outer: str) -> None:
    done = run_python(NESTED, outer)
    assert "mrt_adaptive: it is no part of another integrator" in done.stdout
