"""The benchmark: its file, its schema, its comparison."""

from __future__ import annotations

import copy
import json

import pytest

from mrt_mitsuba.validation import bench
from mrt_mitsuba.validation.studies import rivals

KINDS = {"number": (int, float), "integer": int, "string": str}


def _fits(value, schema) -> bool:
    """Return whether a value has as much of a JSON schema as the benchmark uses."""
    if "const" in schema:
        return value == schema["const"]
    if schema["type"] == "array":
        return isinstance(value, list) and all(_fits(item, schema["items"]) for item in value)
    if schema["type"] != "object":
        return isinstance(value, KINDS[schema["type"]])
    known, others = schema.get("properties", {}), schema.get("additionalProperties")
    return set(known) <= value.keys() and all(
        _fits(item, known.get(key) or others) for key, item in value.items() if key in known or others
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "new" / "bench.json"
    assert bench.main(["--quick", "--out", str(path)]) == 0
    return path


def test_file_follows_the_schema_and_a_broken_one_does_not(found):
    run = json.loads(found.read_text())
    assert _fits(run, bench.SCHEMA)
    for where, name in (
        (lambda run: run["scenes"]["3"], "floor"),
        (lambda run: run["scenes"]["3"]["each_kernel"][0], "launches"),
        (lambda run: next(iter(run["rivals"].values())), "median"),
    ):
        broken = copy.deepcopy(run)
        del where(broken)[name]
        assert not _fits(broken, bench.SCHEMA)
    assert set(run["scenes"]) == {"3"}
    assert run["scenes"]["3"]["rays"]["camera"] == 80 * 60 * 4
    assert all(run["scenes"]["3"][name] > 0 for name in bench.COMPARED)
    tracing = [k for k in run["scenes"]["3"]["each_kernel"] if k["kind"] == "traces rays"]
    assert [k["size"] for k in tracing] == [80 * 60 * 4] and tracing[0]["seconds"] > 0
    assert len(run["rivals"]) == rivals.PAIRS


def test_comparison_prints_ratios(found):
    before = bench.read(found)
    now = copy.deepcopy(before)
    now["scenes"]["3"]["render"] *= 2
    name = next(iter(now["rivals"]))
    now["rivals"][name] |= {"median": 3 * before["rivals"][name]["median"], "goal": 0.0}  # out of reach
    lines = bench.table(now, before).splitlines()
    line = lines[lines.index("") - 1]
    assert line.startswith("3") and "(2.00x)" in line and line.count("(1.00x)") == 4
    (line,) = (line for line in lines if line.startswith(name))
    assert "(3.00x)" in line and line.endswith("0 slower")
    assert "x)" not in bench.table(now)
    now["rivals"][name] |= {"low": 0.9, "high": 1.1, "goal": 1.0}
    assert "1 open" in bench.table(now)


@pytest.mark.parametrize(
    "text", ["{}", "[1]", "no json", '{"schema": 1, "scenes": {}}', '{"schema": 2, "scenes": {}}']
)
def test_a_file_of_another_kind_is_refused(text, tmp_path, capsys):
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(SystemExit):
        bench.main(["--compare", str(tmp_path / "other.json"), "--out", str(tmp_path / "b.json")])
    assert "cannot compare" in capsys.readouterr().err and not (tmp_path / "b.json").exists()


def test_a_place_that_cannot_be_written_is_found_before_measuring(tmp_path, capsys):
    (tmp_path / "file").touch()
    (tmp_path / "folder.json").mkdir()
    for out, reason in (("file/b.json", "cannot make the folder"), ("folder.json", "it is a folder")):
        assert bench.main(["--out", str(tmp_path / out)]) == 1
        text, errors = capsys.readouterr()
        assert text == "" and errors.startswith("make bench: ") and reason in errors


def test_schema_is_printed(capsys):
    assert bench.main(["--schema"]) == 0
    assert json.loads(capsys.readouterr().out) == bench.SCHEMA


def test_the_place_of_kernels_can_be_chosen_in_time(run_python):
    """Dr.Jit reads it once, when it is imported."""
    modules = (
        "from mrt_mitsuba.validation import bench, cli; from mrt_mitsuba.validation.tools import commands"
    )
    assert run_python(f"import sys; {modules}; print('drjit' in sys.modules)").stdout == "False\n"
