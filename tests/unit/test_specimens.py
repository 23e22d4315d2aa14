"""Plugins with a mistake fail the laws that are there for it, and faults as large as documented are found."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
from cases import Cases
from PIL import Image
from unit.specimens import KINDS, MISTAKES, exceeded

from mrt_mitsuba import runtime

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_exceeds_its_own_figures(name, variant, capsys):
    mistake = MISTAKES[name]
    given = mistake.kind.faulty(mistake.nested, **mistake.changes)
    check = mistake.kind.check(given, quick=True, only=mistake.laws)
    assert exceeded(check) == mistake.figures, str(check)
    for law in (check.laws[name] for name in check.failed):
        assert law.why and law.note and not law.skipped
        assert "Error" not in law.output, law.output
        if law.snippet and isinstance(given, dict):  # a program by itself
            exec(compile(law.snippet, "snippet", "exec"), {})
            runtime.use(variant)
            assert law.output and capsys.readouterr().out


FOUND = Cases()
for kind_of_plugin in KINDS.values():
    for its_law in kind_of_plugin.laws.values():
        for known in its_law.faults:
            takes_a_full_check = bool(np.isinf(known.quick))
            FOUND(kind_of_plugin, known, name=known.what, slow=takes_a_full_check)


@pytest.mark.parametrize(("kind", "fault"), FOUND)
def test_faults_three_times_as_large_as_documented_are_found(kind, fault):
    check = kind.check_fault(fault, quick=np.isfinite(fault.quick))
    assert f"{fault.law}.{fault.criterion}" in exceeded(check), str(check)


PLOTTED = [("BSDF", "sampling"), ("BSDF", "energy"), ("BSDF", "reciprocity"), ("shape", "normals")]


@pytest.mark.parametrize(("kind", "law"), PLOTTED)
def test_pages_show_plots(kind, law, tmp_path):
    check = KINDS[kind].check_fault(KINDS[kind].laws[law].faults[0], quick=True)
    check.save(tmp_path)
    page = (tmp_path / "index.html").read_text()
    plots = re.findall(r'alt="Plot of (\w+)" src="data:image/png;base64,([^"]+)"', page)
    assert [name for name, _ in plots] == [law]
    image = np.array(Image.open(io.BytesIO(base64.b64decode(plots[0][1]))))
    assert image.std() > 5  # something is drawn


# Lamps, and shapes that are otherwise in another variant or place, are in tests of their own
ELSEWHERE = {
    "BSDF": set(),
    "shape": {"scale.answer", "scale.off", "variants.answer", "variants.off"},
    "emitter": {"sampling.light"},
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_figure_has_a_specimen(kind):
    laws = KINDS[kind].laws
    known = {f"{law.name}.{fault.criterion}" for law in laws.values() for fault in law.faults}
    known |= ELSEWHERE[kind].union(*(m.figures for m in MISTAKES.values() if m.kind is KINDS[kind]))
    assert known == {f"{name}.{figure}" for name, law in laws.items() for figure in law.criteria}
