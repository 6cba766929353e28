"""What the CUDA kernels take, from compiling them without a GPU: `python -m tests.cuda.resources`.

Fills resources.md, which stands beside it, and writes benchmarks/results/gpu-resources.md.
"""

from dataclasses import replace
from pathlib import Path

from mars_lidar import _core
from mars_lidar.engines.cuda.kernels import (
    AHEAD,
    MARS_LAWS,
    Kernel,
    Sink,
    Variant,
    block_bytes,
    feedback_histograms,
    mars_histograms,
    source,
)
from mars_lidar.engines.cuda.mars import LANES
from mars_lidar.engines.pixels import pulse_frame
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from tests.cuda.nvrtc import Resources, compiled, compiled_code, version

TEMPLATE = Path(__file__).with_suffix(".md")
RESULT = Path(__file__).parents[2] / "benchmarks" / "results" / "gpu-resources.md"
MODES = ("non-paralyzable", "paralyzable", "synchronous", "gated")
ARCHITECTURES = ("sm_80", "sm_90")
# NVIDIA H200 SXM, data sheet and CUDA C++ programming guide (compute capability 9.0)
PROCESSORS, SCHEDULERS, CLOCK_HZ, MEMORY_BYTES_PER_S = 132, 4, 1.98e9, 4.8e12
SHARED_BYTES, RESERVED_BYTES, REGISTERS, MOST_THREADS = 228 << 10, 1 << 10, 65536, 2048
ISSUE_PER_S = PROCESSORS * SCHEDULERS * CLOCK_HZ  # instructions of a warp
PIXELS, BINS, REGISTRATIONS = 128 * 128, 1024, 1000
SYSTEM = System(
    period_ns=100.0, cycles=100_000, bins=BINS, pulse=GaussianPulse(sigma_ns=0.5), detector=Detector(dead_time_ns=63.75)
)

# Steps of the kernels alone, to count their instructions; every branch counts, also those seldom taken.
STEPS = """
namespace mars {
MARS_KERNEL nothing(const float* x, uint32_t* n) { n[threadIdx.x] = static_cast<uint32_t>(x[threadIdx.x]); }
MARS_KERNEL two_poisson(const float* x, uint32_t* n) {
    const Pair<uint32_t> word = threefry<13, uint32_t>(threadIdx.x, 3u, n[1], n[2]);
    n[threadIdx.x] = static_cast<uint32_t>(poisson(word.first, x[threadIdx.x])) +
                     static_cast<uint32_t>(poisson(word.second, x[threadIdx.x + 32]));
}
MARS_KERNEL form(const float* x, float* to) {
    const uint32_t j = threadIdx.x;
    const float mixed = (x[0] * x[j] + x[1] * x[j + 100]) + (x[2] * x[j + 200] + x[3] * x[j + 300]);
    const float past = x[4] * mixed;
    to[j] = (mixed - past) + x[j + 400];
    to[j + 1000] = to[j + 500] + mixed;
}
}  // namespace mars
"""


