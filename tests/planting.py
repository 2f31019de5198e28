"""Flaws for mutation tests: a pattern of code, and the code that takes its place.

A pattern is Python code, an expression or statements. It matches code of the same shape, whatever the names of local
variables, the line breaks and the comments are: each local variable of the pattern stands for one local variable of
the code. So kernels carry no marks for their mutants, and a variable may be renamed without touching these. Names of
functions, attributes and modules count. Two wildcards leave parts of a pattern open, and their match can stand in the
new code: names of one underscore and a digit (``_1``) for any expression, ``...`` as a statement for any statements.
"""

from __future__ import annotations

import ast
import copy
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

__all__ = ["Mutant", "StaleMutant", "flawed"]


class StaleMutant(Exception):
    """The pattern of a mutant matches nothing, or more than one place."""


@dataclass(frozen=True)
class Mutant:
    """A flaw.

    Attributes
    ----------
    name : str
        What it does.
    module : str
        Its module, below ``stereokit``.
    old, new : str
        Pattern of the code, which must match once, and the code that replaces it.
    kind : str
        Class of the bug: the outcome that the check must have is that of the class.
    check : str
        The check that must catch it.
    function : str
        Function in which to look, where others have code of the same shape.
    """

    name: str
    module: str
    old: str
    new: str
    kind: str
    check: str
    function: str = ""


def flawed(source: str, mutant: Mutant) -> ast.Module:
    """Return the syntax tree of a module with the flaw.

    Raises
    ------
    StaleMutant
        If the pattern does not match exactly once.
    """
    tree = ast.parse(source)
    old, new = _code(mutant.old), _code(mutant.new)
    if isinstance(new, list) and not isinstance(old, list):
        old = [ast.Expr(old)]
    matches = list(_matches(tree, old, mutant.function))
    if len(matches) != 1:
        raise StaleMutant(f"old code must match once in {mutant.module}, got {len(matches)} times: {mutant.old!r}")
    place, key, size, names = matches[0]
    fresh = _Substitution(names).statements(new) if isinstance(new, list) else _Substitution(names).visit(new)
    if hasattr(fresh, "ctx"):
        target = getattr(place, key)
        fresh.ctx = getattr(target[size] if isinstance(size, int) else target, "ctx", fresh.ctx)
    if isinstance(old, list):
        body = getattr(place, key)
        body[size] = fresh if isinstance(fresh, list) else [ast.Expr(fresh)]
        if not body:
            body.append(ast.Pass())
    elif isinstance(size, int):
        getattr(place, key)[size] = fresh
    else:
        setattr(place, key, fresh)
    return ast.fix_missing_locations(tree)


def _code(text: str) -> Any:
    """Return an expression, or a list of statements."""
    text = textwrap.dedent(text).strip("\n")
    body = ast.parse(text).body
    alone = body[0] if len(body) == 1 else None
    return alone.value if isinstance(alone, ast.Expr) and not _is_gap(alone) else body


def _matches(tree: ast.Module, old: Any, function: str) -> Iterator[tuple[ast.AST, str, Any, dict[str, Any]]]:
    """Yield node, field, index or slice, and the meaning of the pattern's names, for each match."""

    def walk(node: ast.AST, local: frozenset[str], inside: bool) -> Iterator[Any]:
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            local |= _bound(node)
            inside |= getattr(node, "name", None) == function
        for key, value in ast.iter_fields(node):
            children = value if isinstance(value, list) else [value]
            if inside and isinstance(old, list) and isinstance(value, list):
                for first in range(len(value)):
                    for end in range(first + 1, len(value) + 1):
                        names: dict[str, Any] = {}
                        if isinstance(value[first], ast.stmt) and _same(old, value[first:end], names, local):
                            yield node, key, slice(first, end), names
                            break
            for index, child in enumerate(children):
                if not isinstance(child, ast.AST):
                    continue
                names = {}
                if inside and not isinstance(old, list) and _same(old, child, names, local):
                    yield node, key, index if isinstance(value, list) else None, names
                yield from walk(child, local, inside)

    yield from walk(tree, frozenset(), not function)


def _bound(function: ast.FunctionDef | ast.Lambda) -> frozenset[str]:
    """Return the names that a function binds."""
    arguments = function.args
    names = {a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}
    for node in ast.walk(function):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.FunctionDef) and node is not function:
            names.add(node.name)
    return frozenset(names)


def _same(pattern: Any, code: Any, names: dict[str, Any], local: frozenset[str]) -> bool:
    if isinstance(pattern, list):
        return isinstance(code, list) and _same_lists(pattern, code, names, local)
    if isinstance(pattern, ast.Name):
        if re.fullmatch(r"_\d", pattern.id):
            meaning = names.setdefault(pattern.id, code)
            return isinstance(code, ast.expr) and ast.dump(meaning) == ast.dump(code)
        if not isinstance(code, ast.Name):
            return False
        if code.id not in local:
            return pattern.id == code.id
        known = names.setdefault(pattern.id, code.id)
        return bool(known == code.id) and [v for k, v in names.items() if k != pattern.id].count(code.id) == 0
    if type(pattern) is not type(code):
        return False
    if not isinstance(pattern, ast.AST):
        return bool(pattern == code)
    return all(
        _same(value, getattr(code, key, None), names, local)
        for key, value in ast.iter_fields(pattern)
        if key not in ("ctx", "type_comment", "kind")
    )


def _is_gap(node: Any) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and node.value.value is Ellipsis


def _same_lists(pattern: list[Any], code: list[Any], names: dict[str, Any], local: frozenset[str]) -> bool:
    gaps = [k for k, node in enumerate(pattern) if _is_gap(node)]
    if not gaps:
        return len(pattern) == len(code) and all(_same(p, c, names, local) for p, c in zip(pattern, code, strict=True))
    (gap,) = gaps  # one at most
    behind = len(pattern) - gap - 1
    if len(code) < gap + behind:
        return False
    names.setdefault("...", code[gap : len(code) - behind])
    return _same_lists(pattern[:gap], code[:gap], names, local) and _same_lists(
        pattern[gap + 1 :], code[len(code) - behind :], names, local
    )


class _Substitution(ast.NodeTransformer):
    """Puts the code's names, and what wildcards stand for, into the new code."""

    def __init__(self, names: dict[str, Any]) -> None:
        self.names = names

    def visit_Name(self, node: ast.Name) -> ast.AST:
        value = self.names.get(node.id, node.id)
        if isinstance(value, ast.AST):
            return copy.deepcopy(value)
        return ast.copy_location(ast.Name(value, node.ctx), node)

    def visit_Expr(self, node: ast.Expr) -> Any:
        return copy.deepcopy(self.names["..."]) if _is_gap(node) else self.generic_visit(node)

    def statements(self, nodes: list[Any]) -> list[Any]:
        """Return statements with names put in."""
        return list(self.visit(ast.Module(nodes, [])).body)
