"""device="cuda": what it refuses, with or without a GPU, and its bits where there is one."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from tests.harness.command import fails

FLUX = ml.Flux(np.full((2, 3), 2.0), 0.5, np.linspace(10.0, 80.0, 6).reshape(2, 3))
SYSTEM = make_system(63.75, 500, 64, sigma_ns=0.5)


def test_unknown_device():
    with pytest.raises(ValueError, match=r"device must be .*'cpu'.*'cuda'.*'tpu'"):
        ml.simulate(FLUX, SYSTEM, device="tpu")  # type: ignore[arg-type]


@pytest.mark.parametrize("engine", ["auto", "renewal", "sequential"])
def test_engines_without_a_kernel_name_what_works(engine: str):
    with pytest.raises(ValueError, match=rf"{engine}.*device 'cuda'.*'exact' or 'feedback' or 'mars'.*device 'cpu'"):
        ml.simulate(FLUX, SYSTEM, engine=engine, device="cuda")


def test_effects_and_waveforms_are_refused():
    jittery = make_system(63.75, 500, 64, sigma_ns=0.5, jitter=ml.Jitter(sigma_ns=0.1))
    refused(r"'cuda' does not do jitter.*use device 'cpu'", ml.simulate, FLUX, jittery, device="cuda")
    wave = ml.Flux(waveform=np.full((1, 1, 8), 0.1), background=0.1)
    refused(r"not a waveform, on device 'cuda'; use device 'cpu'", ml.simulate_timestamps, wave, SYSTEM, device="cuda")


def test_without_cupy_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "cupy", None)
    for call in (ml.simulate, ml.simulate_timestamps):
        refused(r"mars-lidar\[cuda12\]", call, FLUX, SYSTEM, device="cuda", error=ImportError)


def test_the_command_line_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(sys.modules, "cupy", None)
    out = tmp_path / "room.zarr"
    arguments = ["simulate", "--scene", "room", "--size", "4", "--cycles", "200", "--device", "cuda", "--out", str(out)]
    fails("mars-lidar[cuda12]", *arguments, "--engine", "feedback")
    fails("table must be given for engine 'mars' on device 'cuda'", *arguments, "--engine", "mars")
    assert not out.exists()


def _device() -> Any:
    cupy = pytest.importorskip("cupy", reason="no CuPy: the extra cuda12 or cuda13", exc_type=ImportError)
    from mars_lidar.engines.cuda.machine import cupy_with_device

    try:
        return cupy_with_device()
    except RuntimeError as error:
        pytest.skip(f"no GPU: {error}")
    return cupy


@pytest.mark.parametrize("mode", ["nonparalyzable", "paralyzable", "synchronous"])
@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_bits_on_a_gpu(mode: str, start: str):
    cupy = _device()
    system = make_system(63.75, 2000, 1024, sigma_ns=0.5, start=start, mode=mode)
    there = ml.simulate(FLUX, system, realizations=50, seed=3, device="cuda")
    assert isinstance(there, cupy.ndarray)
    np.testing.assert_array_equal(there.get(), ml.simulate(FLUX, system, realizations=50, seed=3))
    a, b = (ml.simulate_timestamps(FLUX, system, seed=3, device=device) for device in ("cpu", "cuda"))
    for name in ("times_ns", "cycle", "bin", "offsets"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("dead_ns", [63.75, 101.0])
@pytest.mark.parametrize("cycles", [500, 50_000, 200_000])
@pytest.mark.parametrize("engine", ["feedback", "mars"])
def test_bits_of_other_engines_on_a_gpu(engine: str, cycles: int, dead_ns: float):
    _device()
    system = SYSTEM.replace(cycles=cycles, bins=1024, detector=ml.Detector(dead_time_ns=dead_ns))
    options: dict[str, Any] = {}
    if engine == "mars":
        options["table"] = ml.Table.build(system, (0.05, 3.0, 9), (0.05, 3.0, 9))
    on_device = ml.simulate(FLUX, system, engine=engine, realizations=20, seed=3, device="cuda", **options)
    np.testing.assert_array_equal(
        on_device.get(), ml.simulate(FLUX, system, engine=engine, realizations=20, seed=3, **options)
    )


def test_no_device_is_told():
    cupy = pytest.importorskip("cupy", reason="no CuPy: the extra cuda12 or cuda13", exc_type=ImportError)
    try:
        number = cupy.cuda.runtime.getDeviceCount()
    except cupy.cuda.runtime.CUDARuntimeError:
        number = 0
    if number:
        pytest.skip("there is a GPU")
    for engine in ("exact", "feedback"):
        with pytest.raises(RuntimeError, match=r"no CUDA device.*device='cpu'"):
            ml.simulate(FLUX, SYSTEM, engine=engine, device="cuda")
