"""``mrt export``: a scene as Mitsuba XML."""

from __future__ import annotations

from mrt_mitsuba.command.options import parse
from mrt_mitsuba.command.registry import COMMANDS
from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.scene.model import MODEL_OPTIONS, is_obj


def run(words: list[str]) -> int:
    """Write a scene; return the exit code."""
    usage = f"Usage: mrt export {COMMANDS['export'].form}"
    rest = [word for word in words if word != "--stock"]
    if len(words) - len(rest) > 1:
        raise UsageError(f"--stock is given twice. {usage}")
    place = rest.index("--xml") if "--xml" in rest else len(rest)
    path, rest = "".join(rest[place + 1 : place + 2]), rest[:place] + rest[place + 2 :]
    if not path or not rest:
        raise UsageError(f"give a scene and --xml PATH. {usage}")
    options = parse(["export", *rest])
    taken = {"scene", "width", "height", "fresnel", *MODEL_OPTIONS, *(options.params or ())}
    strange = {word.partition("=")[0] for word in rest if "=" in word} - taken
    if strange:  # what is said of the render, which is not in the file
        raise UsageError(f"{min(strange)} is of no use to mrt export. {usage}")
    from mrt_mitsuba.output.replacing import check_target
    from mrt_mitsuba.scene.export import write_xml

    scene = options.scene_number if options.scene is None else options.scene
    check_target(path, [] if options.scene is None else [options.scene])
    given = {name: getattr(options, name) for name in ("width", "height", "fresnel", "params")}
    model = options.model() if is_obj(scene) else {}
    flavor = "stock" if "--stock" in words else "mrt"
    print(f"Wrote {' and '.join(write_xml(scene, path, flavor=flavor, **given, **model))}")
    return 0
