"""Sphinx extension: signatures as the source has them, with the short names of array types and units.

Sphinx evaluates annotations and defaults: `size: Length = 0.1` then takes three lines, and a callback is an
address. This extension reads them from the source. It hides fields without a docstring of their own, which
the docstring of their class describes, and the arguments of classes that a page names as `Name()`.
"""

import ast
import dataclasses
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from docutils import nodes

# Names of types that only this package's source explains, and what the reference shows instead.
SHORT = {
    "_Nodal": "float | NodeValues",
    "_DEFAULT": "200.0",
    "Points": "ArrayLike",
    "Vector": "ArrayLike",
    "OfTime": "ScalarLike | Callable",
    "Scenes": "str | Callable",
    "Cluster": "Any",
    "Backend": "str",
    "Tell": "Callable",
    "Values": "dict[str, Any]",
}
WORD = re.compile(rf"(?<![\w.])({'|'.join(SHORT)})(?![\w.])")
# jaxtyping marks a single axis by a space.
AXIS = re.compile(r", ' ")


def setup(app: Any) -> dict[str, Any]:
    """Connect the extension to Sphinx."""
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-skip-member", _skip)
    app.connect("doctree-read", _shorten)
    return {"parallel_read_safe": True}


def _signature(
    app: Any, what: str, name: str, value: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None] | None:
    """Return the arguments and the return annotation of a function or a class."""
    if what == "class":
        return ("" if signature == "()" else _constructor(value)), None
    if what in ("function", "method") and inspect.isroutine(value):
        function = inspect.unwrap(getattr(value, "__func__", value))
        parsed = _parsed(function)
        assert isinstance(parsed, ast.FunctionDef)
        arguments = parsed.args
        if what == "method" and arguments.args and arguments.args[0].arg in ("self", "cls"):
            del arguments.args[0]
        arguments.defaults = [_known(one, function.__globals__) for one in arguments.defaults]
        arguments.kw_defaults = [one and _known(one, function.__globals__) for one in arguments.kw_defaults]
        return f"({_short(arguments)})", None if parsed.returns is None else _short(parsed.returns)
    return None


def _constructor(owner: type) -> str:
    """Return the fields of a class as arguments; empty for a class that nobody calls with fields."""
    if dataclasses.is_dataclass(owner):
        names = [field.name for field in dataclasses.fields(owner) if field.init]
    else:
        names = list(getattr(owner, "_fields", ()))
    found = {name: text for base in reversed(owner.__mro__) for name, text in _fields(base)}
    return f"({', '.join(found[name] for name in names)})" if names else ""


def _fields(owner: type) -> Iterator[tuple[str, str]]:
    """Yield name, and annotation with default, of the fields that a class of this package defines."""
    if not owner.__module__.startswith("jaxcrumple"):
        return
    for line in _parsed(owner).body:
        if isinstance(line, ast.AnnAssign):
            line.value = _default(line.value, vars(sys.modules[owner.__module__]))
            yield ast.unparse(line.target), _short(line)


def _default(value: ast.expr | None, names: Mapping[str, Any]) -> ast.expr | None:
    """Return the default of a field, which `field(default=..., converter=...)` may hide."""
    if isinstance(value, ast.Call) and ast.unparse(value.func).endswith("field"):
        given = {word.arg: word.value for word in value.keywords}
        if "default_factory" in given:
            return ast.Call(given["default_factory"], [], [])
        value = given.get("default")
    return value and _known(value, names)


def _known(value: ast.expr, names: Mapping[str, Any]) -> ast.expr:
    """Replace a constant of a module by its value."""
    if not isinstance(value, ast.Name | ast.Attribute):
        return value
    found = eval(ast.unparse(value), dict(names))
    return ast.parse(repr(found)).body[0].value if isinstance(found, int | float | str | tuple) else value  # type: ignore[attr-defined]


def _short(parsed: ast.AST) -> str:
    """Return the source of a part, with short names of types."""
    return WORD.sub(lambda name: SHORT[name[0]], AXIS.sub(", '", ast.unparse(parsed)))


def _parsed(value: Any) -> ast.FunctionDef | ast.ClassDef:
    """Return the syntax tree of the source of a function or a class."""
    found = ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]
    assert isinstance(found, ast.FunctionDef | ast.ClassDef)
    return found


def _skip(app: Any, what: str, name: str, value: Any, skipped: bool, options: Any) -> bool | None:
    """Hide the fields of named tuples, whose only docstring is "Alias for field number 0"."""
    return True if type(value).__name__ == "_tuplegetter" else None


def _shorten(app: Any, doctree: nodes.document) -> None:
    """Shorten the types of properties, which Sphinx evaluates."""
    for text in list(doctree.findall(nodes.Text)):
        if "jaxlib._jax." in text:
            text.parent.replace(text, nodes.Text(text.replace("jaxlib._jax.", "")))
