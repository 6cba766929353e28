"""Options that several commands take, defined once: dataclasses whose fields are options."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, get_type_hints


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """`command` for typer: each keyword that is a dataclass of options stands for the options that are its fields.

    ``def compare(*, instrument: SystemOptions, ...)`` has an option for each field of `SystemOptions`, at that place,
    and is called with an instance of it. A field may be such a dataclass itself.
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

    @wraps(command)
    def run(**given: Any) -> None:
        built = {name: _taken(kind, given) for name, kind in groups.items()}
        command(**given, **built)

    signature = inspect.Signature(parameters, return_annotation=None)
    run.__signature__ = signature  # type: ignore[attr-defined]  # what typer reads
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


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
