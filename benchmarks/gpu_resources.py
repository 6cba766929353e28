"""What the kernels of `mars_lidar.gpu` take, from compiling them without a GPU: `python -m benchmarks.gpu_resources`.

Writes benchmarks/results/gpu-resources.md.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.nvrtc import Resources, compiled, version
from mars_lidar.gpu.kernels import AHEAD, Sink, Variant, block_bytes

RESULT = Path(__file__).parent / "results" / "gpu-resources.md"
MODES = ("non-paralyzable", "paralyzable", "synchronous", "gated")
ARCHITECTURES = ("sm_80", "sm_90")
# NVIDIA H200 SXM, data sheet and CUDA C++ programming guide (compute capability 9.0)
PROCESSORS, SCHEDULERS, CLOCK_HZ, MEMORY_BYTES_PER_S = 132, 4, 1.98e9, 4.8e12
SHARED_BYTES, RESERVED_BYTES, REGISTERS = 228 << 10, 1 << 10, 65536
WORKLOAD = "128 x 128 pixels, 1024 bins, 1000 registrations a pixel"
PIXELS, BINS, REGISTRATIONS = 128 * 128, 1024, 1000


def main() -> None:
    plain = Variant(0, gaussian=True, whole=False, single=True, sink=Sink.BLOCK16)
    variants = [plain, replace(plain, whole=True), replace(plain, gaussian=False), replace(plain, single=False)]
    variants += [replace(plain, mode=mode, whole=mode != 2) for mode in (1, 2, 3)]
    variants += [replace(plain, sink=sink) for sink in (Sink.ROWS16, Sink.COUNTS, Sink.TIMESTAMPS)]
    shorter = replace(plain, ahead=AHEAD // 2)
    lines = [
        "# Kernels of the exact engine on CUDA",
        "",
        f"Made by `python -m benchmarks.gpu_resources` with NVRTC {version()}; compiled, not run.",
        "",
        "| architecture | mode | pulse | dead time | returns | to | registers | stack B | spill B | instructions |",
        "|---|---|---|---|---|---|--:|--:|--:|--:|",
    ]
    slope = 0.0
    for architecture in ARCHITECTURES:
        found = compiled([*variants, shorter], architecture)
        lines += [row(architecture, variant, found[variant]) for variant in variants]
        slope = (found[plain].instructions - found[shorter].instructions) / (AHEAD - shorter.ahead)
        registers = found[plain].registers
    lines += ["", *estimate(slope, registers)]
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


def estimate(slope: float, registers: int) -> list[str]:
    """Bounds of an H200 from the number of instructions and of bytes."""
    block = block_bytes(BINS, 32)
    warps = min(SHARED_BYTES // (block + RESERVED_BYTES), REGISTERS // (32 * registers))
    issue = PROCESSORS * SCHEDULERS * CLOCK_HZ * 32 / slope
    written = 2 * PIXELS * BINS * 2  # set to zero, then written
    return [
        f"## Bounds for an NVIDIA H200, {WORKLOAD}",
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


if __name__ == "__main__":
    main()
