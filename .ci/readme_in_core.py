"""Run every command and every snippet of Python that README.md prints, in the environment that its first command made.

    python3 .ci/readme_in_core.py [FOLDER OF THE PROGRAMS, by default .venv/bin]

That environment has no extra: what the page shows must need none. Own data, which the commands name, is made here.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = """
import numpy as np, imageio.v3 as imageio
from pathlib import Path
import mars_lidar as ml
Path("rgbd").mkdir()
for k, name in enumerate(["", "rgbd/s0_", "rgbd/s1_"]):
    scene = ml.Scene.example("room", size=(60, 80), seed=k)
    imageio.imwrite(f"{name}depth.png", (1000 * scene.depth_m).astype(np.uint16))
    grey = (255 * scene.reflectivity).astype(np.uint8)
    imageio.imwrite("colors.png" if k == 0 else f"rgbd/s{k - 1}.jpg", np.repeat(grey[..., None], 3, axis=2))
"""
AFTER = """
import xarray
with xarray.open_zarr("set.zarr") as data:
    assert float(data.reflectivity.std()) > 0.05, "the images of the folder were not used"
with xarray.open_zarr("maps.zarr") as data:
    assert float(data.depth.notnull().mean()) > 0.9
"""


def blocks(page: str) -> tuple[list[str], list[str]]:
    """The commands of blocks that are marked to be run, and all snippets of Python."""
    commands = re.findall(r"<!-- run: .*?-->\s*```bash\n(.*?)```", page, re.DOTALL)
    return commands, re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def main() -> None:
    """Run them all; the first that fails ends it."""
    programs = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / ".venv" / "bin").resolve()
    commands, snippets = blocks(ROOT.joinpath("README.md").read_text())
    assert commands
    assert snippets
    with tempfile.TemporaryDirectory() as folder:
        here = {"cwd": folder, "check": True}
        env = os.environ | {
            "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
            "MARS_LIDAR_CACHE": folder + "/cache",
        }
        subprocess.run([programs / "python", "-c", DATA], env=env, **here)
        for command in commands:
            subprocess.run(["bash", "-euxo", "pipefail", "-c", command], env=env, **here)
        subprocess.run([programs / "python", "-c", AFTER], env=env, **here)
        subprocess.run([programs / "python", "-c", "\n".join(snippets)], env=env, **here)


if __name__ == "__main__":
    main()
