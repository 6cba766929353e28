"""The command line run in this process: its exit code and what it prints."""

import contextlib
import io
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cyclopts import App
from cyclopts.argument import Argument

from mars_lidar.cli import app as mars_lidar
from mars_lidar.cli import main


@dataclass(frozen=True)
class Done:
    """A command that ended; `output` is both streams in the order of their lines."""

    exit_code: int
    stdout: str
    stderr: str
    output: str


class _Stream(io.StringIO):
    def __init__(self, both: io.StringIO) -> None:
        super().__init__()
        self.both = both

    def write(self, text: str) -> int:
        self.both.write(text)
        return super().write(text)


def command_line(arguments: Sequence[object], *, input: str = "", main: Callable[[Sequence[str]], int] = main) -> Done:
    """Run ``mars-lidar ARGUMENTS``, or another `main`."""
    both = io.StringIO()
    out, err, stdin = _Stream(both), _Stream(both), sys.stdin
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        sys.stdin = io.StringIO(input)
        try:
            code = main([str(argument) for argument in arguments])
        finally:
            sys.stdin = stdin
    return Done(code, out.getvalue(), err.getvalue(), both.getvalue())


def run(*arguments: object) -> Done:
    """Run ``mars-lidar ARGUMENTS``."""
    return command_line(arguments)


def ok(*arguments: object) -> Done:
    """Run ``mars-lidar ARGUMENTS``, which succeeds."""
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    return done


def fails(words: str, *arguments: object) -> Done:
    """Run ``mars-lidar ARGUMENTS``, which ends with 2 and these words on standard error, however they are wrapped."""
    done = run(*arguments)
    assert done.exit_code == 2, done.output
    assert words in " ".join(done.stderr.split()), done.output
    return done


def options_of(*commands: str, app: App = mars_lidar) -> dict[str, Argument]:
    """The arguments of a command by the longest name of their option."""
    for command in commands:
        app = app[command]
    arguments = [argument for argument in app.assemble_argument_collection() if argument.name.startswith("--")]
    return {argument.name: argument for argument in arguments}


def listen_to_ctrl_c() -> None:
    """In a child: shells start background processes, and so whole test runs, with Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def stopped(process: subprocess.Popen[str], how: signal.Signals) -> tuple[str, float]:
    """Stop a process by a signal: what it printed, and the seconds of a processor that it took from then to its end.

    Other work on the machine lengthens the time by a clock, and not that of a processor.
    """
    import psutil  # wheels are tested without it

    before, taken = _children_s(), sum(psutil.Process(process.pid).cpu_times()[:2])
    process.send_signal(how)
    out, err = process.communicate(timeout=300.0)
    return (out or "") + (err or ""), _children_s() - before - taken


def _children_s() -> float:
    """Seconds of a processor that the children that have ended took."""
    import psutil

    used = psutil.Process().cpu_times()
    return used.children_user + used.children_system
