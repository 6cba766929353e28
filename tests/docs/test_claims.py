"""The page of claims names tests that exist, in the tier that it states."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
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
