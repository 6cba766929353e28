"""The kernels compile for GPUs, into registers, where there is none."""

import shutil
from itertools import product
from pathlib import Path

import pytest

from mars_lidar.engines.cuda import kernels
from tests.cuda.nvrtc import NotFound, compiled, library
from tests.cuda.resources import mars_steps

try:
    library()
except (NotFound, OSError) as error:
    pytest.skip(f"no NVRTC to compile with: {error}", allow_module_level=True)

# free-running pixels of one return, the other modes, and the other places where registrations go
BRIGHT = [
    kernels.Variant(0, gaussian, whole, True, kernels.Sink.BLOCK16)
    for gaussian, whole in product((True, False), repeat=2)
]
OTHERS = [kernels.Variant(mode, mode != 2, mode != 2, mode == 1, kernels.Sink.BLOCK16) for mode in (1, 2, 3)]
SINKS = [
    kernels.Variant(0, True, False, False, sink)
    for sink in kernels.Sink
    if sink not in (kernels.Sink.BLOCK16, kernels.Sink.ROWS16)
]


def nightly(*values: object) -> object:
    """An older architecture: its machine code differs, the kernels do not."""
    return pytest.param(*values, marks=pytest.mark.nightly)


@pytest.mark.full
@pytest.mark.parametrize(
    ("architecture", "variants"), [nightly("sm_80", BRIGHT[:2]), ("sm_90", [*BRIGHT, *OTHERS, *SINKS])]
)
def test_compiles_without_spills(architecture: str, variants: list[kernels.Variant]):
    result = compiled([variant.kernel for variant in variants], architecture)
    for variant in variants:
        used = result[variant.kernel]
        assert used.spill_stores == used.spill_loads == 0, variant
        assert used.registers <= 168, variant  # 3 warps on each of a multiprocessor's 4 schedulers
        assert used.instructions > 500, variant
        if variant.single:
            assert used.stack_bytes == 0, variant


@pytest.mark.full(seconds=15)
@pytest.mark.parametrize(
    ("architecture", "kernels"),
    [
        nightly("sm_80", [kernels.mars_histograms(True), kernels.feedback_histograms(True)]),
        ("sm_90", [kernels.MARS_LAWS, kernels.mars_histograms(False), kernels.feedback_histograms(False)]),
    ],
)
def test_the_other_engines_compile_without_spills(architecture: str, kernels: list[kernels.Kernel]):
    for kernel, used in compiled(kernels, architecture).items():
        assert used.spill_stores == used.spill_loads == 0, kernel
        assert used.registers <= 168, kernel
        assert used.instructions > 500, kernel


@pytest.mark.full
def test_the_steps_of_the_estimate_compile():
    """What `tests.cuda.resources` counts the instructions of, alone."""
    step = mars_steps()
    assert step["mars::two_poisson"].instructions > step["mars::form"].instructions > step["mars::nothing"].instructions


def test_the_source_names_the_headers_of_every_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """CuPy finds what it has compiled before by the source: a change in any header must change it."""
    shutil.copytree(kernels.HEADERS, tmp_path / "native", ignore=shutil.ignore_patterns("*.cpp"))
    monkeypatch.setattr(kernels, "HEADERS", tmp_path / "native")
    before = kernels.source.__wrapped__(kernels.MARS_LAWS.header)
    assert before == kernels.source(kernels.MARS_LAWS.header)
    with (tmp_path / "native" / "numbers" / "random.h").open("a") as header:
        header.write("// changed\n")
    assert kernels.source.__wrapped__(kernels.MARS_LAWS.header) != before


def test_a_mistake_is_told():
    with pytest.raises(RuntimeError, match="NVRTC failed"):
        compiled([kernels.Variant(0, True, True, True, kernels.Sink.BLOCK16, ahead=-1).kernel], "sm_90")
