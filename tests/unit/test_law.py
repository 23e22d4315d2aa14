"""What a law makes of the errors that it is given."""

from __future__ import annotations

import ast
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mrt_mitsuba.validation.laws.bsdf import LAWS
from mrt_mitsuba.validation.laws.law import Outcome

FOLDER = Path(__file__).parents[2] / "validation"
ALONE = f"""
import sys
sys.modules["mrt_mitsuba"] = None  # importing it fails
sys.path.insert(0, {str(FOLDER)!r})
import laws
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
found = laws.check_bsdf({{"type": "twosided", "nested": {{"type": "diffuse"}}}}, quick=True)
print(found.failed)
found.save(sys.argv[1])
"""


def test_the_laws_stand_alone(tmp_path):
    """They import neither the rest of the package nor anything but what they say that they need."""
    known = {"mitsuba", "drjit", "numpy", "scipy", "jinja2", "matplotlib", *sys.stdlib_module_names}
    for file in (FOLDER / "laws").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 1 or str(node.module).split(".")[0] in known, file
            elif isinstance(node, ast.Import):
                assert {alias.name.split(".")[0] for alias in node.names} <= known, file
    words = [sys.executable, "-c", ALONE, tmp_path]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.stdout == "['components']\n", done.stderr
    assert (tmp_path / "index.html").is_file()


def weights() -> Outcome:
    return Outcome(LAWS["weights"])


@pytest.mark.parametrize("place", [0, 5, 9])
@pytest.mark.parametrize("wrong", [math.nan, math.inf, 1.0])
def test_one_error_of_many_that_is_no_number_or_too_large_breaks_the_law(place, wrong):
    errors = np.zeros(10)
    law = weights()
    law.check("density", errors)
    assert law.holds
    errors[place] = wrong
    law.check("density", errors)
    assert not law.holds
    assert law.worst.measured == pytest.approx(wrong, nan_ok=True)


def test_what_failed_is_not_saved_by_what_cannot_be_judged_later():
    law = weights()
    law.check("density", 1.0)
    law.skip("the rest makes no sense here")
    assert not law.holds and not law.skipped and law.verdict == "FAILS"
    assert "the rest makes no sense here" in law.note
    sound = weights()
    sound.check("density", 0.0)
    sound.skip("the rest makes no sense here")
    assert sound.holds and sound.verdict == "holds"


@pytest.mark.parametrize(("judged", "wrong", "share"), [(400, 100, 0.25), (1000, 100, 0.1), (50, 50, 1.0)])
def test_shares_are_of_what_was_judged(judged, wrong, share):
    law = Outcome(LAWS["sampling"])
    lanes = np.arange(1000)
    law.check("still", (lanes < wrong) | (lanes >= judged), where=lanes < judged)
    assert law.measured == pytest.approx(share)


def test_a_share_of_nothing_says_nothing():
    law = Outcome(LAWS["sampling"])
    law.check("still", np.ones(9, bool), where=np.zeros(9, bool))
    assert not law.parts


def test_a_law_that_measured_nothing_does_not_hold():
    law = weights()
    assert not law.holds
    law.skipped = "it makes no sense here"
    assert law.holds
