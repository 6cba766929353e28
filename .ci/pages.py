"""Run every command and every snippet that README and the pages of docs/ print, each page in an empty folder.

    .venv/bin/python .ci/pages.py core            # blocks that need no extra; the environment must have none
    .venv/bin/python .ci/pages.py extras          # all blocks of the pages that need one
    .venv/bin/python .ci/pages.py core README.md  # some pages

Blocks of one page run in its order, Python in one namespace. A block runs as it stands unless a comment above it says
what it needs (parts separated by semicolons):

    <!-- run: with depth.png, rgbd/; extra io; 10_000 -> 16 -->   files (FILES makes them), extras, smaller numbers
    <!-- run: as scene.yaml; by mars-lidar simulate --scene scene.yaml -o a.zarr -->   a file, and what reads it
    <!-- run: core only -->   not again where the page's other blocks have their extras
    <!-- not run: why -->

Commands after ``<!-- command: NAME -->`` are those that `.ci/run` itself runs. tests/docs/test_pages.py holds that
nothing else is left out.
"""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # a script's own folder, also where it is imported
from page_files import FILES, make

ROOT = Path(__file__).resolve().parents[1]
GENERATED = ("docs/api", "docs/copied", "docs/gallery", "docs/katex", "docs/lessons")
SHOWN = ("text", "console")  # what a program prints, drawings
_FENCE = re.compile(
    r"^(?:<!-- (?P<mark>run|not run|command): (?P<words>.*?) -->[ \t]*\n+)?"
    r"```(?P<language>[^\n`]*)\n(?P<code>.*?)^```[ \t]*$",
    re.MULTILINE | re.DOTALL,
)
_START = """
import numpy
import zarr
assert zarr.open("set.zarr")["reflectivity"][:].std() > 0.05, "the images of the folder were not used"
assert numpy.isfinite(zarr.open("maps.zarr")["depth"][:]).mean() > 0.9
assert (times.histogram() == cube[0]).all()
assert abs(law.mean - mean.sum()) < 1e-3 * law.mean
"""
AFTER = {"docs/start.md": _START}  # what must hold when a page has run


@dataclasses.dataclass(frozen=True)
class Block:
    """A block of code, and what the comment above it says."""

    line: int
    language: str
    code: str
    mark: str
    words: str

    @property
    def extras(self) -> list[str]:
        """Extras that it needs."""
        return [name for part in self._parts("extra ") for name in re.split(r"[,\s]+", part)]

    @property
    def files(self) -> list[str]:
        """Files that it needs, of those that can be made."""
        return [name for name in FILES if re.search(rf"(?<![\w/.]){re.escape(name)}(?!\w)", self.words)]

    @property
    def name(self) -> str:
        """The file that it is."""
        return next(iter(self._parts("as ")), "")

    @property
    def reader(self) -> str:
        """The command that reads the file."""
        return next(iter(self._parts("by ")), "")

    @property
    def small(self) -> str:
        """The code with smaller numbers."""
        code = self.code
        for part in self.words.split(";"):
            if " -> " in part:
                here, there = (side.strip() for side in part.split(" -> "))
                if here not in code:
                    raise SystemExit(f"line {self.line}: no {here!r} in the block")
                code = code.replace(here, there)
        return code

    def _parts(self, head: str) -> list[str]:
        parts = (part.strip() for part in self.words.split(";"))
        return [part.removeprefix(head).strip() for part in parts if part.startswith(head)]


def pages() -> list[Path]:
    """README, the guide for contributors, and docs/."""
    docs = (page for page in sorted(ROOT.glob("docs/**/*.md")) if not str(page.relative_to(ROOT)).startswith(GENERATED))
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *docs]


def blocks(text: str) -> list[Block]:
    """The blocks of a page in their order; directives of the site are no code."""
    found = []
    for block in _FENCE.finditer(text):
        language = block["language"].strip()
        if not language.startswith("{"):
            line = text.count("\n", 0, block.start("code"))
            found.append(Block(line, language, block["code"], block["mark"] or "", block["words"] or ""))
    return found


def chosen(page: Path, environment: str) -> list[Block]:
    """What is to be run of a page in an environment."""
    found = [b for b in blocks(page.read_text(encoding="utf-8")) if b.language not in SHOWN and b.mark != "command"]
    if environment == "extras":
        again = [block for block in found if not block._parts("core only")]
        return again if any(block.extras for block in found) else []
    return [block for block in found if not block.extras]


def _shell(code: str) -> None:
    subprocess.run(
        ["bash", "-euxo", "pipefail", "-c", code], check=True, text=True, input="y\n" * 9
    )  # who is asked agrees


def run_block(block: Block, space: dict[str, object]) -> None:
    """One block, in the folder in which this process is."""
    for name in block.files:
        make(name)
    if block.language in ("bash", "sh"):
        _shell(block.small)
    elif block.language == "python":
        exec(compile(block.small, f"line {block.line}", "exec"), space)
    elif block.language == "yaml" and block.name and block.reader:
        Path(block.name).write_text(block.small, encoding="utf-8")
        _shell(block.reader)
    else:
        raise SystemExit(f"line {block.line}: nothing is known of blocks {block.language!r}; yaml needs 'as' and 'by'")


def run_page(page: Path, environment: str) -> None:
    """All blocks of a page, in the folder in which this process is."""
    space: dict[str, object] = {"__name__": "__main__"}
    for block in chosen(page, environment):
        if block.mark == "not run":
            print(f"-- line {block.line} is not run: {block.words}", flush=True)
        else:
            begun = time.process_time(), os.times().children_user
            run_block(block, space)
            used = time.process_time() - begun[0] + os.times().children_user - begun[1]
            print(f"-- line {block.line}: {used:.1f} s of a processor", flush=True)
    if environment == "core":
        exec(AFTER.get(page.relative_to(ROOT).as_posix(), ""), space)


def main() -> None:
    """Run them all, as many pages at once as there are processors; the first that fails ends it."""
    environment, *names = sys.argv[1:]
    assert environment in ("core", "extras", "page"), __doc__
    if environment == "page":
        run_page(Path(names[0]), names[1])
        return
    with tempfile.TemporaryDirectory() as cache:
        env = os.environ | {
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "MARS_LIDAR_CACHE": cache,
            "MPLBACKEND": "agg",
        }
        if environment == "extras":  # pages about the studies are read in a checkout
            env["PYTHONPATH"] = os.pathsep.join(filter(None, [env.get("PYTHONPATH"), str(ROOT)]))
        wanted = [page for page in [ROOT / name for name in names] or pages() if chosen(page, environment)]
        with ThreadPoolExecutor(os.cpu_count()) as workers:  # each waits for a process
            runs = {workers.submit(_page_alone, page, environment, env): page.relative_to(ROOT) for page in wanted}
            for run in as_completed(runs):
                done, seconds = run.result()
                print(done.stdout, end="")
                print(f"== {runs[run]}: {seconds:.1f} s", flush=True)
                if done.returncode:
                    workers.shutdown(cancel_futures=True)
                    raise SystemExit(f"{runs[run]} does not run")


def _page_alone(page: Path, environment: str, env: dict[str, str]) -> tuple[subprocess.CompletedProcess[str], float]:
    """A page in a process and a folder of its own: what it printed, and the seconds that it took."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "page", str(page), environment]
        done = subprocess.run(
            command,
            env=env,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    return done, time.perf_counter() - begun


if __name__ == "__main__":
    main()
