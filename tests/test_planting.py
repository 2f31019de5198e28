"""Patterns of `planting` match code by its shape, once, and put the flaw in its place."""

from __future__ import annotations

import ast

import pytest
from planting import Mutant, StaleMutant, flawed

SOURCE = """
LIMIT = 3

def outer(width, height):
    reach = width  # a comment
    def inner(x):
        if x < reach:
            x += 1
            x = min(x,
                    LIMIT)
        return helper(x, height)
    return inner

def other(a):
    b = [a, a + 1]
    b[0] = a + 1
    return b
"""


def plant(old, new, function=""):
    return ast.unparse(flawed(SOURCE, Mutant("", "here", old, new, "", "", function)))


def expect(before, after):
    source = ast.unparse(ast.parse(SOURCE))
    assert source.count(before) == 1
    return source.replace(before, after)


@pytest.mark.parametrize(
    ("old", "new", "before", "after"),
    [
        ("min(x, LIMIT)", "x", "min(x, LIMIT)", "x"),
        ("min(whatever, LIMIT)", "whatever + 2", "min(x, LIMIT)", "x + 2"),
        ("helper(at, rows)", "helper(rows, at)", "helper(x, height)", "helper(height, x)"),
        ("p < q", "p <= q", "x < reach", "x <= reach"),
        ("x += 1", "", "            x += 1\n", ""),
        ("b[0] = _1", "b[1] = _1", "b[0] = a + 1", "b[1] = a + 1"),
        ("if x < reach:\n    ...", "...", None, None),
        ("[p, _1]", "[_1, p]", "[a, a + 1]", "[a + 1, a]"),
    ],
)
def test_a_pattern_matches_whatever_local_names_are(old, new, before, after):
    planted = plant(old, new)
    if before is not None:
        assert planted == expect(before, after)
    else:
        assert "if" not in planted and planted.count("x += 1") == 1


def test_a_statement_that_was_alone_leaves_a_body():
    assert "pass" in plant("if x < reach:\n    ...", "if x < reach:\n    pass")
    assert "pass" in ast.unparse(
        flawed("def f(x):\n    return x", Mutant("", "here", "return x", "", "", ""))
    )  # an empty body would not compile


@pytest.mark.parametrize(
    ("old", "count"),
    [
        ("min(x, OTHER)", 0),  # a global name is no variable
        ("max(x, LIMIT)", 0),
        ("helper(x, x)", 0),  # two variables are not one
        ("p + 1", 2),
        ("return p", 2),
    ],
)
def test_a_pattern_must_match_once(old, count):
    with pytest.raises(StaleMutant, match=rf"must match once in here, got {count} times"):
        plant(old, "0")


def test_a_function_narrows_the_search():
    assert plant("return p", "return None", "other") == expect("return b", "return None")
    with pytest.raises(StaleMutant, match="got 0 times"):
        plant("min(x, LIMIT)", "x", "other")
    assert plant("p < q", "p > q", "outer") == expect("x < reach", "x > reach")
