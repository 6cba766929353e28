"""Arguments are checked against the annotations of the function, with uniform messages.

A caller may pass None, a list of rows of different lengths, or a cube where a system is expected; without a check, an
unrelated error would be raised deep inside. The annotation is the single declaration of an argument's type: `checked`
evaluates it at the first call of the function and refuses, by name, an argument whose value it does not allow.
Ranges of numbers are checked in the functions (`checks`).
"""

from __future__ import annotations

import collections.abc
import functools
import inspect
import os
import types
import typing
from collections import ChainMap
from collections.abc import Callable
from numbers import Integral, Real
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from mars_lidar._base.checks import numbers, unmasked, whole
from mars_lidar._base.spelling import did_you_mean

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C", bound=type)
_NUMBERS = {int, float, bool, type(None)}
_ARRAYS = ("ArrayLike", "NDArray", "FloatArray", "IndexArray", "CountArray")


class _Array:
    """Stands for all annotations of arrays: of what is declared so, an array of real numbers can be made."""

    def __class_getitem__(cls, _: Any) -> type[_Array]:
        return cls


def checked(function: Callable[P, R], masks: bool = False) -> Callable[P, R]:
    """Refuse, by name, arguments whose values their annotations do not allow.

    Texts, choices, paths, arrays, mappings, sequences, functions, classes and unions of them are checked; numbers and
    all other annotations are left to the function. Arrays must contain real numbers and no masked elements, except
    where `masks` are meaningful. Of a sequence only the type is checked, not its elements.
    """
    signature = inspect.signature(function)
    rules: dict[str, tuple[Any, ...]] = {}

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        given = _bound(function.__qualname__, signature, args, kwargs)
        if not rules:
            rules.update(_rules(function, signature))
        for name, value in given.items():
            if members := rules.get(name):
                _require(name, value, members, masks)
        return function(*args, **kwargs)

    return call


def explained(function: Callable[P, R]) -> Callable[P, R]:
    """Explain a call that Python refuses, as `checked` does, without checking the values of arguments."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except TypeError:  # of the call itself, or from within
            _bound(function.__qualname__, signature, args, kwargs)
            raise

    return call


def constructed_by_name(cls: C) -> C:
    """Apply `explained` to the constructor of a class, unless that is checked."""
    function = cls.__init__  # type: ignore[misc]
    if not hasattr(function, "__wrapped__"):
        cls.__init__ = explained(function)  # type: ignore[misc]
    return cls


def checked_fields(cls: C) -> C:
    """Apply `checked` to the constructor of a class."""
    cls.__init__ = checked(cls.__init__)  # type: ignore[misc]
    return cls


def _bound(name: str, signature: inspect.Signature, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a call by their names; TypeError names the argument that was meant, or the form of the call.

    ``Detector(dead_time=50)``: "Detector has no argument 'dead_time' (did you mean 'dead_time_ns'?)";
    ``GaussianPulse(0.3)``: "GaussianPulse takes its arguments by name: GaussianPulse(sigma_ns=...)".
    """
    try:
        return signature.bind(*args, **kwargs).arguments
    except TypeError as error:
        problem = str(error)
    called = name.removesuffix(".__init__")
    parameters = [each for each in signature.parameters.values() if each.name not in ("self", "cls")]
    allowed = tuple(each.name for each in parameters)
    others = any(each.kind is each.VAR_KEYWORD for each in parameters)
    unknown = [] if others else [key for key in kwargs if key not in allowed]
    if unknown:
        meant = did_you_mean(unknown[0], allowed)
        raise TypeError(f"{called} has no argument {unknown[0]!r}{meant}; arguments: {', '.join(allowed)}") from None
    first = [each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD]
    if "positional" in problem and first:
        raise TypeError(f"{called} takes {', '.join(first)} by position and all other arguments by name")
    if "positional" in problem:
        required = [f"{each.name}=..." for each in parameters if each.default is inspect.Parameter.empty]
        form = ", ".join(required) or f"{allowed[0]}=..."
        raise TypeError(f"{called} takes its arguments by name: {called}({form})")
    raise TypeError(f"{called}: {problem}")


def checked_with_masks(function: Callable[P, R]) -> Callable[P, R]:
    """As `checked`, for a function that accepts masked elements."""
    return checked(function, masks=True)


