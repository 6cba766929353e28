"""Same seed, same bits: threads, parts, vector widths, and the committed bits of a few small cubes."""

import hashlib

import numpy as np
import pytest
from harness import make_system, refused
from instrument.effect_checks import bits_do_not_depend
from numpy.typing import NDArray

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines import ANY_SYSTEM
from mars_lidar.engines.engine import PhaseRecords, Task
from mars_lidar.engines.exact import ExactEngine

SHAPE = (6, 11)  # not a multiple of any number of lanes
# two lobes with a gap; whole numbers, because NumPy's exp differs between processors
LOBES = np.array([1, 4, 19, 55, 80, 61, 30, 9, 2] + [0] * 12 + [1, 6, 14, 20, 17, 9, 3, 1] + [0] * 7, float)


def image(kind: str) -> tuple[ml.Flux, ml.System]:
    """A mixture of dark, dim and bright pixels, so that lanes end at different times."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    signal = np.where((x + y) % 5 == 0, 0.0, 0.01 * 2.0 ** ((3 * x + 7 * y) % 13))
    background = np.where((2 * x + y) % 7 == 0, 0.0, 0.02 * 3.0 ** ((x + 5 * y) % 6))
    delay = 9.7 * x - 31.3 * y
    system = make_system(63.75, 120, 50, sigma_ns=0.75)
    flux = ml.Flux(signal, background, delay)
    if kind == "sampled":
        system = system.replace(pulse=ml.SampledPulse(LOBES, 0.9))
    elif kind == "returns":
        flux = ml.Flux.multi(flux, ml.Flux(0.3 * signal, 0.0, delay + 20.0), ml.Flux(0.1 * signal, 0.1, delay - 60.0))
    elif kind == "waveform":
        wave = signal[..., None] * np.roll(LOBES, 7) / LOBES.sum()
        flux = ml.Flux(waveform=wave, background=background)
    elif kind == "stationary":
        system = system.replace(start="stationary")
    elif kind == "stationary waveform":
        flux, system = image("waveform")[0], system.replace(start="stationary")
    elif kind == "whole periods":
        system = system.replace(detector=ml.Detector(dead_time_ns=300.0))
    elif kind == "no dead time":
        system = system.replace(detector=ml.Detector(dead_time_ns=0.0), cycles=7)
    elif kind == "long dead time":
        system = system.replace(detector=ml.Detector(dead_time_ns=777.7), start="stationary", cycles=500)
    return flux, system


# Start of the SHA-256 of the cubes (3 realizations, seed 2**63 + 1), as little-endian uint32.
# A change of these bits is a change of every user's data: it belongs into the change log, as a new version.
GOLDEN = {
    "gaussian": "67664de020ee6891",
    "sampled": "56999f62327d5e3c",
    "returns": "eaba677131df7614",
    "waveform": "750023179ec53787",
    "stationary": "d9811fcfe1ed1553",
    "stationary waveform": "d9f386a46418f06c",
    "whole periods": "398c5a8069ad4f41",
    "no dead time": "73bf40e6baba9750",
    "long dead time": "d3bbc1adbd302269",
}
GOLDEN_TIMES = {"gaussian": "e20008f18e3ca915", "returns": "b5ad4e2f769a3776"}
KINDS = tuple(GOLDEN)


@pytest.mark.parametrize("kind", KINDS)
def test_golden_bits(kind: str):
    flux, system = image(kind)
    cube = ml.simulate(flux, system, realizations=3, seed=2**63 + 1)
    as_little_endian = cube.astype("<u4").tobytes()
    assert hashlib.sha256(as_little_endian).hexdigest()[:16] == GOLDEN[kind]


@pytest.mark.parametrize("kind", GOLDEN_TIMES)
def test_golden_times(kind: str):
    flux, system = image(kind)
    times = ml.simulate_timestamps(flux, system, seed=5)
    text = hashlib.sha256(times.times_ns.astype("<f8").tobytes()).hexdigest()[:16]
    assert text == GOLDEN_TIMES[kind]


def task(kind: str, realizations: int = 3, threads: int = 1) -> Task:
    flux, system = image(kind)
    index = np.arange(SHAPE[0] * SHAPE[1], dtype=np.uint32)
    return Task(flux, system, realizations, 0, index, 77, threads, None)


def drawn(engine: ExactEngine, request: Task) -> tuple[NDArray[np.uint32], PhaseRecords]:
    out = np.full((request.items, request.system.bins), 9, request.system.histogram_dtype)
    engine.histogram(request, out)
    return out, engine.records(request, 0.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "engine",
    [name if name in ("exact", "sequential") else pytest.param(name, marks=pytest.mark.full) for name in ANY_SYSTEM],
)
def test_bits_do_not_depend_on_levels_threads_and_parts(engine: str, kind: str):
    flux, system = image(kind)
    bits_do_not_depend(flux, system, engine)


def test_there_are_levels_to_compare():
    """Widest first; the last one is what every processor of this kind runs. One number at a time: `tests/cuda`."""
    assert set(_core.levels()) <= {"avx512", "avx2", "vector128", "scalar"}
    assert _core.levels()[-1] in ("vector128", "scalar")


def test_unknown_level_is_an_error():
    refused("level must be one that this processor runs, got 'mmx'", drawn, ExactEngine(level="mmx"), task("gaussian"))


@pytest.mark.parametrize("engine", ANY_SYSTEM)
def test_order_of_pixels_does_not_matter(engine: str):
    flux, system = image("gaussian")
    whole = ml.simulate(flux, system, engine=engine, seed=3)[0].reshape(-1, system.bins)
    order = np.random.default_rng(1).permutation(len(whole))
    maps = [m.ravel()[order][None] for m in (flux.signal, flux.background, flux.delay_ns)]
    mixed = ml.simulate(ml.Flux(*maps), system, engine=engine, seed=3, pixel_index=order)[0, 0]
    assert np.array_equal(mixed, whole[order])


@pytest.mark.parametrize("engine", ANY_SYSTEM)
def test_seeds_pixels_and_realizations_have_their_own_streams(engine: str):
    """Alike pixels, all different; 64-bit seeds and 32-bit indices are used in full."""
    flux, system = ml.Flux(np.full((1, 3), 1.0), 1.0, 40.0), image("gaussian")[1]
    rows = []
    for seed in (0, 1, 2**32, 2**63, 2**64 - 1):
        for first in (0, 1, 2**31, 2**32 - 1):
            for index in ([0, 1, 2], [65_536, 2**31, 2**32 - 1]):
                cube = ml.simulate(flux, system, engine=engine, seed=seed, first_realization=first, pixel_index=index)
                rows.extend(cube[0, 0])
    assert len({row.tobytes() for row in rows}) == len(rows) == 120


def test_nothing_global_is_left_behind():
    """NumPy's global random state is neither read nor changed; a second call gives the same."""
    flux, system = image("gaussian")
    np.random.seed(3)  # noqa: NPY002
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    first = ml.simulate(flux, system, seed=5)
    assert np.array_equal(state, np.random.get_state()[1])  # noqa: NPY002
    assert np.array_equal(first, ml.simulate(flux, system, seed=5))
    assert not np.array_equal(first, ml.simulate(flux, system, seed=6))
