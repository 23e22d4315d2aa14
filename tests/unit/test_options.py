"""The table of options: what is taken, what is refused and how the refusal reads."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
from cases import Cases
from hypothesis import given
from hypothesis import strategies as st

import mrt_mitsuba as mrt
from mrt_mitsuba.adaptive.target import Target
from mrt_mitsuba.command import options, tools
from mrt_mitsuba.command.options import Options, parse
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.files import LAYERS
from mrt_mitsuba.rendering.settings import RenderSettings

accepted = Cases()
accepted("o 9 width=1 height=65536", {"scene": 9, "width": 1, "height": 65536})
accepted("o 1 focaldist=2 focalrange=.5", {"scene": 1, "focaldist": 2.0, "focalrange": 0.5})
accepted("o fresnel=dielectric variant=scalar_rgb", {"fresnel": "dielectric", "variant": "scalar_rgb"})
accepted("o layers=all aamode=none", {"layers": tuple(LAYERS), "aamode": "none"})
accepted("o motion=0.1,-2,3e-1 motionsamples=4", {"motion": (0.1, -2.0, 0.3), "motionsamples": 4})
accepted("o memory=1.5gib", {"memory": 3 * 2**29})
accepted("o scene=a=b.xml", {"scene": "a=b.xml"})
accepted(
    "o scene=a.OBJ camera=1,2,3 target=0,0,.5 up=0,0,1 fov=45",
    {"scene": "a.OBJ", "camera": (1, 2, 3), "target": (0, 0, 0.5), "up": (0, 0, 1)} | {"fov": 45.0},
)
accepted("o target=2%", {"target": Target(0.02, relative=True)})
accepted("o a.xml glow=3 fov=2", {"scene": "a.xml", "params": {"glow": "3", "fov": "2"}})
accepted("o integrator=path plugins=a.py plugins=b", {"integrator": "path", "plugins": ("a.py", "b")})
accepted("dir.v1/o.v2", {"filename": "dir.v1/o.v2"})


@pytest.mark.parametrize(("arguments", "values"), accepted)
def test_accepted(arguments, values):
    parsed = parse(arguments.split())
    assert {name: getattr(parsed, name) for name in values} == values
    others = {"filename", *values}
    for field in dataclasses.fields(Options):
        if field.name not in others:
            assert getattr(parsed, field.name) == field.default


refused = Cases()
# arguments, and what the message must hold
refused("width=1e3", "width=1e3: must be a whole number")
refused("width=\u0663", "whole number")
refused("aamode=sobal", "aamode=sobal: must be none, luma")
refused(["out", "variant=llvm ad"], "must be a name such as llvm_ad_rgb")
refused("layers=depth,depth", "each once")
refused("motion=1,2,nan", "three finite numbers")
refused("memory=4X", "bytes with an optional unit")
refused("scene=", "path of a file")
refused("widht=3", "unknown option 'widht'. Did you mean width?")
refused("scene=a.xml glow=1 glow=2", "glow is given twice")
refused("zzz=3", "unknown option 'zzz'. 'mrt --help' lists the options.")
refused("filename=x", "unknown option 'filename'")
refused("1 2", "unexpected argument '2'")
refused("1 scene=a.xml", "both SCENE 1 and scene=a.xml")
refused("camera=1,2,3", "camera is of use only with an OBJ file: scene=PATH.obj")
refused("three", "('mrt scenes' lists them); a file is scene=PATH")
refused(["width=3"], "FILENAME is missing before width=3")
refused(["out.png"], "FILENAME has no extension: write out format=png")
refused(["--fast"], "unknown option --fast")
refused(["folder/"], "names no file")
refused(["a\0b"], "names no file")


@pytest.mark.parametrize(("arguments", "text"), refused)
def test_refused(arguments, text):
    words = ["out", *arguments.split()] if isinstance(arguments, str) else arguments
    with pytest.raises(UsageError, match=re.escape(text)) as caught:
        parse(words)
    assert "\n" not in str(caught.value)


@pytest.mark.fuzz
@given(st.sampled_from(sorted(options.TABLE)), st.text(max_size=20))
def test_any_text_is_taken_or_refused_in_one_line(name, text):
    """Whatever is typed, the answer is a value that the table's own check accepts, or a UsageError."""
    extra = ["motion=1,0,0"] if name.startswith("motion") and name != "motion" else []
    extra += ["scene=a.obj"] if name in ("camera", "target", "up", "fov") else []
    try:
        value = getattr(parse(["out", f"{name}={text}", *extra]), name)
    except UsageError as error:
        assert name in str(error)
    else:
        assert getattr(Options(filename="o", **{name: value}), name) == value


given_in_python = Cases()
given_in_python("focaldist", 2, 2.0)
given_in_python("layers", ["depth"], ("depth",))
given_in_python("motion", [1, 2, 3], (1.0, 2.0, 3.0))
given_in_python("memory", "4G", 2**32)
for value in (640.0, True, "640"):
    given_in_python("width", value, UsageError)
for value in (math.nan, "2"):
    given_in_python("focaldist", value, UsageError)
for value in (3, (1, 2)):
    given_in_python("motion", value, UsageError)
given_in_python("aamode", 3, UsageError)
given_in_python("target", "2.5%", Target(0.025, relative=True))
given_in_python("target", Target(0.1), Target(0.1))
for value in ("x%", "0%", "inf%", "%", " 2%", 0, True):
    given_in_python("target", value, UsageError)


@pytest.mark.parametrize(("name", "value", "taken"), given_in_python)
def test_values_from_python(name, value, taken):
    if taken is not UsageError:
        assert getattr(RenderSettings(**{name: value}), name) == taken
        return
    with pytest.raises(UsageError, match=name) as caught:
        RenderSettings(**{name: value})
    assert isinstance(caught.value, ValueError)


def test_usage_names_every_option_with_its_default():
    text = tools.usage()
    assert max(map(len, text.splitlines())) <= options.WIDTH
    entries = re.split(r"\n  (?=\w+=)", text.partition("\n\ncommands")[0])[1:]
    assert {entry.partition("=")[0] for entry in entries} == options.TABLE.keys()
    assert all(re.search(r"\(default:\s+[^)]+\)$", entry) for entry in entries)
    assert "(default: 800)" in text


@pytest.mark.parametrize("function", [RenderSettings.of, mrt.prepare])
def test_an_unknown_option_is_named_with_the_nearest(function):
    with pytest.raises(TypeError, match="did you mean width"):
        function(widht=8)
