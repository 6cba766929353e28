"""The committed page is made of these sources, small, and draws golden cubes with the bits of the package's tests."""

import base64
import gzip
import hashlib
import json
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from explorer_page import PAGE, ROOT
from test_detector_bits import GOLDEN as OF_MODES
from test_reproducibility import GOLDEN

INPUTS = ROOT / "explorer" / "inputs.sha256"
SOURCES = ROOT / "explorer" / "src"


def test_the_page_is_made_of_these_sources():
    """Each source that `explorer/build` named as an input has the hash that it had then."""
    listed = dict(reversed(line.split(maxsplit=1)) for line in INPUTS.read_text().splitlines())
    changed = [
        name
        for name, digest in listed.items()
        if not (ROOT / name).is_file() or hashlib.sha256((ROOT / name).read_bytes()).hexdigest() != digest
    ]
    assert not changed, f"the explorer's page is stale: run explorer/build and commit what it writes ({changed})"
    unlisted = {f"explorer/src/{path.name}" for path in SOURCES.iterdir()} - set(listed)
    assert not unlisted, f"the explorer's page was built without {unlisted}: run explorer/build"
    assert {"explorer/native/api.cpp", "src/mars_lidar/native/exact/step.h"} <= set(listed)


def test_size():
    """With everything below 1 MB, and nothing that it would have to fetch."""
    text = PAGE.read_text()
    assert len(text.encode()) < 1_000_000
    assert not re.search(r'(?:src|href)="(?!data:)[^"]', text[: text.index('id="native"')])


def test_the_measurement_finds_its_parts(monkeypatch):
    """`python explorer/measure.py` starts: it stands outside of what the type checker sees."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert callable(runpy.run_path(str(ROOT / "explorer" / "measure.py"))["main"])


def golden_of_page() -> dict[str, str]:
    text = (SOURCES / "golden.js").read_text()
    return dict(re.findall(r'^  "([^"]+)": \[.*, \d, "([0-9a-f]+)"\],$', text, re.MULTILINE))


def test_the_page_expects_the_package_s_golden_bits():
    expected = golden_of_page()
    assert len(expected) == 8
    assert expected == {name: {**GOLDEN, **OF_MODES}[name] for name in expected}


def test_golden_bits_in_node(tmp_path: Path):
    """The WebAssembly of the committed page, run by Node: the bits of eight golden cubes."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs Node")
    native = re.search(r'id="native">([^<]+)<', PAGE.read_text())
    assert native is not None
    module = tmp_path / "explorer.wasm"
    module.write_bytes(gzip.decompress(base64.b64decode(native[1])))
    script = f"""
        import {{ readFileSync }} from "node:fs";
        import {{ Native }} from {json.dumps((SOURCES / "native.js").as_uri())};
        import {{ goldenBits }} from {json.dumps((SOURCES / "golden.js").as_uri())};
        const native = await Native.load(new WebAssembly.Module(readFileSync({json.dumps(str(module))})));
        console.log(JSON.stringify(await goldenBits(native)));
    """
    run = subprocess.run([node, "--input-type=module", "-e", script], capture_output=True, text=True, check=True)
    results = {each["name"]: each["found"] for each in json.loads(run.stdout)}
    assert results == golden_of_page()
