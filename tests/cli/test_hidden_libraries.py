"""Without any of the optional libraries: one line that names the extra, never a traceback."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from harness import make_system

import mars_lidar as ml

HIDDEN = Path(__file__).parents[1] / "hidden_library.py"
# library, extra, and whether public names and commands are to miss it; each by itself by night
LIBRARIES = [
    ("torch", "learn", True, False),
    ("skimage", "estimate", False, True),
    ("ptufile", "io", False, True),
    ("phconvert", "io", False, True),
    ("OpenEXR", "io", False, False),
    ("distributed", "cluster", False, True),
    ("cupy", "cuda", False, True),
    ("torch,skimage,ptufile,phconvert,OpenEXR,xarray,distributed,cupy", "learn,estimate,io,cluster,cuda", True, True),
]


@pytest.mark.full
@pytest.mark.parametrize(
    ("library", "extra", "names", "commands"),
    [LIBRARIES[0], LIBRARIES[-1], *(pytest.param(*each, marks=pytest.mark.nightly) for each in LIBRARIES[1:-1])],
)
def test_what_misses_a_library_names_its_extra(tmp_path, library, extra, names, commands):
    done = subprocess.run(
        [sys.executable, HIDDEN, library, extra, tmp_path], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    words = re.search(r"(\d+) names and (\d+) commands", done.stdout)
    assert words, done.stdout
    assert (int(words[1]) > 0, int(words[2]) > 0) == (names, commands), done.stdout


def test_an_exr_names_its_extra(tmp_path):
    (tmp_path / "depth.exr").write_bytes(b"")
    code = (
        "import sys; sys.modules['OpenEXR'] = None\nimport mars_lidar as ml\n"
        f"ml.Scene.from_rgbd({str(tmp_path / 'depth.exr')!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'mars-lidar[io]'" in done.stderr.splitlines()[-1]


def test_a_labelled_cube_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    system = make_system(50.0, 10, 8)
    with pytest.raises(ml.io.MissingLibraryError, match=r"mars-lidar\[io\]"):
        ml.to_xarray(np.zeros((1, 1, 1, 8), np.uint16), system)
