"""Docstrings of the public names: every parameter is described and typed, examples run, and errors are documented.

Public is what the packages export and what the reference lists (docs/reference.md).
"""

import doctest
import importlib
import inspect
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import mars_lidar as ml

numpydoc = pytest.importorskip("numpydoc.docscrape")

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference.md"
WITH_TORCH = find_spec("torch") is not None
PACKAGES = ("", "io", "plot", "reconstruction", "statistics", *(["learn"] if WITH_TORCH else []))
WITHOUT_EXAMPLE = {"io.save_capture"}  # it wants a capture that another program made: tests/io/test_capture.py


def _resolve(dotted: str) -> Any:
    thing: Any = ml
    for name in filter(None, dotted.split(".")):
        thing = getattr(thing, name) if hasattr(thing, name) else importlib.import_module(f"{thing.__name__}.{name}")
    return thing


def _in_the_reference() -> Iterator[str]:
    module = ""
    for line in REFERENCE.read_text(encoding="utf-8").splitlines():
        if match := re.match(r"\.\. currentmodule:: mars_lidar\.?(\S*)", line):
            module = match[1]
        elif (match := re.match(r"   ([\w.]+)$", line)) and (WITH_TORCH or module != "learn"):
            yield f"{module}.{match[1]}".strip(".")


@lru_cache(maxsize=1)
def public() -> dict[str, Any]:
    """Public functions and classes by their shortest names below the package."""
    names = {f"{package}.{name}" for package in PACKAGES for name in _resolve(package).__all__ if package}
    names |= {*ml.__all__, *_in_the_reference()}
    things: dict[int, tuple[str, Any]] = {}
    for name in sorted(names, key=lambda each: (len(each), each)):
        thing = _resolve(name)
        if callable(thing):
            things.setdefault(id(thing), (name, thing))
    return dict(sorted(things.values()))


def _sections(thing: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return numpydoc.NumpyDocString(inspect.getdoc(thing) or "")


def _described(thing: Any) -> dict[str, str]:
    """Descriptions by the names in the sections Parameters and Attributes."""
    entries = [
        entry for section in ("Parameters", "Other Parameters", "Attributes") for entry in _sections(thing)[section]
    ]
    return {name.strip(" *"): "".join(entry.desc) for entry in entries for name in entry.name.split(",")}


def _parameters(thing: Any) -> list[inspect.Parameter]:
    if isinstance(thing, type) and (issubclass(thing, BaseException) or "enum" in str(type(thing))):
        return []
    try:
        parameters = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):  # a typed dictionary: its keys are attributes
        return []
    return [each for each in parameters if each.name not in ("self", "cls") and not each.name.startswith("_")]


def _methods(thing: Any) -> Iterator[tuple[str, Callable[..., Any]]]:
    if isinstance(thing, type):
        for name, member in vars(thing).items():
            function = getattr(member, "__func__", member)
            if not name.startswith("_") and inspect.isfunction(function):
                yield name, function


def _named(names: Iterable[str]) -> list[Any]:
    """Those of learn, which load PyTorch, are of the full tier."""
    full = pytest.mark.full
    return [pytest.param(name, id=name, marks=full if name.startswith("learn.") else ()) for name in names]


@pytest.mark.parametrize("name", _named(public()))
def test_the_example_of_a_docstring(name: str):
    text = inspect.getdoc(public()[name]) or ""
    test = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    if not test.examples:
        assert name in WITHOUT_EXAMPLE or issubclass(public()[name], BaseException)
        pytest.skip("an example would want the file of another program, or to fail")
    results = doctest.DocTestRunner(optionflags=FLAGS).run(test)
    assert results.failed == 0


def test_every_public_name_has_a_page():
    pages = {id(_resolve(name)) for name in _in_the_reference()}
    assert not [name for name, thing in public().items() if id(thing) not in pages]


@pytest.mark.parametrize("name", _named(public()))
def test_sections(name: str):
    """See also; and for what takes arguments that may be wrong, Raises."""
    thing = public()[name]
    sections = _sections(thing)
    missing = [section for section in ("See Also",) if not sections[section]]
    results = isinstance(thing, type) and bool(sections["Attributes"]) and not sections["Parameters"]
    if _parameters(thing) and not results and not sections["Raises"] and not getattr(thing, "_abstract", False):
        missing.append("Raises")
    assert not missing, f"{name} has no section {missing}"


@pytest.mark.parametrize("name", _named(public()))
def test_every_parameter_is_described_and_typed(name: str):
    """Of functions and constructors under Parameters (or Attributes); of methods there, or by name in the text."""
    thing = public()[name]
    described = _described(thing)
    problems = [each.name for each in _parameters(thing) if not described.get(each.name)]
    problems += [f"{each.name} has no type" for each in _parameters(thing) if each.annotation is each.empty]
    unknown = {each.name.strip(" *") for entry in _sections(thing)["Parameters"] for each in [entry]}
    unknown = {part.strip(" *") for each in unknown for part in each.split(",")} - {
        each.name for each in _parameters(thing)
    }
    problems += [f"{each} is no parameter" for each in unknown if _parameters(thing)]
    for method, function in _methods(thing):
        text = (inspect.getdoc(function) or "") + (inspect.getdoc(thing) or "")
        known = _described(function) | described
        problems += [
            f"{method}({each.name})"
            for each in _parameters(function)
            if not known.get(each.name) and not re.search(rf"`[^`]*\b{each.name}\b[^`]*`", text)
        ]
        problems += [f"{method} has no text"] if not inspect.getdoc(function) else []
    problems += [
        f"{member} has no text"
        for member, value in vars(thing).items()
        if not member.startswith("_") and isinstance(value, property | cached_property) and not value.__doc__
    ]
    assert not problems, f"{name}: {problems}"
