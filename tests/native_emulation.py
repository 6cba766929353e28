"""Native code that only tests run, compiled when one asks for it: a GPU's kernels as loops on the processor, and more.

The sources are in ``tests/emulation``; they include the headers of the installed package, so the bits that are compared
are those of what is tested. A C++ compiler is what installing from source needs too: without any the tests are skipped.
"""

import ctypes
import os
import shlex
import shutil
import subprocess
from functools import cache
from hashlib import blake2b
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mars_lidar.engines.cuda.kernels import HEADERS

SOURCES = Path(__file__).resolve().parent / "emulation"
BUILT = SOURCES.parents[1] / "build" / "emulation"
# Bits must not depend on the machine: no fused multiply-add. Small rather than fast.
OPTIONS = ("-std=c++17", "-O1", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden", "-shared")


def compiler() -> list[str]:
    """The command of a C++ compiler: $CXX, or one that is installed; the test is skipped where there is none."""
    if asked := os.environ.get("CXX"):
        return shlex.split(asked)
    for name in ("c++", "g++", "clang++"):
        if estimate := shutil.which(name):
            return [estimate]
    pytest.skip("no C++ compiler (c++, g++, clang++, or $CXX) to build the emulation of a GPU with")


@cache
def library(name: str) -> ctypes.CDLL:
    """What ``tests/emulation/NAME.cpp`` exports, compiled if it or a header has changed."""
    command = [*compiler(), *OPTIONS, f"-I{HEADERS}", f"-I{SOURCES}", str(SOURCES / f"{name}.cpp")]
    contents = blake2b(" ".join(command).encode(), digest_size=8)
    for file in sorted([*HEADERS.rglob("*.h"), *SOURCES.iterdir()]):
        contents.update(file.read_bytes())
    made = BUILT / f"{name}-{contents.hexdigest()}.so"
    if not made.exists():
        BUILT.mkdir(parents=True, exist_ok=True)
        part = made.with_suffix(f".{os.getpid()}")
        result = subprocess.run([*command, "-o", str(part)], capture_output=True, text=True, check=False)
        assert result.returncode == 0, f"{shlex.join(command)}\n{result.stderr}"
        part.replace(made)
    return ctypes.CDLL(str(made))


def run_kernel(name: str, kernel: str, argument: bytes, blocks: int, lanes: int, shared: int) -> None:
    """Run a kernel of ``tests/emulation/NAME.cpp``, by its name in C++, on host addresses; `lanes` threads a block."""
    run = library(name)[f"{name}_on_host"]
    size, threads = ctypes.c_int64(len(argument)), ctypes.c_int32(lanes)
    outcome = run(kernel.encode(), argument, size, ctypes.c_int64(blocks), threads, ctypes.c_int64(shared))
    assert outcome == 0, (kernel, {1: "no such kernel", 2: "not this kernel's argument"}[outcome])


def threefry(counter: tuple[int, int], key: tuple[int, int], rounds: int) -> tuple[int, int]:
    """Threefry-2x32 of the native core."""
    words = (ctypes.c_uint32 * 2)()
    library("random").threefry((ctypes.c_uint32 * 2)(*counter), (ctypes.c_uint32 * 2)(*key), rounds, words)
    return words[0], words[1]


def words_of_key(key: tuple[int, int], n: int) -> list[int]:
    """The first `n` words of the exact engine's stream of a key."""
    words = (ctypes.c_uint32 * n)()
    library("random").words_of_key((ctypes.c_uint32 * 2)(*key), words, ctypes.c_int64(n))
    return list(words)


def poisson_sample(seed: int, mean: float, n: int) -> NDArray[np.int64]:
    """Independent Poisson numbers (n) of the native core."""
    out = np.empty(n, np.int64)
    at = ctypes.c_void_p(out.ctypes.data)
    library("random").poisson_sample(ctypes.c_uint64(seed), ctypes.c_double(mean), at, ctypes.c_int64(n))
    return out
