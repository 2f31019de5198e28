"""The rule of names (CONTRIBUTING.md): no bare participle names a variable, parameter, attribute, function or class."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WORDS = frozenset(("found", "given", "held", "kept", "made", "told"))
ROOTS = ("docs", "evaluation", "examples", "stereokit", "tests")
PENDING: tuple[str, ...] = ()
"""Folders and files that the rule does not cover yet."""


def bad_names(source: str) -> list[tuple[int, str]]:
    """Return (line, name) of every binding in `source` whose name, without underscores around it, is one of `WORDS`."""
    bindings = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            bindings.append((node.lineno, node.id))
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            bindings.append((node.lineno, node.attr))
        elif isinstance(node, ast.arg):
            bindings.append((node.lineno, node.arg))
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            bindings.append((node.lineno, node.name))
        elif isinstance(node, ast.alias) and node.asname is not None:
            bindings.append((node.lineno, node.asname))
        elif isinstance(node, ast.ExceptHandler) and node.name is not None:
            bindings.append((node.lineno, node.name))
        elif isinstance(node, (ast.MatchAs, ast.MatchStar)) and node.name is not None:
            bindings.append((node.lineno, node.name))
    return sorted((line, name) for line, name in bindings if name.strip("_").lower() in WORDS)


@pytest.mark.parametrize("root", ROOTS)
def test_no_bare_participle_is_a_name(root):
    paths = {path.relative_to(ROOT).as_posix(): path for path in (ROOT / root).rglob("*.py")}
    assert paths
    faults = []
    for name, path in sorted(paths.items()):
        if not name.startswith(PENDING):
            faults += [f"{name}:{line}: {word}" for line, word in bad_names(path.read_text(encoding="utf-8"))]
    assert not faults, "\n".join(faults)


def test_exceptions_exist():
    for name in PENDING:
        assert (ROOT / name).exists(), name


@pytest.mark.parametrize(
    "source",
    [
        "found = 1",
        "a, (b, *kept) = x",
        "for given in x: pass",
        "def f(*made): pass",
        "def f(x, *, told=None): pass",
        "lambda held: held",
        "def found(): pass",
        "class Held: pass",
        "self._found = 1",
        "import x as kept",
        "[made for made in x]",
        "with x as held: pass",
        "if (found := f()): pass",
        "class A:\n    given: int = 0",
        "match x:\n    case [1, *kept]: pass",
        "try: pass\nexcept E as told: pass",
    ],
)
def test_every_kind_of_binding_is_seen(source):
    assert len(bad_names(source)) == 1


def test_other_words_and_uses_are_not():
    assert bad_names("x = found.kept(given=made)\nheld_out = background = 1\n'found'") == []
