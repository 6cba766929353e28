"""Messages, exit codes and the progress bar: standard output carries results, standard error the rest."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from cyclopts import App
from cyclopts import exceptions as wrong

from mars_lidar._base import checks
from mars_lidar._base.files import WriteError, beside
from mars_lidar._base.progress import Bar
from mars_lidar._base.resources import no_thread
from mars_lidar._base.spelling import did_you_mean
from mars_lidar.cli.options import describe

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console
    from rich.table import Table

_FIELDS = {  # arguments of the package and the options that give them under another name
    "sigma_ns": "pulse_sigma_ns",
    "fwhm_ns": "pulse_fwhm_ns",
    "values": "pulse_file",
    "preset": "detector",
    "outside": "table_outside",
    "example": "scene",
    "channel": "transient_channel",
    "start_ns": "transient_start_ns",
    "bin_ns": "transient_bin_ns",
}


class Exit(IntEnum):
    """Exit codes besides 0."""

    FAILED = 1
    BAD_INPUT = 2
    MISFIT = 3  # of a model
    INTERRUPTED = 130


def say(message: str) -> None:
    """Print one line on standard error."""
    print(f"mars-lidar: {message}", file=sys.stderr)


# --- Errors ---------------------------------------------------------------------------------------------------------


def run(app: App, tokens: Sequence[str]) -> int:
    """Run a command line and return the exit code; a failure prints one line on standard error.

    An unexpected exception keeps its traceback, because it is a bug and a report needs the traceback.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = partial(_show_warning, set())
            _refuse_empty(tokens)
            command = _command(app, tokens)
            if command is not app:  # the list of commands has their summaries
                describe(command)
            code = app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
            sys.stdout.flush()
        asked = command.default_command or any(token.startswith("-") for token in tokens)
        return code or (0 if asked else Exit.BAD_INPUT)
    except wrong.MissingArgumentError as error:
        if list(tokens) == list(error.command_chain or ()):  # the command alone: its help
            app.help_print(tokens)
        else:
            say(usage_message(error, app.name[0]))
        return Exit.BAD_INPUT
    except wrong.CycloptsError as error:
        say(usage_message(error, app.name[0]))
        return Exit.BAD_INPUT
    except KeyboardInterrupt as stop:  # `Interrupted` says what remains on the disk
        say(str(stop) or "interrupted")
        return Exit.INTERRUPTED
    except WriteError as error:
        say(f"failed: {error.strerror}")
        return Exit.FAILED
    except (FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        say(_file_message(error))
        return Exit.BAD_INPUT
    except BrokenPipeError:
        if not _reader_has_left():
            raise
        return Exit.FAILED
    except OSError as error:
        say(f"failed: {_file_message(error)}")
        return Exit.FAILED
    except RuntimeError as error:
        if not no_thread(error):
            raise
        say(f"failed: {error}: give fewer threads, or more memory")
        return Exit.FAILED
    except SystemError as error:  # CPython makes it of a MemoryError in the body of a class
        if "without setting an exception" not in str(error):
            raise
        say("failed: the memory or address space (ulimit -v) is exhausted")
        return Exit.FAILED
    except (ValueError, TypeError, OverflowError, MemoryError) as error:
        say(_with_options(" ".join(str(error).split()), tokens) or type(error).__name__)
        return Exit.BAD_INPUT


def _reader_has_left() -> bool:
    """Whether standard output is a closed pipe, as after ``| head``; the rest of it is then discarded."""
    try:
        os.write(sys.stdout.fileno(), b"\n")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def _command(app: App, tokens: Sequence[str]) -> App:
    """The command, or group of commands, that the first words name."""
    for token in tokens:
        if token.startswith("-") or token not in app:
            break
        app = app[token]
    return app


def _refuse_empty(tokens: Sequence[str]) -> None:
    """Raise for an empty value: a shell makes one of a variable that is not set, and as a path it is this folder."""
    for before, token in pairwise(["", *tokens]):
        option, equals, value = token.partition("=")
        if token == "" or (token.startswith("-") and equals and not value):
            name = before if token == "" else option
            raise ValueError(f"{name if name.startswith('-') else 'an argument'} is empty: give a value")


def usage_message(error: wrong.CycloptsError, program: str) -> str:
    """Error message of a command line in terms of its options, and the page that helps."""
    commands = " ".join((program, *(error.command_chain or ())))
    return f"{_usage_message(error, commands)} ({commands} --help)"


def _usage_message(error: wrong.CycloptsError, commands: str) -> str:
    if isinstance(error, wrong.UnknownOptionError):
        option = (error.token.keyword or error.token.value).partition("=")[0]
        options = [name for argument in error.argument_collection for name in argument.names]
        return f"{commands} has no option {option}{did_you_mean(option.replace('_', '-'), options)}"
    if isinstance(error, wrong.UnknownCommandError) and error.unused_tokens and error.app is not None:
        token = error.unused_tokens[0]
        kind = "option" if token.startswith("-") else "command"
        return f"{commands} has no {kind} {token}{did_you_mean(token.replace('_', '-'), list(error.app))}"
    if isinstance(error, wrong.MissingArgumentError) and error.argument is not None:
        if error.keyword is not None:
            return f"{error.keyword} needs a value"
        name, help = error.argument.name, str(error.argument.parameter.help)
        return f"{name if name.startswith('-') else name.upper()} is missing: {help.rstrip('.')}"
    if isinstance(error, wrong.UnusedCliTokensError) and error.unused_tokens:
        return f"unexpected argument {error.unused_tokens[0]!r}"
    if isinstance(error, wrong.RepeatArgumentError):
        return f"{error.token.keyword} is given twice"
    if isinstance(error, wrong.CoercionError) and error.token is not None:
        name = error.token.keyword or (error.argument.name.upper() if error.argument else "")
        if error.msg is not None:
            return f"{name} {error.msg}"
        value = error.token.value
        if get_origin(error.target_type) is Literal:
            choices = get_args(error.target_type)
            return f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}{did_you_mean(value, choices)}"
        if error.target_type is bool:
            return f"{name} takes no value, got {value!r}"
    return str(error)


