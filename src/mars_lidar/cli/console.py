"""Messages, exit codes and the progress bar: standard output carries results, standard error the rest."""

from __future__ import annotations

import contextlib
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mars_lidar._base.files import beside
from mars_lidar._base.progress import Bar
from mars_lidar.cli.groups import OPTIONS

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console
    from rich.table import Table

FAILED, BAD_INPUT, MISFIT, INTERRUPTED = 1, 2, 3, 130
_PIPE = 250  # columns where nobody is watching
_FIELDS = {  # of the package, where an option has another name
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


def say(message: str) -> None:
    """One line on standard error."""
    print(f"mars-lidar: {message}", file=sys.stderr)


@contextlib.contextmanager
def reported() -> Iterator[None]:
    """Turn what goes wrong into one line and an exit code; anything unforeseen keeps its traceback."""
    from mars_lidar.io import Interrupted, WriteError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            told: set[str] = set()
            warnings.showwarning = partial(_show_warning, told)
            yield
    except Interrupted as stop:
        say(str(stop))
        raise typer.Exit(INTERRUPTED) from None
    except KeyboardInterrupt:
        say("interrupted")
        raise typer.Exit(INTERRUPTED) from None
    except WriteError as error:
        say(f"failed: {error.strerror}")
        raise typer.Exit(FAILED) from None
    except (FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        say(_of_file(error))
        raise typer.Exit(BAD_INPUT) from None
    except BrokenPipeError:
        raise
    except OSError as error:
        say(f"failed: {_of_file(error)}")
        raise typer.Exit(FAILED) from None
    except (ValueError, TypeError, OverflowError, MemoryError) as error:
        say(_with_options(" ".join(str(error).split())) or type(error).__name__)
        raise typer.Exit(BAD_INPUT) from None


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Bar]:
    """A callback (done, total) that says how far a run is, and is gone at its end."""
    bar = Bar(label)
    try:
        yield bar
    finally:
        bar.close()


def check_picture(out: Path | None, overwrite: bool) -> None:
    """Raise, before any work, what `save_picture` would raise."""
    if out is not None and out.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"--out must end in .png, .pdf or .svg, got {str(out)!r}")
    check_new(out, overwrite)


def check_new(out: Path | None, overwrite: bool) -> None:
    """Raise, before any work, unless a file can be written there."""
    refuse_existing(out, overwrite)
    if out is not None and not out.parent.is_dir():
        raise FileNotFoundError(f"{out} cannot be written: there is no folder {out.parent}")


def refuse_existing(out: Path | None, overwrite: bool, ways: str = "--overwrite or another name") -> None:
    """Raise where a file would be replaced unasked."""
    if out is not None and out.exists() and not overwrite:
        raise FileExistsError(f"{out} exists already; give {ways}")


def two_integers(option: str, text: str, form: str = "Y,X (row, column)") -> tuple[int, int]:
    """What an option of this form gives, such as the pixel (y, x) of ``--pixel Y,X``."""
    try:
        first, second = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} must be two integers {form}, got {text!r}") from None
    return first, second


def two_numbers(option: str, text: str, form: str) -> tuple[float, float]:
    """What an option of this form gives, such as START,STOP."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} must be two numbers {form}, got {text!r}") from None
    return first, second


def save_picture(figure: Figure, out: Path) -> None:
    """Write a figure beside its name and rename it when it is whole."""
    options: dict[str, Any] = {"pil_kwargs": {"compress_level": 4}} if out.suffix == ".png" else {}
    with beside(out) as unfinished:
        figure.savefig(unfinished, format=out.suffix[1:], **options)


def table(told: Mapping[str, str] | Sequence[tuple[str, str]]) -> None:
    """Two columns on standard output: a label, and text that is never cut; plain where it is piped."""
    rows = told.items() if isinstance(told, Mapping) else told
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
    """Standard output; where nobody is watching nothing is folded."""
    from rich.console import Console

    return Console(highlight=False) if sys.stdout.isatty() else Console(highlight=False, width=_PIPE)


def grid(title: str, columns: Sequence[str]) -> Table:
    """A table for `screen`: names on the left, numbers on the right."""
    from rich.table import Table
    from rich.text import Text

    shown = Table(
        title=Text(title, style="bold") if title else None,
        title_justify="left",
        box=None,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        header_style="dim",
    )
    for k, name in enumerate(columns):
        shown.add_column(Text(name), justify="left" if k == 0 else "right", overflow="fold")
    return shown


def _with_options(message: str) -> str:
    """A message of the package, which names arguments, with the options that they were given by."""
    given = OPTIONS.get()
    for name, option in {**{field: given[of] for field, of in _FIELDS.items() if of in given}, **given}.items():
        message = re.sub(rf"(?<![\w./:'-])(?:light\.)?{name}(?= (must|needs|belongs)\b|=)", option, message)
    return message


def _of_file(error: OSError) -> str:
    if error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return error.strerror or str(error)


def _show_warning(told: set[str], message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if issubclass(category, UserWarning) and str(message) not in told:
        told.add(str(message))
        say(f"warning: {message}")
