"""The kernel of the engine "feedback" run on the processor: its bits are those of the engine."""

from typing import Any

import numpy as np
import pytest
from harness import make_system
from host_machine import Host

import mars_lidar as ml
from mars_lidar.engines.cuda.feedback import feedback_histogram
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine

pytestmark = pytest.mark.full  # a compiler builds the emulation

BASE = make_system(63.75, 3000, 128)
SAMPLED = ml.SampledPulse(np.array([0.1, 0.7, 1.0, 0.4, 0.3, 0.1]), bin_ns=0.9)


def image(shape: tuple[int, int] = (4, 9), seed: int = 1) -> ml.Flux:
    """From dim to too bright, one pixel without a return."""
    rng = np.random.default_rng(seed)
    signal, background = np.exp(rng.uniform(np.log(0.01), np.log(6.0), (2, *shape)))
    signal[0, 0] = 0.0
    background[0, 1] = 40.0
    return ml.Flux(signal, background, rng.uniform(-50.0, 250.0, shape))


def several() -> ml.Flux:
    rng = np.random.default_rng(2)
    return ml.Flux.multi(image((2, 9)), ml.Flux(np.full((2, 9), 0.4), 0.0, rng.uniform(0.0, 100.0, (2, 9))))


def waveform() -> ml.Flux:
    return ml.Flux(waveform=np.random.default_rng(3).uniform(0.0, 0.01, (2, 3, 512)), background=0.1)


def both(flux: ml.Flux, system: ml.System, realizations: int = 3, warps: int = 2) -> dict[str, Any]:
    """Cubes of the processor and of the kernel, and how many pixels were given to the exact engine."""
    index = np.arange(1000, 1000 + flux.background.size, dtype=np.uint32)
    asked, two = (Task(flux, system, realizations, 7, index, 2**40 + 9, 1, None) for _ in range(2))
    wanted = np.empty((asked.items, system.bins), system.histogram_dtype)
    FeedbackEngine().histogram(asked, wanted)
    drawn, machine = np.full_like(wanted, 7), Host()
    feedback_histogram(two, drawn, machine, ExactEngine().histogram, warps=warps)
    assert two.report == asked.report
    assert machine.launched
    return {"wanted": wanted, "drawn": drawn, "rest": asked.report["pixels given to exact"]}


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead_ns", [63.75, 163.75, 0.9])
@pytest.mark.parametrize("pulse", [BASE.pulse, SAMPLED], ids=["gaussian", "sampled"])
def test_histograms_are_those_of_the_engine(pulse: ml.Pulse, dead_ns: float, start: Any):
    system = BASE.replace(pulse=pulse, detector=ml.Detector(dead_time_ns=dead_ns), start=start)
    flux = image()
    result = both(flux, system)
    assert result["wanted"].sum() > 10_000
    np.testing.assert_array_equal(result["drawn"], result["wanted"])


@pytest.mark.parametrize("flux", [several(), waveform()], ids=["returns", "waveform"])
def test_other_light(flux: ml.Flux):
    result = both(flux, BASE)
    np.testing.assert_array_equal(result["drawn"], result["wanted"])


def test_pixels_that_do_not_settle_are_refused():
    result = both(image(), BASE)
    assert 0 < result["rest"] < 36


@pytest.mark.parametrize("warps", [1, 50])
def test_long_exposures_and_any_number_of_warps(warps: int):
    """uint32; internal cells cut near the pulse."""
    system = BASE.replace(cycles=2_000_000)
    light = image((1, 12))
    flux = ml.Flux(np.minimum(light.signal, 2.0), np.minimum(light.background, 1.0), light.delay_ns)
    result = both(flux, system, realizations=5, warps=warps)
    assert result["rest"] == 0
    assert result["wanted"].dtype == np.uint32
    np.testing.assert_array_equal(result["drawn"], result["wanted"])


def test_what_the_kernel_does_not_do_is_refused():
    system = BASE.replace(detector=ml.Detector(dead_time_ns=0.0))
    with pytest.raises(ValueError, match=r"dead_time_ns must be > 0.*'cuda'.*'exact'.*device 'cpu'"):
        ml.simulate(image(), system, engine="feedback", device="cuda")
