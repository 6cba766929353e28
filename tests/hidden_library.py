"""Run in a process of its own: every public name and every command with one optional library hidden.

    python tests/hidden_library.py LIBRARY EXTRA FOLDER

What misses the library must say so in one line that names the extra; everything else works as ever. LIBRARY is one, or
several with commas between them, of whose extras one is to be named; EXTRA may be several likewise. Commands that need
no library are run where several are hidden.
"""

import contextlib
import importlib
import importlib.abc
import io
import pkgutil
import sys
from pathlib import Path


class Hidden(importlib.abc.MetaPathFinder):
    def __init__(self, libraries: list[str]) -> None:
        self.libraries = libraries

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.libraries:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def says(error: BaseException | str, extra: str) -> None:
    message = str(error)
    assert any(f"mars-lidar[{name}" in message for name in extra.split(",")), (
        f"{message!r} does not name the extra {extra}"
    )
    assert len(message.strip().splitlines()) == 1, message


def check_names(extra: str) -> int:
    """Every public name of every public package: there, or a line that names the extra."""
    import mars_lidar
    from mars_lidar._base.imports import MissingLibraryError

    missing = 0
    packages = [mars_lidar.__name__]
    packages += [f"mars_lidar.{package.name}" for package in pkgutil.iter_modules(mars_lidar.__path__) if package.ispkg]
    for name in packages:
        if name.rpartition(".")[2].startswith("_"):
            continue
        module = importlib.import_module(name)
        for public in getattr(module, "__all__", ()):
            try:
                getattr(module, public)
            except MissingLibraryError as error:
                says(error, extra)
                missing += 1
    return missing


def check_commands(extra: str, folder: Path) -> int:
    """Every command's help, and small runs of what reads and writes; those that fail name the extra."""
    from mars_lidar.cli import app, main

    missing = 0

    def run(*arguments: object) -> tuple[int, str, str]:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([str(argument) for argument in arguments])
        return code, out.getvalue(), err.getvalue()

    commands = [[name] for name in app if not name.startswith("-")]
    for words in (*commands, *(["table", name] for name in app["table"] if not name.startswith("-"))):
        code, out, _ = run(*words, "--help")
        assert (code, "Usage" in out) == (0, True), (words, out)
    cube, few = folder / "a.zarr", ("--size", 8, "--cycles", 20, "--bins", 32)
    every = "," in extra
    for needs, *arguments in (
        ("always", "simulate", "--scene", "room", *few, "--no-picture", "-o", cube),
        ("", "info", cube),
        ("", "view", cube, "-o", folder / "view.png"),
        ("estimate", "reconstruct", cube, "--no-picture", "-o", folder / "maps.zarr"),
        ("", "convert", cube, folder / "b.h5"),
        ("io", "convert", cube, folder / "b.ptu"),
        ("", "timestamps", cube, "-o", folder / "a.npz"),
        ("io", "timestamps", cube, "-o", folder / "a.h5"),
        ("io", "timestamps", cube, "-o", folder / "a.ptu"),
        ("", "calibrate", folder / "a.npz", "--look"),
        ("", "generate", "room", *few, "-o", folder / "set.zarr"),
        ("cluster", "generate", "room", *few, "--workers", 1, "-o", folder / "set1.zarr"),
        ("", "verify", folder / "set.zarr"),
        ("cuda", "simulate", "--scene", "room", *few, "--device", "cuda", "-o", folder / "c.zarr"),
        ("", "init", folder / "system.yaml"),
        ("", "schema", "recipe"),
    ):
        if not every and needs not in ("always", extra):
            continue
        code, _, err = run(*arguments)
        if code != 0:
            try:
                says(err, extra)
            except AssertionError as error:
                raise AssertionError(f"{arguments}: {error}") from None
            missing += 1
        elif "mars-lidar[" in err:  # does without, and says so
            missing += 1
    return missing


if __name__ == "__main__":
    library, extra, folder = sys.argv[1:]
    sys.meta_path.insert(0, Hidden(library.split(",")))
    names, commands = check_names(extra), check_commands(extra, Path(folder))
    print(f"{library}: {names} names and {commands} commands named the extra {extra}")
