"""The house: imports without cycles, private names at home, short statements. Ruff bounds functions.

The modules are read, not imported, so that imports inside functions and for type checkers count as well.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = {"mrt_mitsuba": "mrt_mitsuba"} | {
    name: f"mrt_mitsuba.{name}" for name in ("plugins", "scenes_xml", "validation")
}
# Modules of the package itself, that any package but those that stand alone may use
SHARED = {
    "errors",
    "interrupts",
    "llvm",
    "machine",
    "mitsuba_changes",
    "options",
    "runtime",
    "user_plugins",
}
STAND_ALONE = {"plugins", "laws"}

_INNER = ast.stmt | ast.excepthandler | ast.match_case  # of a statement, and with nodes of its own


class WithoutTypes(ast.NodeTransformer):
    """Takes out what is imported for type checkers only, such as the whole of the package by its root."""

    def visit_If(self, node: ast.If) -> ast.AST | None:
        test = node.test
        return None if isinstance(test, ast.Name) and test.id == "TYPE_CHECKING" else self.generic_visit(node)


SOURCES = {}
for folder, package in FOLDERS.items():
    for file in sorted((ROOT / folder).rglob("*.py")):
        parts = file.relative_to(ROOT / folder).with_suffix("").parts
        SOURCES[".".join([package, *(part for part in parts if part != "__init__")])] = file.read_text()
MODULES = {name: ast.parse(text) for name, text in SOURCES.items()}
MODULES["mrt_mitsuba"] = WithoutTypes().visit(MODULES["mrt_mitsuba"])
PACKAGES = {name for name in MODULES if any(other.startswith(f"{name}.") for other in MODULES)}


def imported(name: str) -> Iterator[tuple[str, str]]:
    """Yield pairs (module of the project, name taken from it, or none) that a module imports anywhere."""
    package = name if name in PACKAGES else name.rpartition(".")[0]
    for node in ast.walk(MODULES[name]):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, ""
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: -(node.level - 1) or None] if node.level else []
            source = ".".join([*parts, *([node.module] if node.module else [])])
            for alias in node.names:
                whole = f"{source}.{alias.name}"
                yield (whole, "") if whole in MODULES else (source, alias.name)


def graph() -> dict[str, set[str]]:
    """Return for each module the modules of the project that it imports anywhere."""
    return {name: {source for source, _ in imported(name) if source in MODULES} - {name} for name in MODULES}


def test_imports_make_no_cycle():
    TopologicalSorter(graph()).prepare()  # a CycleError names them


def package_of(module: str) -> str:
    """Return the name by which the architecture page calls the package of a module, "" for the root."""
    _, *parts = module.split(".")
    return "laws" if parts[:2] == ["validation", "laws"] else next(iter(parts), "")


PAGE = (ROOT / "docs" / "architecture.md").read_text()
TABLE = dict(re.findall(r"^\| `(?:\w+/)*(\w+)/` \|.*\| ([^|]+) \|$", PAGE, flags=re.MULTILINE))


@pytest.mark.parametrize("package", TABLE)
def test_a_package_imports_what_the_architecture_page_says(package):
    edges = {
        package_of(source)
        for name, sources in graph().items()
        for source in sources
        if package_of(name) == package
    }
    alone = package in STAND_ALONE
    expected = set(re.findall(r"\w+", TABLE[package]))
    assert edges - {package, *(() if alone else ("", *SHARED))} == expected


def test_the_architecture_page_has_every_package():
    assert {package_of(name) for name in MODULES} == {*TABLE, *SHARED, "", "__main__"}


def test_private_names_stay_at_home():
    wrong = [
        f"{name} takes {taken} from {source}"
        for name in MODULES
        for source, taken in imported(name)
        if source in MODULES and taken.startswith("_") and not taken.startswith("__")
    ]
    assert not wrong


def statements(trees: Iterable[ast.Module]) -> list[int]:
    """The numbers of syntax nodes of all statements but docstrings, without those of statements inside."""
    sizes = []
    for statement in (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.stmt)):
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            continue
        size = 0
        waiting: list[ast.AST] = [statement]
        while waiting:
            node = waiting.pop()
            size += not isinstance(node, ast.expr_context)
            waiting += [child for child in ast.iter_child_nodes(node) if not isinstance(child, _INNER)]
        sizes.append(size)
    return sizes


RENDERED = """
import sys
import mrt_mitsuba as mrt
mrt.render(3, width=16, height=12, variant="llvm_ad_rgb")
files = {getattr(module, "__file__", None) for module in [*sys.modules.values()]}
print(*(file for file in files if file and file.endswith(".py")), sep="\\n")
"""
REACH = 50_000  # nodes of what a plain render imports: take something out before you raise it


def test_a_plain_render_imports_little(run_python):
    files = {Path(line).resolve() for line in run_python(RENDERED).stdout.splitlines()}
    own = [file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py") if file in files]
    assert len(own) > 30
    assert sum(statements(ast.parse(file.read_text()) for file in own)) <= REACH


def swaps(node: ast.AST) -> bool:
    """Is a node an assignment of several values to as many names?"""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def test_a_statement_does_one_thing():
    """As much of a syntax tree in each as in codebases that are pleasant to read, and half as much again."""
    sizes = statements(map(ast.parse, SOURCES.values()))
    tests = statements(ast.parse(file.read_text()) for file in (ROOT / "tests").rglob("*.py"))
    assert max(sizes) <= 250
    assert sum(sizes) / len(sizes) <= 9.5
    assert sum(tests) / len(tests) <= 10.5


@pytest.mark.parametrize(
    ("is_one", "most"),
    [
        (lambda node: isinstance(node, ast.Lambda), 100),
        (lambda node: isinstance(node, ast.NamedExpr), 15),
        (lambda node: isinstance(node, ast.Name) and node.id == "Any", 550),
        (swaps, 150),
    ],
    ids=["lambdas", "named expressions", "Any", "tuple assignments"],
)
def test_few_are(is_one, most):
    assert sum(is_one(node) for text in SOURCES.values() for node in ast.walk(ast.parse(text))) <= most


def test_the_formatter_lays_all_code_out():
    assert [name for name, text in SOURCES.items() if "# fmt:" in text or "# ruff: noqa" in text] == []


def test_these_checks_can_fail():
    edges = graph()
    assert "mrt_mitsuba.files.layers" in edges["mrt_mitsuba.rendering.plan"]
    assert "mrt_mitsuba.plugins.variants" in edges["mrt_mitsuba.plugins.light"]
    packed = ast.parse("'Doc.'\na, b = f(1), 2\nif a:\n    g()")
    assert statements([packed]) == [9, 2, 3]
    assert [swaps(node) for node in packed.body] == [False, True, False]
