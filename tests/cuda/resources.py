"""What the CUDA kernels take, from compiling them without a GPU: `python -m tests.cuda.resources`.

Writes benchmarks/results/gpu-resources.md.
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
    others = [
        MARS_LAWS,
        mars_histograms(False),
        mars_histograms(True),
        feedback_histograms(False),
        feedback_histograms(True),
    ]
    shorter = replace(plain, ahead=AHEAD // 2)
    lines = [
        "# Kernels on CUDA",
        "",
        f"Made by `python -m tests.cuda.resources` with NVRTC {version()}; compiled, not run.",
        "",
        "## Engine `exact`",
        "",
        "| architecture | mode | pulse | dead time | returns | to | registers | stack B | spill B | instructions |",
        "|---|---|---|---|---|---|--:|--:|--:|--:|",
    ]
    more = [
        "",
        "## Engines `mars` and `feedback`",
        "",
        f"Shared memory: of a block of {LANES} threads at {BINS} bins and a pulse of sigma 0.5 ns in 100 ns. Functions "
        "that are called (laws of narrow counts) are not in the number of instructions.",
        "",
        "| architecture | kernel | registers | stack B | spill B | shared B | instructions |",
        "|---|---|--:|--:|--:|--:|--:|",
    ]
    slope = 0.0
    for architecture in ARCHITECTURES:
        result = compiled([variant.kernel for variant in [*variants, shorter]], architecture)
        lines += [row(architecture, variant, result[variant.kernel]) for variant in variants]
        slope = (result[plain.kernel].instructions - result[shorter.kernel].instructions) / (AHEAD - shorter.ahead)
        registers = result[plain.kernel].registers
        found_others = compiled(others, architecture)
        more += [other_row(architecture, kernel, used) for kernel, used in found_others.items()]
    lines += more
    lines += ["", *estimate(slope, registers), "", *mars_estimate(found_others), "", *feedback_estimate(found_others)]
    text = "\n".join(lines) + "\n"
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


def estimate(slope: float, registers: int) -> list[str]:
    """Bounds of an H200 for the exact engine, from the number of instructions and of bytes."""
    block = block_bytes(BINS, 32)
    warps = min(SHARED_BYTES // (block + RESERVED_BYTES), REGISTERS // (32 * registers))
    issue = ISSUE_PER_S * 32 / slope
    written = 2 * PIXELS * BINS * 2  # set to zero, then written
    return [
        f"## Bounds for an NVIDIA H200: `exact`, 128 x 128 pixels, {BINS} bins, {REGISTRATIONS} registrations a pixel",
        "",
        f"- Instructions of one registration (growth of the code with the registrations drawn ahead, sm_90, all "
        f"branches counted, also those for waits beyond 128 periods): at most {slope:.0f}.",
        f"- Issue of instructions ({PROCESSORS} multiprocessors x {SCHEDULERS} x {CLOCK_HZ / 1e9:.2f} GHz): "
        f"{issue:.2g} registrations/s, {issue / (PIXELS * REGISTRATIONS):.0f} cubes/s.",
        f"- Memory ({MEMORY_BYTES_PER_S / 1e12:.1f} TB/s; {written / 1e6:.0f} MB a cube, zeroed and written): "
        f"{MEMORY_BYTES_PER_S / written:.0f} cubes/s.",
        f"- Warps on a multiprocessor: {warps} ({block / 1024:.0f} KB of counters a warp). That is "
        f"{warps / SCHEDULERS:.1f} a scheduler, too few to hide every wait: latency, not issue, is the likely limit, "
        "and only a run on a GPU tells it (`python -m benchmarks.gpu`).",
    ]


def mars_steps() -> dict[str, Resources]:
    """The steps of the engine mars, each compiled alone, by their names in C++."""
    names = ["mars::nothing", "mars::two_poisson", "mars::form"]
    return compiled_code(source(MARS_LAWS.header) + STEPS, names, "sm_90")


def mars_estimate(result: dict[Kernel, Resources]) -> list[str]:
    """The same for mars at 1e5 cycles: rounds of Poisson numbers in all bins."""
    steps = mars_steps()
    nothing = steps["mars::nothing"].instructions
    each = (steps["mars::two_poisson"].instructions - nothing) / 2.0 + steps["mars::form"].instructions - nothing
    issue = ISSUE_PER_S * 32 / (each * BINS * PIXELS)
    written = PIXELS * BINS * 4
    block, used = mars_block(), result[mars_histograms(True)]
    blocks = min(SHARED_BYTES // (block + RESERVED_BYTES), REGISTERS // (LANES * used.registers), MOST_THREADS // LANES)
    return [
        f"## Bounds for an NVIDIA H200: `mars` with a table, 128 x 128 pixels, {BINS} bins of uint32, N_r = 1e5",
        "",
        f"- Instructions of one bin of one exposure (form the shape, draw one round; steps compiled by "
        f"themselves, sm_90, all branches counted: Poisson numbers by terms and by expansion): at most {each:.0f}.",
        f"- Issue of instructions: {issue:.0f} cubes/s.",
        f"- Memory ({written / 1e6:.0f} MB a cube, written once): {MEMORY_BYTES_PER_S / written:.0f} cubes/s.",
        f"- Blocks of {LANES} threads on a multiprocessor: {blocks} ({block / 1024:.1f} KB a block, {used.registers} "
        f"registers a thread), {blocks * LANES // 32 / SCHEDULERS:.0f} warps a scheduler. What one thread of a block "
        "does alone (A in the frame, the count, removals) waits while the other blocks go on.",
    ]


def feedback_estimate(result: dict[Kernel, Resources]) -> list[str]:
    """The same for feedback: its sweeps read and write memory."""
    cells, sweeps = BINS, 8
    mean, integer = 4 * 4.0, 4 * 7.0 + 2.0  # bytes of a cell, read and written: sums, rates; history, quantiles, dither
    moved = PIXELS * cells * sweeps * (mean + integer)
    work = int(_core.feedback_warp_bytes(cells, 1))
    return [
        f"## Bounds for an NVIDIA H200: `feedback`, 128 x 128 pixels, {BINS} bins, any exposure",
        "",
        f"- Memory: where a pixel needs {sweeps} sweeps of the mean and {sweeps} of integers, these on {cells} cells "
        f"move {moved / 1e9:.1f} GB a cube: {MEMORY_BYTES_PER_S / moved:.0f} cubes/s. Fewer sweeps where the "
        "background is dim, more cells where the pulse is narrow or the exposure long.",
        f"- Work area: {work / 1e6:.2f} MB a warp, {result[feedback_histograms(False)].registers} registers a thread. "
        "The 50 MB of the second-level cache hold those of a few dozen warps, so that sweeps go to memory.",
    ]


if __name__ == "__main__":
    main()