def _rules(function: Callable[..., Any], signature: inspect.Signature) -> dict[str, tuple[Any, ...]]:
    """Members of the union of each parameter; none where one of them is not for this module to judge."""
    names = ChainMap(dict.fromkeys(_ARRAYS, _Array), getattr(inspect.unwrap(function), "__globals__", {}))
    rules: dict[str, tuple[Any, ...]] = {}
    for name, parameter in signature.parameters.items():
        if parameter.annotation is parameter.empty or parameter.kind in (
            parameter.VAR_POSITIONAL,
            parameter.VAR_KEYWORD,
        ):
            continue
        annotation = parameter.annotation
        if isinstance(annotation, str):
            annotation = eval(annotation.strip("'\""), {}, names)
        members = (*_members(annotation), *([type(None)] if parameter.default is None else []))
        if set(members) - _NUMBERS and all(_known(member) for member in members):
            rules[name] = members
    return rules or {"": ()}


def _members(annotation: Any) -> list[Any]:
    if isinstance(annotation, typing.TypeAliasType if hasattr(typing, "TypeAliasType") else ()):
        return _members(annotation.__value__)
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [part for each in typing.get_args(annotation) for part in _members(each)]
    return [type(None) if annotation is None else annotation]


def _known(member: Any) -> bool:
    origin = typing.get_origin(member)
    if member in (Any, object) or isinstance(member, TypeVar | str):
        return False
    return isinstance(origin or member, type) or origin is typing.Literal


def _require(name: str, value: Any, members: tuple[Any, ...], masks: bool) -> None:
    if value is None and type(None) in members:
        return
    if Path in members and isinstance(value, str | os.PathLike):
        text = os.fspath(value)
        if not isinstance(text, str) or not text or "\0" in text:
            null = ", which holds a null byte" if "\0" in str(text) else ""
            raise ValueError(f"{name} must be a path, got {value!r}{null}")
        return
    if any(_fits(value, member, Path in members) for member in members):
        return
    if _Array in members and value is not None:
        array = value if masks else unmasked(name, value)
        if getattr(array, "requires_grad", False):
            raise TypeError(f"{name} must be an array of real numbers, got a tensor with a gradient: detach() it first")
        numbers(name, array)
        return
    choices = [word for each in members if typing.get_origin(each) is typing.Literal for word in each.__args__]
    if choices and (isinstance(value, str) or len(members) == 1):
        raise ValueError(f"{name} must be {_words(members)}, got {value!r}{did_you_mean(value, choices)}")
    raise TypeError(f"{name} must be {_words(members)}, got {_described(value)}")


def _fits(value: Any, member: Any, paths: bool) -> bool:
    origin = typing.get_origin(member) or member
    if origin is typing.Literal:
        return any(isinstance(value, type(choice)) and bool(value == choice) for choice in member.__args__)
    if origin is _Array or (origin is str and paths):
        return False
    if origin is float:
        return isinstance(value, Real) and not isinstance(value, bool | np.bool_)
    if origin is int:
        return isinstance(whole(value), Integral) and not isinstance(value, bool | np.bool_)
    if origin is bool:
        return isinstance(value, bool | np.bool_)
    if origin in (tuple, list, collections.abc.Sequence, collections.abc.Iterable):
        return isinstance(value, collections.abc.Iterable) and not isinstance(value, str | bytes | dict)
    if getattr(origin, "_is_protocol", False):
        return _has_members(value, origin)
    return isinstance(value, origin)


def _has_members(value: Any, protocol: Any) -> bool:
    """Whether `value` has what a protocol asks for; a class or None has it by accident."""
    names = [name for name in vars(protocol) if not name.startswith("_")] + [*getattr(protocol, "__annotations__", {})]
    return not isinstance(value, type) and all(hasattr(value, name) for name in names)


def _words(members: tuple[Any, ...]) -> str:
    """The members of a union for people."""
    plain: dict[Any, str] = {_Array: "an array of real numbers", float: "a number", int: "an integer", bool: "a bool"}
    plain |= {Path: "a path", dict: "a mapping", slice: "a slice", collections.abc.Callable: "a callable"}
    sequence = (tuple, list, collections.abc.Sequence, collections.abc.Iterable)
    words: list[str] = []
    for member in members:
        origin = typing.get_origin(member) or member
        if origin is type(None) or (origin is str and Path in members):
            continue
        if origin is typing.Literal:
            word = "one of " + ", ".join(map(repr, member.__args__))
        elif origin is str:
            word = "a text"
        elif origin in sequence:
            word = "a sequence"
        else:
            word = plain.get(origin) or f"{'an' if origin.__name__[0] in 'AEIO' else 'a'} {origin.__name__}"
        if word not in words:
            words.append(word)
    return " or ".join(words)


def _described(value: Any) -> str:
    text = f"{value!r:.80} " if isinstance(value, str | float | int) and not isinstance(value, bool) else ""
    return f"{text}{'None' if value is None else type(value).__name__}"
