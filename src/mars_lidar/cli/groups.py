"""Options that several commands take, defined once: dataclasses whose fields are options."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from contextvars import ContextVar
from functools import partial, wraps
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer

from mars_lidar._base import checks

OPTIONS: ContextVar[dict[str, str]] = ContextVar("OPTIONS", default={})  # noqa: B039  # never changed in place
"""Options given on the command line that is run, by the name of their parameter: what an error is to name."""


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """`command` for typer: each keyword that is a dataclass of options stands for the options that are its fields.

    ``def compare(*, instrument: SystemOptions, ...)`` has an option for each field of `SystemOptions`, at that place,
    and is called with an instance of it. A field may be such a dataclass itself. Integers may be written 1e6.
    """
    hints = get_type_hints(command, include_extras=True)
    parameters: list[inspect.Parameter] = []
    groups: dict[str, type] = {}
    for name, parameter in inspect.signature(command).parameters.items():
        kind = hints[name]
        if _is_group(kind):
            groups[name] = kind
            parameters += _options(kind)
        else:
            parameters.append(parameter.replace(annotation=kind))
    for parameter in parameters:
        _read_whole_numbers(parameter.annotation)

    @wraps(command)
    def run(**given: Any) -> None:
        OPTIONS.set({p.name: _option_name(p) for p in parameters if given[p.name] not in (p.default, None, False, [])})
        _refuse_empty({_option_name(p): given[p.name] for p in parameters})
        built = {name: _taken(kind, given) for name, kind in groups.items()}
        command(**given, **built)

    signature = inspect.Signature(parameters, return_annotation=None)
    run.__signature__ = signature  # type: ignore[attr-defined]  # what typer reads
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _refuse_empty(given: dict[str, Any]) -> None:
    """A shell makes an empty text of a variable that is not set; as a path that is the folder one is in."""
    for option, value in given.items():
        if option.startswith("-") and (value == "" or (value == Path() and any(Path().iterdir()))):
            raise typer.BadParameter("it is empty, or the folder that this runs in.", param_hint=option)


def _option_name(parameter: inspect.Parameter) -> str:
    info = parameter.annotation.__metadata__[0]
    names = [name for name in (info.default, *(info.param_decls or ())) if str(name).startswith("-")]
    return str(max(names, key=len)).partition("/")[0] if names else parameter.name.upper()


def _read_whole_numbers(annotation: Any) -> None:
    kinds, info = get_args(annotation.__origin__) or (annotation.__origin__,), annotation.__metadata__[0]
    if int in kinds and info.parser is None:
        info.parser, info.metavar = partial(_whole, low=info.min, high=info.max), info.metavar or "INTEGER"


def _whole(text: str, low: float | None, high: float | None) -> int:
    try:
        number = int(text)
    except ValueError:
        number = checks.whole(_number(text))
    if not isinstance(number, int):
        raise typer.BadParameter(f"{text!r} is not an integer.")
    if (low is not None and number < low) or (high is not None and number > high):
        limits = [f"at least {low}"] * (low is not None) + [f"at most {high}"] * (high is not None)
        raise typer.BadParameter(f"{number} is not {' and '.join(limits)}.")
    return number


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _is_group(kind: Any) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _options(group: type) -> list[inspect.Parameter]:
    """An option for each field, groups among them in their place."""
    hints = get_type_hints(group, include_extras=True)
    found: list[inspect.Parameter] = []
    for field in dataclasses.fields(group):
        kind = hints[field.name]
        if _is_group(kind):
            found += _options(kind)
            continue
        found.append(
            inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=kind)
        )
    return found


def _taken(group: type, given: dict[str, Any]) -> Any:
    """An instance of the group, of the options that are its own, which are taken out of what is given."""
    hints = get_type_hints(group, include_extras=True)
    values = {
        field.name: _taken(hints[field.name], given) if _is_group(hints[field.name]) else given.pop(field.name)
        for field in dataclasses.fields(group)
    }
    return group(**values)
