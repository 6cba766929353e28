"""The exact engine for waveforms where its tables are hardest: edges that meet, parts of hardly any energy, sizes."""

import numpy as np
import pytest
from harness import COUNTS, SHAPE, Case, Law, check, first_arrival, make_system, pmf_of, require, waveform_flux
from scipy import stats

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines import ENGINES
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine


def view(dead: float, cycles: int = 20, bins: int = 64, mode: str = "nonparalyzable", start: str = "armed"):
    return make_system(100.0 * dead, cycles, bins, start=start, mode=mode)


def one_part(parts: int, at: int) -> np.ndarray:
    wave = np.zeros(parts)
    wave[at] = 1.0
    return wave


def steep(parts: int) -> np.ndarray:
    """Energies over twelve decades: cells with a thousand edges beside parts with a thousand cells."""
    return 10.0 ** -(12.0 * np.random.default_rng(parts).random(parts))


WAVES = {
    "one part": np.ones(1),
    "two parts": np.array([0.0, 1.0]),
    "first of many": one_part(777, 0),
    "last of many": one_part(777, 776),
    "dark ends": np.pad(np.ones(5), 300),
    "steep": steep(1000),
    "steep, more parts than 16 bits": steep(140_001),
}


@pytest.mark.full
@pytest.mark.parametrize("photons", [1e-6, 0.7, 1e3])
@pytest.mark.parametrize("name", WAVES)
def test_levels_agree_and_registrations_lie_where_there_is_light(name: str, photons: float):
    wave = photons * WAVES[name] / WAVES[name].sum()
    flux = ml.Flux(waveform=np.broadcast_to(wave, (1, 37, wave.size)))
    cycles = int(min(300 / photons, 1e8)) if photons < 1e3 else 20
    for dead, start in ((0.0, "armed"), (0.3, "armed"), (2.0, "stationary")):
        system = view(dead, cycles, 128, start=start)
        task = Task(flux, system, 2, 0, np.arange(37, dtype=np.uint32), 5, 1, None)
        first = None
        for level in _core.levels():
            engine = ExactEngine(level)
            records = engine.records(task, 0.0)
            out = np.empty((task.items, 128), system.histogram_dtype)
            engine.histogram(task, out)
            item = np.repeat(np.arange(task.items), np.diff(records.offsets))
            assert np.array_equal(np.bincount(item * 128 + records.bin, minlength=out.size), out.ravel())
            if first is None:
                first = records
                apart = np.diff(records.times)[item[1:] == item[:-1]]
                assert (apart >= dead - 1e-7).all()
                part = np.minimum(((records.times - records.cycle) * wave.size).astype(int), wave.size - 1)
                rounded = wave[np.maximum(part - 1, 0)] + wave[part] + wave[np.minimum(part + 1, wave.size - 1)]
                assert (rounded > 0).all()
                assert records.times.size > 100
            for what in ("times", "cycle", "bin", "offsets"):
                assert np.array_equal(getattr(records, what), getattr(first, what))


@pytest.mark.parametrize("parts", [3, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 65, 127, 2047, 2049])
def test_levels_agree_at_any_number_of_parts(parts: int):
    """Tables are filled in vectors, whose last one is not full."""
    wave = np.random.default_rng(parts).random((1, 9, parts)) ** 8
    flux = ml.Flux(waveform=2.0 * wave / wave.sum(-1, keepdims=True), background=np.linspace(0.0, 2.0, 9)[None])
    system = view(0.37, 300, parts)
    task = Task(flux, system, 2, 0, np.arange(9, dtype=np.uint32), parts, 1, None)
    cubes = []
    for level in _core.levels():
        cubes.append(np.empty((task.items, parts), system.histogram_dtype))
        ExactEngine(level).histogram(task, cubes[-1])
    assert all(np.array_equal(cube, cubes[0]) for cube in cubes)
    assert cubes[0].sum() > 2000


@pytest.mark.full
@pytest.mark.parametrize("parts", [64, 1024, 140_001])
def test_parts_have_their_energy_over_many_decades(parts: int):
    """First arrivals of armed periods, without re-arming: Coates 1968. In bins of the waveform's own order."""
    wave = 3.0 * steep(parts) / steep(parts).sum()
    system = view(0.0, 1, 64, "synchronous")
    edges = np.minimum(np.arange(65) * parts / 64, parts)
    photons = np.diff(np.interp(edges, np.arange(parts + 1), np.concatenate([[0.0], np.cumsum(wave)])))
    case = Case(f"first arrivals, {parts} parts", waveform_flux(wave), system, 400_000)
    check(ENGINES["exact"], case, Law(first_arrival(photons), None), {SHAPE})


def test_dim_parts_beside_a_bright_one():
    """Parts of 1e-6 of the energy, each of its own size: Poisson counts without a dead time."""
    wave = np.concatenate([[1e3], 1e-3 * np.linspace(0.2, 2.0, 255)])
    system = view(0.0, 1000, 256)
    cube = ml.simulate(ml.Flux(waveform=np.broadcast_to(wave, (1, 40, 256))), system, seed=1)
    counts = cube.sum((0, 1, 2)).astype(float)
    expected = 40 * 1000 * wave
    z = (counts[1:] - expected[1:]) / np.sqrt(expected[1:])
    require({"chi-square": 2 * min(stats.chi2.sf((z**2).sum(), 255), stats.chi2.cdf((z**2).sum(), 255))}, "dim parts")
    late = counts[129:].sum(), expected[129:].sum()
    require({"dim half": float(2 * stats.norm.sf(abs(late[0] - late[1]) / np.sqrt(late[1])))}, "dim parts")


@pytest.mark.parametrize("dead", [0.0, 0.37, 1.0])
def test_dim_and_bright_pixels_against_the_count_law(dead: float):
    """A million periods of 1e-5 photons, ten of a thousand."""
    for photons, cycles in ((1e-5, 1_000_000), (1e3, 10)):
        wave = photons * steep(500) / steep(500).sum()
        system = view(dead, cycles)
        case = Case(f"{photons:g} photons, t_d {dead:g}", waveform_flux(wave), system, 20_000 if dead else 4000)
        if dead:
            pmf = pmf_of(ml.count_law(ml.Flux(waveform=wave), system))
        else:
            mean = photons * cycles
            pmf = stats.poisson.pmf(np.arange(int(mean + 60 * mean**0.5 + 60)), mean)
        check(ENGINES["exact"], case, Law(None, pmf), {COUNTS})
