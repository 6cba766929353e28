"""The source of the kernels, their compilation, and the choice of the kernel of a task."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from hashlib import blake2b
from pathlib import Path

from mars_lidar._base.native import _core
from mars_lidar.engines.engine import Task
from mars_lidar.instrument.detector import MODES

HEADERS = Path(__file__).resolve().parents[2] / "native"
AHEAD = 8  # registrations drawn ahead; changes speed only
# For the same bits as on the processor: no fused multiply-add, IEEE division, subnormal numbers.
OPTIONS = (
    "-std=c++17",  # in this form, which CuPy recognises; else it adds another
    "--fmad=false",
    "--prec-div=true",
    "--prec-sqrt=true",
    "--ftz=false",
    "--device-as-default-execution-space",
)


@cache
def source(header: str) -> str:
    """The source that is compiled. It contains a hash of the headers, by which CuPy caches compiled kernels."""
    contents = blake2b(digest_size=16)
    for file in sorted(HEADERS.rglob("*.h")):
        contents.update(file.read_bytes())
    return f'// {contents.hexdigest()}\n#include "{header}"\n'


@dataclass(frozen=True)
class Kernel:
    """One kernel: its header in `native`, and its name in C++."""

    header: str
    expression: str


MARS_LAWS = Kernel("cuda/mars.h", "mars::mars_laws")


def mars_histograms(wide: bool) -> Kernel:
    """The kernel that draws histograms of uint32 (`wide`) or uint16."""
    return Kernel("cuda/mars.h", f"mars::mars_histograms<{str(wide).lower()}>")


def feedback_histograms(wide: bool) -> Kernel:
    """The kernel of engine "feedback", for histograms of uint32 (`wide`) or uint16."""
    return Kernel("cuda/feedback.h", f"mars::feedback_histograms<{str(wide).lower()}>")


class Sink(IntEnum):
    """Where registrations go, `DeviceSink` of native/cuda/exact.h."""

    COUNTS = 0
    BLOCK16 = 1  # histograms counted in the memory of a block, with 8 bits a bin, then written as uint16
    BLOCK32 = 2
    ROWS16 = 3  # histograms counted in the device's memory
    ROWS32 = 4
    TIMESTAMPS = 5


@dataclass(frozen=True)
class Variant:
    """One instance of the kernel ``exact_items``."""

    mode: int
    gaussian: bool
    whole: bool  # a dead time of whole periods
    single: bool  # one return at most
    sink: Sink
    ahead: int = AHEAD

    @classmethod
    def of(cls, task: Task, sink: Sink) -> Variant:
        """The variant for a task."""
        return cls(
            mode=MODES.index(task.system.detector.mode),
            gaussian=_core.device_tables(task.pulse)["inverse"].size > 0,
            whole=_core.device_whole(task.job, task.pulse),
            single=len(task.flux.returns_signal) <= 1,
            sink=sink,
        )

    @property
    def kernel(self) -> Kernel:
        """The kernel of this variant."""
        flags = ", ".join(str(flag).lower() for flag in (self.gaussian, self.whole, self.single))
        return Kernel("cuda/exact.h", f"mars::exact_items<{self.mode}, {flags}, {int(self.sink)}, {self.ahead}>")


def overflow(itemsize: int) -> OverflowError:
    """The error of the engines for a count beyond the range of its type."""
    most = 2 ** (8 * itemsize) - 1
    return OverflowError(
        f"a histogram bin exceeds {most} counts: use fewer cycles, less flux"
        + (", or an output of uint32" if itemsize < 4 else "")
    )


def block_bytes(bins: int, lanes: int) -> int:
    """Shared memory of a block that counts histograms of its `lanes` threads: 8 bits a bin."""
    return 4 * ((bins + 3) // 4) * lanes
