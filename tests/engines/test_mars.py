"""The engine "mars": tables, count laws, settings. Its statistics without a table: test_engines.py."""

import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from harness import Law, check, counts_against_law, law_of, make_system, refused, require
from harness.cases import Case
from harness.check import COUNTS, SHAPE
from instrument.effect_checks import bits_do_not_depend

import mars_lidar as ml
from mars_lidar.engines import MarsEngine
from mars_lidar.engines.tolerances import TOL
from mars_lidar.statistics import exposure_moments
from mars_lidar.table import Table

SYSTEM = make_system(63.75, 300, 128)


@cache
def table() -> Table:
    return Table.build(SYSTEM, (0.05, 3.0, 40), (0.05, 3.0, 40))


def image(height: int = 5, width: int = 7, seed: int = 1) -> ml.Flux:
    rng = np.random.default_rng(seed)
    shape = (height, width)
    return ml.Flux(rng.uniform(0.1, 2.5, shape), rng.uniform(0.1, 2.5, shape), rng.uniform(-50.0, 250.0, shape))


def exact_law(signal: float, background: float, delay_ns: float, system: ml.System = SYSTEM) -> Law:
    return law_of(ml.Flux(signal, background, delay_ns), system)


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "background", "delay"), [(0.31, 0.47, 17.3), (1.7, 0.11, 63.1), (2.9, 2.3, 2.2), (0.0, 1.3, 0.0)]
)
def test_table_gives_the_exact_law(signal: float, background: float, delay: float):
    """Between the nodes, at any delay, with a return or without."""
    flux = ml.Flux(np.full((1, 4), signal), background, delay)
    case = Case(f"S {signal:g}, B {background:g}", flux, SYSTEM, 6000)
    check(MarsEngine(table()), case, exact_law(signal, background, delay), {COUNTS, SHAPE})


def test_a_table_serves_other_numbers_of_cycles():
    system = SYSTEM.replace(cycles=1500)
    case = Case("1500 cycles", ml.Flux(np.full((1, 4), 0.8), 0.6, 71.3), system, 4000)
    check(MarsEngine(table()), case, exact_law(0.8, 0.6, 71.3, system), {COUNTS, SHAPE})
    again = [
        ml.simulate(case.flux, SYSTEM.replace(cycles=cycles), engine="mars", table=table())
        for cycles in (1500, 300, 700, 1500, 700)
    ]
    assert np.array_equal(again[0], again[3])
    assert np.array_equal(again[2], again[4])


def test_the_gaussian_count_is_the_paper_s():
    flux = ml.Flux(np.full((1, 8), 0.9), 0.4, 40.0)
    for given in (None, table()):
        cube = ml.simulate(flux, SYSTEM, engine="mars", table=given, count="gaussian", realizations=3000)
        exact = ml.count_law(ml.Flux(0.9, 0.4, 40.0), SYSTEM)
        n = np.arange(int(exact.mean + 12 * np.sqrt(exact.variance)))
        from scipy.stats import norm

        below = norm.cdf((n + 0.5 - exact.mean) / np.sqrt(exact.variance))
        pmf = np.diff(below, prepend=0.0)
        outcome = counts_against_law(cube.sum(-1).ravel(), pmf)
        require({"count law": outcome}, f"gaussian count, {'table' if given else 'no table'}")


def test_a_locked_pixel_needs_the_exact_count():
    """Variance far below 1: the default law is right, the rounded Gaussian is not."""
    system = SYSTEM.replace(detector=ml.Detector(dead_time_ns=97.0), cycles=200)
    flux = ml.Flux(np.full((1, 8), 40.0), 0.02, 50.0)
    law = exact_law(40.0, 0.02, 50.0, system)
    n = np.arange(law.count_pmf.size)
    mean = law.count_pmf @ n
    variance = law.count_pmf @ (n - mean) ** 2
    assert variance < 0.2
    counts = ml.simulate(flux, system, engine="mars", realizations=2000).sum(-1).ravel()
    require({"count law": counts_against_law(counts, law.count_pmf)}, "locked pixel")


@pytest.mark.full
@pytest.mark.parametrize("with_table", [True, False])
def test_any_part_alone_on_any_threads(with_table: bool):
    bits_do_not_depend(image(), SYSTEM, "mars", table=table() if with_table else None)