def _with_options(message: str, tokens: Sequence[str]) -> str:
    """A message of the package, which names arguments, with the options that they were given by."""
    options = [token.partition("=")[0] for token in tokens if token.startswith("--")]
    given = {"out": "--out", "target": "TARGET"} | {option[2:].replace("-", "_"): option for option in options}
    given |= {field: given[option] for field, option in _FIELDS.items() if option in given and field not in given}
    for name, option in given.items():
        message = re.sub(rf"(?<![\w./:'-])(?:light\.)?{re.escape(name)}(?= (must|needs|belongs)\b|=)", option, message)
    return message


def _file_message(error: OSError) -> str:
    if error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return error.strerror or str(error)


def _show_warning(printed: set[str], message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, UserWarning) and str(message) not in printed:
        printed.add(str(message))
        say(f"warning: {message}")


# --- Progress, files and tables -------------------------------------------------------------------------------------


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Bar]:
    """A callback (done, total) that draws a progress bar and removes it at the end."""
    bar = Bar(label)
    try:
        yield bar
    finally:
        bar.close()


def check_picture(out: Path | None, overwrite: bool) -> None:
    """Raise, before any work, what `save_picture` would raise."""
    if out is not None:
        checks.suffix("--out", out, (".png", ".pdf", ".svg"))
    check_new(out, overwrite)


def check_new(out: Path | None, overwrite: bool) -> None:
    """Raise, before any work, unless a file can be written there."""
    refuse_existing(out, overwrite)
    if out is not None and not out.parent.is_dir():
        raise FileNotFoundError(f"{out} cannot be written: there is no folder {out.parent}")


def refuse_existing(out: Path | None, overwrite: bool, ways: str = "--overwrite or another name") -> None:
    """Raise if a file would be replaced without --overwrite."""
    if out is not None and out.exists() and not overwrite:
        raise FileExistsError(f"{out} exists already; give {ways}")


def save_picture(figure: Figure, out: Path) -> None:
    """Write a figure beside its name and rename it when it is whole."""
    options: dict[str, Any] = {"pil_kwargs": {"compress_level": 4}} if out.suffix == ".png" else {}
    with beside(out) as unfinished:
        figure.savefig(unfinished, format=out.suffix[1:], **options)


def table(content: Mapping[str, str] | Sequence[tuple[str, str]]) -> None:
    """Print two columns on standard output, a label and a text that is never truncated; plain text in a pipe."""
    rows = content.items() if isinstance(content, Mapping) else content
    if not sys.stdout.isatty():
        for label, text in rows:
            print(f"{label:<14} {text}")
        return
    from rich.table import Table
    from rich.text import Text

    both = Table.grid(padding=(0, 2))
    both.add_column(style="bold", no_wrap=True)
    both.add_column(overflow="fold")
    for label, text in rows:
        both.add_row(label, Text(text))
    screen().print(both)


def screen() -> Console:
    """Standard output; without a terminal, lines below 250 columns are not wrapped."""
    from rich.console import Console

    return Console(highlight=False) if sys.stdout.isatty() else Console(highlight=False, width=250)


def grid(title: str, columns: Sequence[str]) -> Table:
    """A table for `screen`: names on the left, numbers on the right."""
    from rich.table import Table
    from rich.text import Text

    empty = Table(
        title=Text(title, style="bold") if title else None,
        title_justify="left",
        box=None,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        header_style="dim",
    )
    for k, name in enumerate(columns):
        empty.add_column(Text(name), justify="left" if k == 0 else "right", overflow="fold")
    return empty