def main() -> None:
    plain = Variant(0, gaussian=True, whole=False, single=True, sink=Sink.BLOCK16)
    variants = [plain, replace(plain, whole=True), replace(plain, gaussian=False), replace(plain, single=False)]
    variants += [replace(plain, mode=mode, whole=mode != 2) for mode in (1, 2, 3)]
    variants += [replace(plain, sink=sink) for sink in (Sink.ROWS16, Sink.COUNTS, Sink.TIMESTAMPS)]
    others = [MARS_LAWS, *map(mars_histograms, (False, True)), *map(feedback_histograms, (False, True))]
    shorter = replace(plain, ahead=AHEAD // 2)
    rows: list[str] = []
    other_rows: list[str] = []
    for architecture in ARCHITECTURES:  # the bounds are for the last of them
        exact = compiled([variant.kernel for variant in [*variants, shorter]], architecture)
        rows += [row(architecture, variant, exact[variant.kernel]) for variant in variants]
        beside = compiled(others, architecture)
        other_rows += [other_row(architecture, kernel, used) for kernel, used in beside.items()]
    slope = (exact[plain.kernel].instructions - exact[shorter.kernel].instructions) / (AHEAD - shorter.ahead)
    bounds = estimate(slope, exact[plain.kernel].registers) | mars_estimate(beside) | feedback_estimate(beside)
    text = TEMPLATE.read_text(encoding="utf-8").format(rows="\n".join(rows), other_rows="\n".join(other_rows), **bounds)
    RESULT.write_text(text)
    print(text)


def row(architecture: str, variant: Variant, used: Resources) -> str:
    spills = used.spill_stores + used.spill_loads
    return (
        f"| {architecture} | {MODES[variant.mode]} | {'Gaussian' if variant.gaussian else 'sampled'} "
        f"| {'whole' if variant.whole else 'any'} | {'1' if variant.single else 'up to 16'} | {variant.sink.name} "
        f"| {used.registers} | {used.stack_bytes} | {spills} | {used.instructions} |"
    )


def other_row(architecture: str, kernel: Kernel, used: Resources) -> str:
    spills = used.spill_stores + used.spill_loads
    shared = mars_block() if "mars_histograms" in kernel.expression else 0
    return (
        f"| {architecture} | `{kernel.expression.removeprefix('mars::')}` | {used.registers} | {used.stack_bytes} "
        f"| {spills} | {shared} | {used.instructions} |"
    )


def mars_block() -> int:
    frame = pulse_frame(SYSTEM)
    return int(_core.mars_block_bytes(BINS, frame.energy.shape[1], frame.cells, SYSTEM.dead_time_periods))


def estimate(slope: float, registers: int) -> dict[str, object]:
    """Bounds of an H200 for the exact engine, from the number of instructions and of bytes."""
    block = block_bytes(BINS, 32)
    warps = min(SHARED_BYTES // (block + RESERVED_BYTES), REGISTERS // (32 * registers))
    issue = ISSUE_PER_S * 32 / slope
    written = 2 * PIXELS * BINS * 2  # set to zero, then written
    return {
        "version": version(),
        "lanes": LANES,
        "bins": BINS,
        "registrations": REGISTRATIONS,
        "slope": slope,
        "processors": PROCESSORS,
        "schedulers": SCHEDULERS,
        "clock_ghz": CLOCK_HZ / 1e9,
        "issue": issue,
        "issue_cubes": issue / (PIXELS * REGISTRATIONS),
        "memory_tb": MEMORY_BYTES_PER_S / 1e12,
        "written_mb": written / 1e6,
        "memory_cubes": MEMORY_BYTES_PER_S / written,
        "warps": warps,
        "block_kb": block / 1024,
        "warps_each": warps / SCHEDULERS,
    }


def mars_steps() -> dict[str, Resources]:
    """The steps of the engine mars, each compiled alone, by their names in C++."""
    names = ["mars::nothing", "mars::two_poisson", "mars::form"]
    return compiled_code(source(MARS_LAWS.header) + STEPS, names, "sm_90")


def mars_estimate(result: dict[Kernel, Resources]) -> dict[str, object]:
    """The same for mars at 1e5 cycles: rounds of Poisson numbers in all bins."""
    steps = mars_steps()
    nothing = steps["mars::nothing"].instructions
    each = (steps["mars::two_poisson"].instructions - nothing) / 2.0 + steps["mars::form"].instructions - nothing
    written = PIXELS * BINS * 4
    block, registers = mars_block(), result[mars_histograms(True)].registers
    blocks = min(SHARED_BYTES // (block + RESERVED_BYTES), REGISTERS // (LANES * registers), MOST_THREADS // LANES)
    return {
        "mars_each": each,
        "mars_issue_cubes": ISSUE_PER_S * 32 / (each * BINS * PIXELS),
        "mars_mb": written / 1e6,
        "mars_cubes": MEMORY_BYTES_PER_S / written,
        "mars_blocks": blocks,
        "mars_block_kb": block / 1024,
        "mars_registers": registers,
        "mars_warps": blocks * LANES // 32 / SCHEDULERS,
    }


def feedback_estimate(result: dict[Kernel, Resources]) -> dict[str, object]:
    """The same for feedback: its sweeps read and write memory."""
    cells, sweeps = BINS, 8
    mean, integer = 4 * 4.0, 4 * 7.0 + 2.0  # bytes of a cell, read and written: sums, rates; history, quantiles, dither
    moved = PIXELS * cells * sweeps * (mean + integer)
    return {
        "sweeps": sweeps,
        "cells": cells,
        "moved_gb": moved / 1e9,
        "moved_cubes": MEMORY_BYTES_PER_S / moved,
        "work_mb": int(_core.feedback_warp_bytes(cells, 1)) / 1e6,
        "feedback_registers": result[feedback_histograms(False)].registers,
    }


if __name__ == "__main__":
    main()
