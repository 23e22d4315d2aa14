"""``log=``: records on the error output."""

from __future__ import annotations


def test_levels_log_more_and_more(mrt_command) -> None:
    silent, info, debug = (
        mrt_command("a", "0", "width=16", "height=12", "quiet=1", f"log={level}").stderr.splitlines()
        for level in ("warn", "info", "debug")
    )
    assert not silent
    for what in ("scene 0 loaded in", "rendering: 192 pixels in", "kernels: compiled in", "wrote"):
        assert sum(what in line for line in info) >= 1
    assert sum("wrote" in line for line in info) == 2  # PNG and EXR
    assert any("rays, at most" in line for line in debug)
    assert not any("rays, at most" in line for line in info)
