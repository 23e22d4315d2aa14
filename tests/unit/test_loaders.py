"""What ``mrt.register()`` makes of Mitsuba's loaders and of changes by ``mi.traverse``."""

from __future__ import annotations

import threading
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from nodes import scene_xml, sensor

import mrt_mitsuba as mrt
from mrt_mitsuba import runtime

pytestmark = pytest.mark.usefixtures("variant")

OURS = "<shape type='sphere'><bsdf type='mrt_bsdf'/></shape>"
STOCK = "<shape type='sphere'/>"
INCLUDING = "<include filename='inner.xml'/>"


@pytest.mark.parametrize(
    ("inside", "parallel"),
    [(OURS, False), (INCLUDING, False), (STOCK, None)],
    ids=["ours", "perhaps ours, in another file", "stock"],
)
def test_files_that_may_have_our_plugins_are_not_loaded_in_parallel(inside, parallel, monkeypatch, tmp_path):
    """Mitsuba makes Python objects inside each other then, and Dr.Jit's messages may wait for ever."""
    (tmp_path / "inner.xml").write_text(scene_xml(OURS, ""))
    (tmp_path / "outer.xml").write_text(scene_xml(inside))
    original = mi.load_file
    asked: list[Any] = []

    def load_file(path: str, **options: Any) -> Any:
        asked.append(options.get("parallel"))
        return original(path, **options)

    monkeypatch.setattr(mi, "load_file", load_file)
    mrt.register()
    mi.load_file(str(tmp_path / "outer.xml"))
    assert asked == [parallel]


def change(parameters: Any) -> None:
    parameters["radiance.value"] = 2.0


def changes(parameters: Any) -> None:
    parameters.update({"radiance.value": 3.0})


def render(parameters: Any) -> None:
    scene = mi.load_dict({"type": "scene", "sensor": sensor([0, 0, 1], [0, 0, 0], (4, 3))})
    np.array(mi.render(scene, parameters, 0, mi.load_dict({"type": "mrt_whitted"}), spp=1))


@pytest.mark.parametrize("act", [change, changes, render])
def test_changes_and_renders_wait_for_a_render_in_another_thread(act):
    """Dr.Jit ends the process where both happen at once."""
    parameters = mi.traverse(mi.load_dict({"type": "constant", "radiance": 1.0}))
    act(parameters)  # its kernels are there afterwards
    done = threading.Event()
    thread = threading.Thread(target=lambda: (act(parameters), done.set()))
    with runtime.render_lock:
        thread.start()
        assert not done.wait(0.3)  # without the lock, it takes less than a thousandth of that
    assert done.wait(60)
    thread.join()
