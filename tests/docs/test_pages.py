"""The pages' code: every block is run by `.ci/pages.py`, or says why not; the site names every page and public name."""

import ast
import importlib.util
import itertools
import json
import re
import shlex
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from harness import refused

from benchmarks import readme
from studies.registry import STUDIES

ROOT = Path(__file__).resolve().parents[2]


def _load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("pages", ROOT / ".ci" / "pages.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["pages"] = module
    spec.loader.exec_module(module)
    return module


pages = _load()
PAGES = [page.relative_to(ROOT).as_posix() for page in pages.pages()]
ALL = [(name, block) for name in PAGES for block in pages.blocks(ROOT.joinpath(name).read_text(encoding="utf-8"))]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


@pytest.mark.parametrize("name", PAGES)
def test_no_fence_is_overlooked(name: str):
    text = ROOT.joinpath(name).read_text(encoding="utf-8")
    fences = len(re.findall(r"^ *(?:```)[^`\n]*$", text, re.MULTILINE))
    directives = len(re.findall(r"^```\{", text, re.MULTILINE))
    assert fences == 2 * (len(pages.blocks(text)) + directives)
    assert not re.findall(r"^\s*~~~", text, re.MULTILINE)


def test_every_block_says_what_it_is():
    for name, block in ALL:
        where = f"{name}:{block.line}"
        assert block.language in ("bash", "python", "yaml", *pages.SHOWN), f"{where}: {block.language!r}"
        assert set(block.extras) <= set(EXTRAS), where
        if block.mark == "run":
            assert block.small, where  # refuses a number that the block does not have
        if block.mark == "not run":
            assert len(block.words) > 10, f"{where}: why?"


def test_blocks_that_are_not_run_could_be():
    """Those that need a GPU, a cluster or hours are at least whole, and name studies that there are."""
    left_out = [(name, block) for name, block in ALL if block.mark in ("not run", "command")]
    assert len(left_out) < len(ALL) / 3
    for name, block in left_out:
        if block.language == "python":
            ast.parse(block.code, f"{name}:{block.line}")
            continue
        subprocess.run(["bash", "-n", "-c", block.code], check=True)
        for line in block.code.splitlines():
            words = shlex.split(line, comments=True)
            if words[:3] == ["python", "-m", "studies"]:
                named = set(itertools.takewhile(lambda word: not word.startswith("--"), words[3:]))
                assert named <= set(STUDIES), f"{name}: {line}"


def test_an_unmarked_block_runs():
    (block,) = pages.blocks("text\n\n```python\nspace = 1\n```\n")
    space: dict[str, object] = {}
    pages.run_block(block, space)
    assert space["space"] == 1
    (failing,) = pages.blocks("```bash\nfalse\n```\n")
    refused("", pages.run_block, failing, {}, error=subprocess.CalledProcessError)
    refused("nothing is known", pages.run_block, pages.blocks("```ruby\nputs 1\n```\n")[0], {}, error=SystemExit)


def test_marks_are_read():
    text = "<!-- run: with depth.png, rgbd/; extra io, learn; 100 -> 2 -->\n```bash\nrun 100\n```\n"
    (block,) = pages.blocks(text)
    assert (block.files, block.extras, block.small) == (["depth.png", "rgbd/"], ["io", "learn"], "run 2\n")
    assert pages.blocks(text.replace("100 ->", "101 ->"))[0].mark == "run"
    with pytest.raises(SystemExit, match="no '101'"):
        assert pages.blocks(text.replace("100 ->", "101 ->"))[0].small


def test_the_gallery_is_short():
    examples = sorted(ROOT.glob("examples/gallery/plot_*.py"))
    assert len(examples) >= 12
    for path in examples:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        body = path.read_text(encoding="utf-8").splitlines()[tree.body[0].end_lineno :]
        lines = [line for line in body if line.strip() and not line.lstrip().startswith("#")]
        assert len(lines) <= 32, path.name


def test_the_site_has_every_public_name():
    reference = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^   ([\w.]+)$", reference, re.MULTILINE))
    for module in ("mars_lidar", "mars_lidar.io", "mars_lidar.learn", "mars_lidar.plot"):
        names = {name for name in import_module(module).__all__ if name not in ("__version__", "SUFFIXES")}
        assert names <= listed, f"{module}: {sorted(names - listed)}"


def test_metadata_agree():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    zenodo = json.loads((ROOT / ".zenodo.json").read_text())
    assert citation["version"] == version
    assert citation["license"] == zenodo["license"] == "MIT"
    assert set(citation["keywords"]) <= set(zenodo["keywords"])
    for form in ROOT.glob(".github/ISSUE_TEMPLATE/*.yml"):
        assert {"name", "description", "body"} <= set(yaml.safe_load(form.read_text(encoding="utf-8")))


# What README promises runs as written.


README = ROOT.joinpath("README.md").read_text()


def test_python():
    own, *more = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    space: dict[str, object] = {}
    exec(own, space)
    assert space["cube"].shape == (1, 48, 64, 1024)
    assert np.nanmedian(np.abs(space["estimate"].depth_m - space["depth_m"])) < 0.02
    for code in more:  # each goes on where the one before ended
        exec(code, space)


def test_commands_that_the_checks_run_are_there():
    for name in ("main", "tests"):
        result = subprocess.run(
            [sys.executable, ROOT / ".ci" / "readme_command.py", name], capture_output=True, text=True, check=True
        )
        assert ".venv/bin/" in result.stdout


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+?)\)", README):
        assert target.startswith("https://") or ROOT.joinpath(target).exists(), target


@pytest.mark.parametrize("name", readme.TABLES)
def test_tables_of_figures_are_those_of_the_saved_run(name: str):
    text, wanted = readme.filled(name)
    assert text == wanted


# The page of claims names tests that exist, in the tier that it states.


NIGHTLY = ("python -m ", "docs/results/")  # programs and reports, named beside tests


def tiers_of(name: str) -> set[str]:
    """Tiers that a test function, or the functions of a file of tests, belong to."""
    file, _, wanted = name.partition("::")
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    whole = any(isinstance(node, ast.Assign) and "pytest.mark.full" in ast.unparse(node) for node in tree.body)
    tests = [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and wanted in ("", node.name)
    ]
    assert tests, name
    marked = [any("mark.full" in ast.unparse(decorator) for decorator in node.decorator_list) for node in tests]
    if not wanted:
        return {"fast"} if not all(marked) else {"full"}
    return {"full" if whole or any(marked) else "fast"}


def test_each_claim_names_tests_of_its_tier():
    page = (ROOT / "docs" / "claims.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("|")][2:]
    assert len(rows) > 20
    wrong = []
    for claim, stated, guards in rows:
        names = re.findall(r"`([^`]+)`", guards)
        tests = [name for name in names if name.startswith("tests/")]
        guarded = set().union(*(tiers_of(name) for name in tests))
        guarded |= {"fast"} if ".ci/pages.py" in names else set()
        if any(name.startswith(NIGHTLY) for name in names):
            guarded.add("nightly")
        if guarded != set(stated.split(", ")):
            wrong.append(f"{claim}: {sorted(guarded)}, not {stated}")
    assert not wrong, "\n".join(wrong)
