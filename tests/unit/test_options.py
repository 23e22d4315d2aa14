"""The table of options: what is taken, what is refused and how the refusal reads."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrt_mitsuba.command import options, tools
from mrt_mitsuba.command.options import Options, parse
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.output import LAYERS
from mrt_mitsuba.rendering.settings import RenderSettings


@pytest.mark.parametrize(
    ("arguments", "values"),
    [
        ("o 3", {"scene": 3}),
        ("o 9 width=1 height=65536", {"scene": 9, "width": 1, "height": 65536}),
        ("o 1 focaldist=2 focalrange=.5", {"scene": 1, "focaldist": 2.0, "focalrange": 0.5}),
        ("o fresnel=dielectric variant=scalar_rgb", {"fresnel": "dielectric", "variant": "scalar_rgb"}),
        ("o layers=all aamode=none", {"layers": tuple(LAYERS), "aamode": "none"}),
        ("o motion=0.1,-2,3e-1 motionsamples=4", {"motion": (0.1, -2.0, 0.3), "motionsamples": 4}),
        ("o memory=4G", {"memory": 4 * 2**30}),
        ("o memory=1.5gib", {"memory": 3 * 2**29}),
        ("o scene=a=b.xml", {"scene": "a=b.xml"}),
        (
            "o scene=a.OBJ camera=1,2,3 target=0,0,.5 up=0,0,1 fov=45 light=0,9,0",
            {"scene": "a.OBJ", "camera": (1, 2, 3), "target": (0, 0, 0.5), "up": (0, 0, 1)}
            | {"fov": 45.0, "light": (0, 9, 0)},
        ),
        ("o quiet=1 plan=show", {"quiet": True, "plan": "show"}),
        ("o quiet=no", {"quiet": False}),
        ("dir.v1/o.v2", {"filename": "dir.v1/o.v2"}),
        ("a=b", {"filename": "a=b"}),
    ],
)
def test_accepted(arguments: str, values: dict[str, object]) -> None:
    parsed = parse(arguments.split())
    assert {name: getattr(parsed, name) for name in values} == values
    others = {"filename", *values}
    for field in dataclasses.fields(Options):
        if field.name not in others:
            assert getattr(parsed, field.name) == field.default


BAD = [
    # argument(s), what the message must hold
    ("width=1e3", "width=1e3: must be a whole number"),
    ("width=" + "9" * 5000, "whole number"),
    ("width=\u0663", "whole number"),
    ("aa=0", "must be a whole number from 1 to 64"),
    ("aamode=sobal", "aamode=sobal: must be none, luma"),
    ("focaldist=nan", "must be a finite number, 0 or more"),
    ("focaldist=-1", "0 or more"),
    (["out", "variant=llvm ad"], "must be a name such as llvm_ad_rgb"),
    ("layers=depth,depth", "each once"),
    ("layers=depht", "a comma list out of depth, normal"),
    ("tonemap=gamma", "report or srgb"),
    ("motion=1,2,nan", "three finite numbers"),
    ("memory=4X", "bytes with an optional unit"),
    ("memory=1M", "at least 64M"),
    ("memory=infG", "bytes with"),
    ("seed=-1", "from 0 to 4294967295"),
    ("scene=", "path of a file"),
    ("quiet=2", "must be 1 or 0"),
    ("widht=3", "unknown option 'widht'. Did you mean width?"),
    ("--width=3", "Did you mean width?"),
    ("zzz=3", "unknown option 'zzz'. 'mrt help' lists the options."),
    ("filename=x", "unknown option 'filename'"),
    ("width=3 width=4", "width is given twice"),
    ("1 2", "unexpected argument '2'"),
    ("1 scene=a.xml", "both SCENE 1 and scene=a.xml"),
    ("motionsamples=4", "only with motion"),
    ("motion=1,0,0 motionmode=both", "frames or stratified"),
    ("camera=1,2,3", "camera is of use only with an OBJ file: scene=PATH.obj"),
    ("scene=a.xml texturing=standard", "texturing is of use only with an OBJ file"),
    ("scene=a.obj target=nan,0,0", "must be a positive number, or three"),
    ("scene=a.obj fov=0", "must be degrees, more than 0 and less than 180"),
    ("scene=a.obj up=0,0,0", "up must have a length"),
    ("scene=a.obj camera=1,2,3 target=1,2,3", "camera and target are the same point"),
    ("three", "('mrt scenes' lists them); a file is scene=PATH"),
    (["width=3"], "FILENAME is missing before width=3"),
    (["out.png"], "FILENAME has no extension: write out format=png"),
    (["--fast"], "unknown option --fast"),
    (["folder/"], "names no file"),
    (["a\0b"], "names no file"),
]


@pytest.mark.parametrize(("arguments", "text"), BAD)
def test_refused(arguments: str | list[str], text: str) -> None:
    words = ["out", *arguments.split()] if isinstance(arguments, str) else arguments
    with pytest.raises(UsageError, match=re.escape(text)) as caught:
        parse(words)
    assert "\n" not in str(caught.value)


@pytest.mark.fuzz
@given(st.sampled_from(sorted(options.TABLE)), st.text(max_size=20))
def test_any_text_is_taken_or_refused_in_one_line(name: str, text: str) -> None:
    """Whatever is typed, the answer is a value that the table's own check accepts, or a UsageError."""
    extra = ["motion=1,0,0"] if name.startswith("motion") and name != "motion" else []
    extra += ["scene=a.obj"] if name in ("texturing", "camera", "target", "up", "fov", "light") else []
    try:
        value = getattr(parse(["out", f"{name}={text}", *extra]), name)
    except UsageError as error:
        assert name in str(error)
    else:
        assert getattr(Options(filename="o", **{name: value}), name) == value


@pytest.mark.parametrize(
    ("name", "value", "taken"),
    [
        ("focaldist", 2, 2.0),
        ("focaldist", None, None),
        ("layers", ["depth"], ("depth",)),
        ("layers", "depth,normal", ("depth", "normal")),
        ("motion", [1, 2, 3], (1.0, 2.0, 3.0)),
        ("memory", "4G", 2**32),
        *(("width", value, UsageError) for value in (640.0, True, "640")),
        *(("focaldist", value, UsageError) for value in (math.nan, "2")),
        *(("motion", value, UsageError) for value in (3, (1, 2))),
        ("aamode", 3, UsageError),
        ("layers", [1], UsageError),
        ("seed", -1, UsageError),
    ],
)
def test_values_from_python(name: str, value: object, taken: object) -> None:
    if taken is not UsageError:
        assert getattr(RenderSettings(**{name: value}), name) == taken
        return
    with pytest.raises(UsageError, match=name) as caught:
        RenderSettings(**{name: value})
    assert isinstance(caught.value, ValueError)


def test_usage_names_every_option_with_its_default() -> None:
    text = tools.usage()
    assert max(map(len, text.splitlines())) <= tools.WIDTH
    entries = re.split(r"\n  (?=\w+=)", text.partition("\n\ncommands:")[0])[1:]
    assert [entry.partition("=")[0] for entry in entries] == list(options.TABLE)
    assert all(re.search(r"\(default:\s+[^)]+\)$", entry) for entry in entries)
    assert "(default: 800)" in text and "(default: from the scene)" in text
