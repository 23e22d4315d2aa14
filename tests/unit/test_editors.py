"""What editors know of the package without running it: names, signatures and types, by jedi and pyright."""

from __future__ import annotations

import inspect
import json
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_args

import jedi
import pytest

import mrt_mitsuba as mrt
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.rendering import settings
from mrt_mitsuba.rendering.settings import RenderOptions, RenderSettings

ROOT = Path(__file__).parents[2]


def test_an_option_is_a_field_a_type_and_a_parameter_of_render():
    """Names, order, defaults and types agree, and the names of a choice are those that are taken."""
    taken = dict(inspect.signature(mrt.render).parameters)
    assert taken.pop("scene").default == 0
    held = {field.name: field for field in fields(RenderSettings)}
    assert {name: each.default for name, each in taken.items()} == {n: f.default for n, f in held.items()}
    types = {name: each.annotation for name, each in taken.items()}
    assert types == {name: each.__forward_arg__ for name, each in RenderOptions.__annotations__.items()}
    for name, annotation in types.items():
        if not annotation.startswith("Literal"):
            continue
        names = get_args(eval(annotation.removesuffix(" | None"), vars(settings)))
        for each in names:
            assert getattr(RenderSettings(**{name: each}), name) == each
        with pytest.raises(UsageError) as refused:
            RenderSettings(**{name: "?"})
        assert all(each in str(refused.value) for each in names)


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with the package laid out as it is installed."""
    package = tmp_path_factory.mktemp("installed") / "mrt_mitsuba"
    shutil.copytree(ROOT / "mrt_mitsuba", package)
    for folder in ("plugins", "scenes_xml", "validation"):
        shutil.copytree(ROOT / folder, package / folder)
    return package.parent


def signature(folder: Path, call: str) -> str:
    """The first signature that jedi shows after a call's opening bracket."""
    script = jedi.Script(f"import mrt_mitsuba as mrt\n{call}", project=jedi.Project(folder))
    return script.get_signatures()[0].to_string()


@pytest.mark.parametrize(
    ("call", "parameters"),
    [
        ("mrt.render(", ["scene: Any=0", 'aamode: Literal["none", "luma"', "seed: int=0", "-> Result"]),
        ("mrt.prepare(", ["scene: Any=0", "-> Prepared"]),
        ("mrt.sweep(", ["out: StrPath", "grid: Values | None=None", "retries: int=2", "-> Table"]),
        ("mrt.check_bsdf(", ["quick: bool=False", "seed: int=0", "-> Check"]),
        ("mrt.check_emitter(", ["quick: bool=False"]),
        ("mrt.check_shape(", ["quick: bool=False"]),
        ("mrt.check_scene(", ["quick: bool=False", "-> SceneCheck"]),
        ("mrt.error_vs_time(", ["repeats: int", "-> Findings"]),
        ("mrt.filters.sobel_edges(", ["image"]),
    ],
)
def test_jedi_shows_signatures(installed, call, parameters):
    shown = signature(installed, call)
    assert all(each in shown for each in parameters), shown


def test_jedi_completes_names(installed):
    def names(code: str) -> set[str]:
        script = jedi.Script(f"import mrt_mitsuba as mrt\n{code}", project=jedi.Project(installed))
        return {each.name for each in script.complete()}

    assert set(mrt.__all__) - {"__version__"} <= names("mrt.")
    assert {"focaldist=", "focalrange="} <= names("mrt.render(3, focal")
    assert {"image", "layers", "save"} <= names("mrt.render(3).")


PROGRAM = """
import mrt_mitsuba as mrt
result = mrt.render(3, width=64, aamode="sobel", layers=["depth"])
result.image, result.error
mrt.render(3, widht=64)  # wrong
mrt.render(3, aamode="sobal")  # wrong
mrt.prepare(3, width=64, aamode="noise")(seed=1).save("a.exr")
mrt.prepare(3, widht=64)  # wrong
mrt.sweep(3, "out", grid={"aa": [1]}, aamode="sobel")
mrt.sweep(3, "out", gird={"aa": [1]})  # wrong
mrt.sweep(3, "out", aamode="sobal")  # wrong
mrt.check_bsdf({"type": "diffuse"}, quick=True).passed
mrt.check_shape({"type": "sphere"}, qiuck=True)  # wrong
mrt.error_vs_time(3, {}, reference={}, repaets=5)  # wrong
mrt.filters.sobel_edges(result.image)
mrt.filters.sobel_egdes(result.image)  # wrong
result.imgae  # wrong
mrt.rendr(3)  # wrong
"""


def test_pyright_finds_what_is_wrong_and_nothing_else(installed):
    program = installed / "program.py"
    program.write_text(PROGRAM)
    command = (sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, program)
    done = subprocess.run(command, capture_output=True, text=True, cwd=installed)
    found = json.loads(done.stdout)["generalDiagnostics"]
    errors = {each["range"]["start"]["line"] for each in found if each["severity"] == "error"}
    assert errors == {row for row, line in enumerate(PROGRAM.splitlines()) if "# wrong" in line}, done.stdout
