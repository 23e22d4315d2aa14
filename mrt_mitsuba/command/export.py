"""``mrt export``: a numbered scene as Mitsuba XML."""

from __future__ import annotations

from mrt_mitsuba.command.options import parse
from mrt_mitsuba.errors import UsageError

FORM = "mrt export SCENE --xml PATH [--stock]"


def run(words: list[str]) -> int:
    """Write a scene; return the exit code."""
    flavor = "stock" if "--stock" in words else "mrt"
    if flavor == "stock":
        words.remove("--stock")
    if len(words) != 3 or words[1] != "--xml":
        raise UsageError(f"write {FORM}")
    number, path = parse(["export", words[0]]).scene_number, words[2]
    if not path:
        raise UsageError(f"PATH is empty: write {FORM}")
    from mrt_mitsuba.output.replacing import check_target

    check_target(path)
    from mrt_mitsuba.scene.export import write_xml

    print(f"Wrote {' and '.join(write_xml(number, path, flavor=flavor))}")
    return 0
