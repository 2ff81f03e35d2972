"""The docstrings of the public names: their examples run, and they tell arguments and errors.

`docs/api` shows them, each name on one page.
"""

import ast
import doctest
import functools
import inspect
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple import measure

PAGES = Path(__file__).parents[1] / "docs" / "api"
DIRECTIVE = re.compile(r"\.\. auto\w+:: (?P<name>[\w.]+)")
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
# Names that examples use without an import, as the first page of the reference says.
IMPORTED = {"jax": jax, "jnp": jnp, "np": np, "jc": jc, "measure": measure}
# Arguments that need no words.
PLAIN = {
    "self", "cls", "mesh", "scene", "state", "x", "v", "p", "t", "run", "path", "name", "material", "nodes",
    "seed",
}  # fmt: skip
PUBLIC = {
    f"{module.__name__}.{name}": value
    for module in (jc, measure)
    for name in module.__all__
    if not inspect.ismodule(value := getattr(module, name))
}
ARGUMENTS = re.compile(r"\*\*Arguments:\*\*(?P<text>.*?)(?=\n\n\*\*|\n\n>>>|\Z)", re.DOTALL)
# The names that begin an item: "- `a`, `b`: ..." or "`a` in m; `b`, `c`: ...".
ITEM = re.compile(r"(?:^|;|\n- )\s*(?P<names>`\w+`(?: \([^)]*\))?(?:, `\w+`(?: \([^)]*\))?)*)")
# Functions that refuse wrong values, by their names.
CHECK = re.compile(r"_?(check|require)_\w+|positions|plastic_curvature|face_values|_?checked_\w+")


def _members(value):
    """Yield the public methods and properties that a class defines itself, by name."""
    for name, member in vars(value).items() if inspect.isclass(value) else ():
        member = getattr(member, "__func__", member)
        if not name.startswith("_") and (inspect.isroutine(member) or isinstance(member, property)):
            yield name, member


DOCUMENTED = {
    f"{owner}.{name}".removesuffix("."): value
    for owner, public in PUBLIC.items()
    for name, value in [("", public), *_members(public)]
    if inspect.isclass(value) or inspect.isroutine(value) or isinstance(value, property)
}
EXAMPLES = [
    test
    for name, value in PUBLIC.items()
    for test in doctest.DocTestFinder(exclude_empty=True).find(value, name, module=False, globs=IMPORTED)
    if test.examples
]


# Compiles for a minute; tests/replays/test_stack.py tests the same on a smaller sheet.
SLOW = "jaxcrumple.stack_records"


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(test, id=test.name, marks=pytest.mark.slow if test.name == SLOW else ())
        for test in EXAMPLES
    ],
)
def test_an_example_prints_what_it_shows(example):
    told = []
    assert not doctest.DocTestRunner(optionflags=FLAGS).run(example, out=told.append).failed, "".join(told)


def test_there_are_examples():
    assert len(EXAMPLES) >= 25


@pytest.mark.parametrize("name", DOCUMENTED)
def test_a_docstring_tells_arguments_and_errors(name):
    value = DOCUMENTED[name]
    text = inspect.getdoc(value)
    assert text
    assert "$" not in text, "formulas are plain text, which a terminal shows"
    if isinstance(value, property):
        return
    if listed := ARGUMENTS.search(text):
        items = (re.findall(r"`(\w+)`", item["names"]) for item in ITEM.finditer(listed["text"]))
        assert {one for names in items for one in names} <= set(inspect.signature(value).parameters)
    if inspect.isroutine(value):
        named = set(re.findall(r"`(\w+)`", text))
        assert set(inspect.signature(value).parameters) - PLAIN <= named
    if _raises_value_error(value):
        assert "**Raises:**" in text


def test_each_public_name_stands_on_one_page():
    shown = [found["name"] for page in PAGES.glob("*.md") for found in DIRECTIVE.finditer(page.read_text())]
    assert sorted(set(PUBLIC) - set(shown)) == []
    assert sorted(name for name in shown if shown.count(name) > 1) == []


def _raises_value_error(value):
    """Return whether a function, a helper in its module, or the check of a class raises ValueError."""
    value = inspect.unwrap(value)
    if inspect.isclass(value):
        checks = [vars(value)[name] for name in ("__check_init__", "__post_init__") if name in vars(value)]
        return any(map(_raises_value_error, checks))
    raising = _raising(inspect.getsourcefile(value))
    return value.__name__ in raising or value.__qualname__ in raising


@functools.cache
def _raising(path):
    """Return the functions of a file that raise ValueError, themselves or by what they call."""
    parsed = ast.parse(Path(path).read_text())
    functions = [node for node in ast.walk(parsed) if isinstance(node, ast.FunctionDef)]
    raising = set()
    while True:
        more = {one.name for one in functions if one.name not in raising and _fails(one, raising)}
        if not more:
            return raising
        raising |= more


def _fails(function, raising):
    for node in ast.walk(function):
        if isinstance(node, ast.Raise) and node.exc is not None and "ValueError" in ast.unparse(node.exc):
            return True
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in raising or CHECK.fullmatch(called):
                return True
    return False