def test_batches_do_not_show(monkeypatch: pytest.MonkeyPatch):
    from mars_lidar.engines import synthesis as _synthesis
    from mars_lidar.engines import table_reader as _table_reader

    whole = ml.simulate(image(), SYSTEM, engine="mars", table=table(), realizations=5)
    small = replace(TOL, batch_exposures=4, looked_up=11)
    monkeypatch.setattr(_synthesis, "TOL", small)
    monkeypatch.setattr(_table_reader, "TOL", small)
    assert np.array_equal(whole, ml.simulate(image(), SYSTEM, engine="mars", table=table(), realizations=5))


def test_pixels_beyond_the_table_are_evaluated_and_counted():
    bright = np.full((2, 3), 1.0)
    bright[0, 1], bright[1, 2] = 20.0, 5.0
    flux = ml.Flux(bright, 0.5, 30.0)
    report: dict[str, float] = {}
    cube = ml.simulate(flux, SYSTEM, engine="mars", table=table(), outside="exact", realizations=4, report=report)
    assert report["pixels_evaluated"] == 2
    assert {"lookup_s", "evaluation_s", "counts_s", "sampling_s"} <= set(report)
    assert min(report.values()) >= 0.0
    direct = ml.simulate(flux, SYSTEM, engine="mars", realizations=4, report=report)
    assert report["pixels_evaluated"] == 6
    assert np.array_equal(cube[:, bright > 3], direct[:, bright > 3])


def test_nearest_and_bilinear():
    cubes = {
        how: ml.simulate(image(), SYSTEM, engine="mars", table=table(), interpolation=how, realizations=2)
        for how in ("nearest", "bilinear")
    }
    assert not np.array_equal(cubes["nearest"], cubes["bilinear"])
    plain = ml.simulate(image(), SYSTEM, engine="mars", table=table(), realizations=2)
    assert np.array_equal(plain, cubes["bilinear"])
    own = MarsEngine(table(), interpolation="nearest")
    assert np.array_equal(ml.simulate(image(), SYSTEM, engine=own, realizations=2), cubes["nearest"])


def test_a_masked_image_works():
    signal, delay = np.full((3, 4), 0.7), np.full((3, 4), 20.0)
    signal[1], delay[1] = 0.0, np.nan
    background = np.full((3, 4), 0.3)
    background[2] = 0.0
    signal[2, 0] = 0.0
    flux = ml.Flux(signal, background, delay)
    cube = ml.simulate(flux, SYSTEM, engine="mars", table=table(), realizations=20)
    assert cube[:, :2].sum(-1).min() > 0
    assert not cube[:, 2, 0].any()


@pytest.mark.parametrize("engine", ["mars", "renewal"])
def test_pixels_beyond_the_table_are_an_error_unless_asked_for(engine: str):
    signal, background = np.full((2, 3), 1.0), np.full((2, 3), 0.5)
    signal[0, 1], signal[1, 2], background[1, 2] = 20.0, 5.0, 7.5
    flux = ml.Flux(signal, background, 30.0)
    with pytest.raises(ValueError, match="table must reach every pixel, but 2 of 6 lie outside") as error:
        ml.simulate(flux, SYSTEM, engine=engine, table=table())
    for words in ("signal 5 to 20", "(the table: 0 to 3)", "background 7.5 to 7.5", "outside='exact'"):
        assert words in str(error.value)
    assert ml.simulate(flux, SYSTEM, engine=engine, table=table(), outside="exact").sum(-1).min() > 0


def test_masked_pixels_need_no_zero_in_the_table():
    """S = 0 is evaluated where the grid has none; S between 0 and the grid is not."""
    bare = Table.build(SYSTEM, np.array([0.5, 1.0]), np.array([0.2, 0.4]))
    signal, delay = np.full((2, 2), 0.7), np.full((2, 2), 20.0)
    signal[1], delay[1] = 0.0, np.nan
    flux, report = ml.Flux(signal, 0.3, delay), {}
    cube = ml.simulate(flux, SYSTEM, engine="mars", table=bare, report=report, realizations=3)
    assert report["pixels_evaluated"] == 2
    direct = ml.simulate(flux, SYSTEM, engine="mars", realizations=3)
    assert np.array_equal(cube[:, 1], direct[:, 1])
    with pytest.raises(ValueError, match=r"signal 0\.1 to 0\.1"):
        ml.simulate(ml.Flux(np.full((2, 2), 0.1), 0.3, 20.0), SYSTEM, engine="mars", table=bare)


