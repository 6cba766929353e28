"""Constructors whose arguments are given by name: a wrong call names the argument that was meant."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from mars_lidar._base.checks import did_you_mean

C = TypeVar("C", bound=type)
F = TypeVar("F", bound=Callable[..., Any])


def by_name(function: F, name: str | None = None) -> F:
    """Explain a call of `function` that Python refuses: the argument meant, or the form of the call.

    ``Detector(dead_time=50)``: "Detector has no argument 'dead_time' (did you mean 'dead_time_ns'?)";
    ``GaussianPulse(0.3)``: "GaussianPulse takes its arguments by name: GaussianPulse(sigma_ns=...)".
    """
    signature = inspect.signature(function)
    parameters = [each for each in signature.parameters.values() if each.name not in ("self", "cls")]
    allowed = tuple(each.name for each in parameters)
    required = [f"{each.name}=..." for each in parameters if each.default is inspect.Parameter.empty]
    called = name or function.__qualname__

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except TypeError:  # of the call itself, or from within
            try:
                signature.bind(*args, **kwargs)
            except TypeError as error:
                raise TypeError(_explained(error, kwargs)) from None
            raise

    def _explained(error: TypeError, kwargs: dict[str, Any]) -> str:
        unknown = [key for key in kwargs if key not in allowed]
        if unknown:
            meant = did_you_mean(unknown[0], allowed)
            return f"{called} has no argument {unknown[0]!r}{meant}; arguments: {', '.join(allowed)}"
        if "positional" in str(error):
            return f"{called} takes its arguments by name: {called}({', '.join(required) or allowed[0] + '=...'})"
        return f"{called}: {error}"

    return call  # type: ignore[return-value]


def constructed_by_name(cls: C) -> C:
    """Apply `by_name` to the constructor of a class."""
    cls.__init__ = by_name(cls.__init__, cls.__name__)  # type: ignore[misc]
    return cls
