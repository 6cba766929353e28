"""Options of commands: each a default made by `option`, alone or as a field of a group that several commands take."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import inspect
from collections.abc import Callable
from contextvars import ContextVar
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar, dataclass_transform, get_args, get_type_hints

import typer
from typer.models import OptionInfo

from mars_lidar._base import checks

T = TypeVar("T")
OPTIONS: ContextVar[dict[str, str]] = ContextVar("OPTIONS", default={})  # noqa: B039  # never changed in place
"""Options given on the command line that is run, by the name of their parameter: what an error is to name."""


def option(help: str, told: str | None = None, *names: str, default: Any = None, **more: Any) -> Any:
    """An option, called after its parameter where it is given no `names`; `told`: its default, where that says more."""
    if told is None and isinstance(default, int | float | str) and default is not False:
        told = default if isinstance(default, str) else f"{default:g}"
    text = help if told is None else f"{help} [dim]Default: {told}.[/dim]"
    return typer.Option(default, *names, help=text, show_default=False, **more)


def argument(help: str, default: Any = ...) -> Any:
    """A positional argument."""
    return typer.Argument(default, help=help, show_default=False)


def panel(name: str) -> Callable[..., Any]:
    """`option` for those that stand together under a heading of the help."""
    return partial(option, rich_help_panel=name)


def flowing_help(command: Callable[..., None]) -> str:
    """The docstring in paragraphs that flow: typer keeps its line ends, whatever the width of the screen."""
    return "\n\n".join(" ".join(text.split()) for text in (command.__doc__ or "").split("\n\n"))


def examples(*lines: str) -> str:
    """The end of a command's help."""
    return "\n\n".join(("[bold]Examples[/bold]", *lines))


@dataclass_transform(frozen_default=True, kw_only_default=True)
def group(kind: type[T]) -> type[T]:
    """A dataclass of options, and of groups of them, that a command takes as one keyword."""
    for name in inspect.get_annotations(kind):
        info = getattr(kind, name)
        if isinstance(info, OptionInfo):
            setattr(kind, name, dataclasses.field(default=info.default, metadata={"option": info}))
    return dataclasses.dataclass(frozen=True, kw_only=True)(kind)


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """`command` for typer: each keyword that is a group stands for the options that are its fields.

    ``def compare(*, instrument: SystemOptions, ...)`` has an option for each field of `SystemOptions`, at that place,
    and is called with an instance of it. Integers may be written 1e6.
    """
    hints = get_type_hints(command)
    parameters: list[inspect.Parameter] = []
    groups: dict[str, type] = {}
    for name, parameter in inspect.signature(command).parameters.items():
        kind = hints[name]
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            groups[name] = kind
            parameters += _options(kind)
        else:
            parameters.append(_declared(name, kind, parameter.default))

    @wraps(command)
    def run(**given: Any) -> None:
        said = [p for p in parameters if given[p.name] not in (p.default.default, None, False, [])]
        OPTIONS.set({p.name: _shown(p) for p in said})
        _refuse_empty({_shown(p): given[p.name] for p in parameters})
        built = {name: _taken(kind, given) for name, kind in groups.items()}
        command(**given, **built)

    signature = inspect.Signature(parameters, return_annotation=None)
    run.__signature__ = signature  # type: ignore[attr-defined]  # what typer reads
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _declared(name: str, kind: Any, info: Any) -> inspect.Parameter:
    """What typer reads of an option or argument: with its name, and a reader of integers."""
    info = copy.copy(info)
    if isinstance(info, OptionInfo):
        info.param_decls = info.param_decls or (f"--{name.replace('_', '-')}",)
    if int in (get_args(kind) or (kind,)) and info.parser is None:
        info.parser, info.metavar = partial(_whole, low=info.min, high=info.max), info.metavar or "INTEGER"
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=info, annotation=kind)


def _options(group: Any) -> list[inspect.Parameter]:
    """An option for each field, groups among them in their place."""
    hints = get_type_hints(group)
    found: list[inspect.Parameter] = []
    for field in dataclasses.fields(group):
        kind = hints[field.name]
        told = field.metadata.get("option")
        found += _options(kind) if told is None else [_declared(field.name, kind, told)]
    return found


def _shown(parameter: inspect.Parameter) -> str:
    names = parameter.default.param_decls
    return str(max(names, key=len)).partition("/")[0] if names else parameter.name.upper()


def _refuse_empty(given: dict[str, Any]) -> None:
    """A shell makes an empty text of a variable that is not set; as a path that is the folder one is in."""
    for option, value in given.items():
        if option.startswith("-") and (value == "" or (value == Path() and any(Path().iterdir()))):
            raise typer.BadParameter("it is empty, or the folder that this runs in.", param_hint=option)


def _whole(text: str, low: float | None, high: float | None) -> int:
    number: Any = None
    try:
        number = int(text)
    except ValueError:
        with contextlib.suppress(ValueError):
            number = checks.whole(float(text))
    if not isinstance(number, int):
        raise typer.BadParameter(f"{text!r} is not an integer.")
    if (low is not None and number < low) or (high is not None and number > high):
        limits = [f"at least {low}"] * (low is not None) + [f"at most {high}"] * (high is not None)
        raise typer.BadParameter(f"{number} is not {' and '.join(limits)}.")
    return number


def _taken(group: Any, given: dict[str, Any]) -> Any:
    """An instance of the group, of the options that are its own, which are taken out of what is given."""
    hints = get_type_hints(group)
    return group(
        **{
            field.name: given.pop(field.name) if field.metadata else _taken(hints[field.name], given)
            for field in dataclasses.fields(group)
        }
    )