def test_memory_is_the_output_and_a_bounded_work_area():
    """2^17 pixels, all different: what is held beside the cube and the table stays far below 256 MiB."""
    system = SYSTEM.replace(bins=16)
    small = Table.build(system, (0.1, 2.0, 4), (0.1, 2.0, 4))
    rng = np.random.default_rng(0)
    shape = (256, 512)
    flux = ml.Flux(rng.uniform(0.2, 1.5, shape), rng.uniform(0.2, 1.5, shape), rng.uniform(0, 100, shape))
    out = np.empty((1, 256, 512, 16), system.histogram_dtype)
    tracemalloc.start()
    ml.simulate(flux, system, engine="mars", table=small, out=out)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 128 * 2**20


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"interpolation": "nearest"}, ValueError, "interpolation.*without a table"),
        ({"outside": "exact"}, ValueError, "outside.*without a table"),
        ({"count": "normal"}, ValueError, "count.*'normal'"),
        ({"table": table, "interpolation": "cubic"}, ValueError, "interpolation.*'cubic'"),
        ({"table": table, "outside": "clip"}, ValueError, "outside.*'error'.*'clip'"),
        ({"table": "room.h5"}, TypeError, "table.*room.h5"),
        ({"table": table, "engine": "exact"}, TypeError, "table.*'exact'"),
        ({"count": "exact", "engine": "renewal"}, TypeError, "count.*'renewal'"),
        ({"count": "exact", "engine": MarsEngine()}, TypeError, "count.*engine is an Engine"),
        ({"table": table, "system": SYSTEM.replace(bins=64)}, ValueError, "table.*bins.*(64.*128|128.*64)"),
        ({"table": table, "flux": ml.Flux.multi(*[ml.Flux(1.0, 0.5, 30.0)] * 2)}, ValueError, "several returns"),
        ({"table": table, "flux": ml.Flux(waveform=np.ones(8))}, ValueError, "one return.*a waveform"),
    ],
)
def test_bad_input(options, kind, message):
    made = {name: value() if value is table else value for name, value in options.items()}
    refused(message, ml.simulate, **{"flux": image(), "system": SYSTEM, "engine": "mars"} | made, error=kind)


def test_there_are_no_times():
    refused(r"'mars'.*histograms only", ml.simulate_timestamps, image(), SYSTEM, engine="mars")


# Start-up of short armed exposures, which a table turns with the pulse


def ticking(cycles: int, start: str = "armed") -> ml.System:
    return make_system(87.331, cycles, 128, start=start)


@pytest.mark.parametrize(
    ("cycles", "delay", "misplaced"), [(40, 12.7, 4.9), (40, 0.3, 5.2), (300, 12.7, 4.7), (1, 12.7, 1.1)]
)
def test_a_table_says_what_the_start_up_misplaces(cycles: int, delay: float, misplaced: float):
    system = ticking(cycles)
    table = ml.Table.build(system, signal=np.geomspace(3.6, 4.1, 4), background=np.geomspace(7.0, 8.0, 4))
    flux, report = ml.Flux(np.full((2, 2), 3.84), 7.38, delay), dict[str, float]()
    with pytest.warns(UserWarning, match="leave the table out"):
        ml.simulate(flux, system, engine="mars", table=table, report=report)
    exact = exposure_moments(flux, system)
    assert report["start_up_error"] * float(np.asarray(exact.mean).flat[0]) == pytest.approx(misplaced, abs=0.2)


@pytest.mark.parametrize("system", [ticking(40, "stationary"), ticking(1000)])
def test_a_table_without_a_start_up_is_silent(system: ml.System, recwarn: pytest.WarningsRecorder):
    table = ml.Table.build(system, signal=np.geomspace(3.6, 4.1, 4), background=np.geomspace(7.0, 8.0, 4))
    ml.simulate(ml.Flux(np.full((2, 2), 3.84), 7.38, 12.7), system, engine="mars", table=table)
    assert not recwarn.list
