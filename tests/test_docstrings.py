"""The examples of the docstrings run, and every public verb and class of the package has one."""

from __future__ import annotations

import doctest
import inspect

import pytest

import mars_lidar as ml

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
WITHOUT = {"Generated", "Pulse", "UnitWarning"}  # a result, a base class and a warning
PUBLIC = sorted(name for name in ml.__all__ if callable(getattr(ml, name)))


@pytest.mark.parametrize("name", [name for name in PUBLIC if name not in WITHOUT])
def test_the_example_of_a_docstring(name: str):
    text = inspect.getdoc(getattr(ml, name)) or ""
    assert "See Also\n--------" in text
    test = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert test.examples
    results = doctest.DocTestRunner(optionflags=FLAGS).run(test)
    assert results.failed == 0
