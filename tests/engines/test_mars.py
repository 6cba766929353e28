"""The engine "mars": tables, count laws, settings. Its statistics without a table: test_engines.py."""

import tracemalloc
from contextlib import nullcontext
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from harness import COUNTS, SHAPE, Law, check, counts_against_law, goodness, law_of, refused, require, task_of
from harness.cases import Case, make_system
from instrument.effect_checks import bits_do_not_depend
from scipy import stats

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.engines import MarsEngine
from mars_lidar.engines.synthesis import PartlyReplaced, Run
from mars_lidar.engines.table_reader import PixelEntries
from mars_lidar.engines.tolerances import TOL
from mars_lidar.statistics import exposure_moments
from mars_lidar.statistics.matched import matched_pmf
from mars_lidar.statistics.pmf import Pmf, total_variation
from mars_lidar.statistics.tolerances import TOL as STATISTICS
from mars_lidar.table import Table
from tests.harness.command import command_line, fails, ok

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


def rounded_normal(mean: float, variance: float) -> np.ndarray:
    """P(N = 0), P(N = 1), ... of a normal number that is rounded to a count."""
    n = np.arange(int(mean + 12 * np.sqrt(variance)))
    return np.diff(stats.norm.cdf((n + 0.5 - mean) / np.sqrt(variance)), prepend=0.0)


@pytest.mark.parametrize("with_table", [True, False])
def test_the_gaussian_count_is_the_paper_s(with_table: bool):
    flux, lut = ml.Flux(np.full((1, 8), 0.9), 0.4, 40.0), table() if with_table else None
    cube = ml.simulate(flux, SYSTEM, engine="mars", table=lut, count="gaussian", realizations=3000)
    law = ml.count_law(ml.Flux(0.9, 0.4, 40.0), SYSTEM)
    outcome = counts_against_law(cube.sum(-1).ravel(), rounded_normal(law.mean, law.variance))
    require({"count law": outcome}, f"gaussian count, table {with_table}")


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


# Start-up of short armed exposures, which a table turns with the pulse


def ticking(cycles: int, start: str = "armed") -> ml.System:
    return make_system(87.331, cycles, 128, start=start)


@pytest.mark.parametrize(
    ("cycles", "delay", "misplaced"), [(40, 12.7, 4.9), (40, 0.3, 5.2), (300, 12.7, 4.7), (1, 12.7, 1.1)]
)
def test_a_table_says_what_the_start_up_misplaces(cycles: int, delay: float, misplaced: float):
    system = ticking(cycles)
    table = ml.Table.build(system, signal=np.geomspace(3.6, 4.1, 4), background=np.geomspace(7.0, 8.0, 4))
    flux, other = (ml.Flux(np.full((2, 2), 3.84), 7.38, each) for each in (delay, 50.0))
    exact, errors = exposure_moments(flux, system), []
    for light in (flux, flux, other, flux):
        report = dict[str, float]()
        with pytest.warns(UserWarning, match="leave the table out") if light is flux else nullcontext():
            ml.simulate(light, system, engine="mars", table=table, report=report)
        errors.append(report["start_up_error"])
    assert errors[0] * float(np.asarray(exact.mean).flat[0]) == pytest.approx(misplaced, abs=0.2)
    assert errors[0] == errors[1] == errors[3] > errors[2]


@pytest.mark.parametrize("system", [ticking(40, "stationary"), ticking(1000)])
def test_a_table_without_a_start_up_is_silent(system: ml.System, recwarn: pytest.WarningsRecorder):
    table = ml.Table.build(system, signal=np.geomspace(3.6, 4.1, 4), background=np.geomspace(7.0, 8.0, 4))
    ml.simulate(ml.Flux(np.full((2, 2), 3.84), 7.38, 12.7), system, engine="mars", table=table)
    assert not recwarn.list


# Cubes of the engine "mars" in files: settings kept, table named by its content, command line.


FILE_SYSTEM = make_system(30.0, 60, 64)
FLUX = ml.Flux(np.linspace(0.2, 1.9, 30).reshape(6, 5), 0.4, np.linspace(0.0, 99.0, 30).reshape(6, 5))


@pytest.fixture(scope="module")
def file_table() -> Table:
    return Table.build(FILE_SYSTEM, (0.1, 2.0, 6), (0.1, 2.0, 6))


@pytest.mark.full
@pytest.mark.parametrize("suffix", [".zarr", ".h5", ".npz"])
def test_a_file_says_how_it_was_made_and_makes_it_again(tmp_path, file_table: Table, suffix: str):
    path = tmp_path / f"cube{suffix}"
    options = {"engine": "mars", "count": "gaussian", "interpolation": "nearest"}
    written = io.simulate_to(path, FLUX, FILE_SYSTEM, table=file_table, realizations=2, seed=3, **options)
    assert written.report["pixels_evaluated"] == 0
    assert written.report["sampling_s"] > 0
    expected = ml.simulate(FLUX, FILE_SYSTEM, table=file_table, realizations=2, seed=3, **options)
    with io.load(path) as cube:
        assert np.array_equal(np.asarray(cube.histogram), expected)
        assert (cube.settings["count"], cube.settings["interpolation"]) == ("gaussian", "nearest")
        record = cube.settings["table"]
        assert record["signal"] == [file_table.signal[0], 2.0, file_table.signal.size]
        assert io.verify(cube, table=file_table)
        assert np.array_equal(io.regenerate(cube, rows=slice(2, 4), table=file_table), expected[:, 2:4])
        refused(f"table must be the one.*got None.*{record['hash']}", io.verify, cube)
        other = Table.build(FILE_SYSTEM, (0.1, 2.0, 6), (0.1, 2.0, 7))
        refused(r"table must be the one.*hash", io.regenerate, cube, table=other)


def test_without_a_table_the_count_law_is_kept(tmp_path):
    io.simulate_to(tmp_path / "a.npz", FLUX[:2], FILE_SYSTEM, engine="mars", count="gaussian")
    with io.load(tmp_path / "a.npz") as cube:
        assert cube.settings == {"count": "gaussian"}
        assert io.verify(cube)
        with pytest.raises(ValueError, match="table must be the one that the cube was made with \\(none\\)"):
            io.verify(cube, table=Table.build(FILE_SYSTEM, (0.1, 2.0, 4), (0.1, 2.0, 4)))


def test_reports_add_up_over_blocks(tmp_path, file_table: Table, monkeypatch: pytest.MonkeyPatch):
    from mars_lidar.io import recipe

    monkeypatch.setattr(recipe, "BLOCK_BYTES", 5 * 64 * 2)
    bright = ml.Flux(np.full((6, 5), 3.0), 0.4, 20.0)
    some = ml.Flux(np.where(np.eye(6, 5) > 0, 3.0, 1.0), 0.4, 20.0)
    with pytest.raises(ValueError, match="5 of 30 lie outside"):  # of all pixels, before any block is drawn
        io.simulate_to(tmp_path / "a.h5", some, FILE_SYSTEM, engine="mars", table=file_table)
    assert not list(tmp_path.iterdir())
    written = io.simulate_to(tmp_path / "a.h5", bright, FILE_SYSTEM, engine="mars", table=file_table, outside="exact")
    assert written.report["pixels_evaluated"] == 30
    with io.load(tmp_path / "a.h5") as cube:
        assert io.verify(cube, table=file_table)


def test_command_line(tmp_path, file_table: Table):
    file_table.save(tmp_path / "table.h5")
    FILE_SYSTEM.save(tmp_path / "spad.yaml")
    options = "--scene room --size 8 --signal 0.5 --no-picture --engine mars --count gaussian"
    arguments = ["simulate", *options.split(), "--system", str(tmp_path / "spad.yaml")]
    more = ["--table", str(tmp_path / "table.h5"), "--interpolation", "nearest", "-o", str(tmp_path / "a.zarr")]
    done = ok(*arguments, *more)
    assert "sampling" in done.output
    assert "pixels evaluated" in done.output
    with io.load(tmp_path / "a.zarr") as cube:
        assert cube.settings["interpolation"] == "nearest"
        assert io.verify(cube, table=file_table)
    printed = command_line(["info", str(tmp_path / "a.zarr")])
    assert "count gaussian" in printed.output
    assert "table" in printed.output
    wrong = command_line([*arguments, "--dead-time-ns", "40", *more[:-1], str(tmp_path / "b.zarr")])
    assert wrong.exit_code == 2
    fails("table", *arguments[:-4], "--engine", "exact", *more[:2], "-o", tmp_path / "c.npz")


# Counts of pixels from a table whose four cumulants do not fix the law: kept by the table, or evaluated.


AIM = 0.002
LOCKED_SYSTEM = make_system(63.75, 150, 64)


@cache
def bright_table(start: str = "armed") -> Table:
    # bright enough that the count all but locks to the laser
    return Table.build(LOCKED_SYSTEM.replace(start=start), (2.0, 9.0, 12), (0.02, 0.6, 8))


def doubted(seed: int = 0, pixels: int = 400, start: str = "armed", cycles: int = 150, node: bool = False) -> ml.Flux:
    """Pixels whose cumulants are not trusted; off the nodes unless told."""
    rng, lut = np.random.default_rng(seed), bright_table(start)
    if node:
        row, column = np.divmod(lut.laws.row, lut.background.size)
        return ml.Flux(lut.signal[row][None], lut.background[column][None], 50.0)
    signal, background = rng.uniform(2.0, 9.0, pixels), np.exp(rng.uniform(np.log(0.02), np.log(0.6), pixels))
    delay = rng.uniform(0.0, 100.0, pixels)
    bad = ~lut.at(signal, background, delay_ns=delay, cycles=cycles).trusted()
    return ml.Flux(signal[bad][None], background[bad][None], delay[bad][None])


def laws_of(flux: ml.Flux, system: ml.System, **options: str) -> tuple[PartlyReplaced, PixelEntries, dict[str, float]]:
    """What the engine draws the counts of these pixels from, the table's entries of them, and its report."""
    engine = MarsEngine(bright_table(system.start), **options)
    task = task_of(Case("pixels", flux, system, flux.signal.size), 1)
    entries, remaining = engine.reader.read(task, np.arange(flux.signal.size))
    assert remaining.size == 0
    laws = engine._laws_of(Run(task, np.empty(0)), engine.reader, entries)
    assert isinstance(laws, PartlyReplaced)
    return laws, entries, task.report


def window(laws: PartlyReplaced, k: int) -> Pmf:
    law = int(laws.others.law[k])
    cumulative = laws.others.cumulative[laws.others.offsets[law] : laws.others.offsets[law + 1]]
    return Pmf(int(laws.others.first[law]), np.diff(cumulative, prepend=0.0))


def exact(flux: ml.Flux, system: ml.System, pixel: int) -> Pmf:
    delay = float(flux.delay_ns.ravel()[pixel])
    law = ml.count_law(ml.Flux(flux.signal.ravel()[pixel], flux.background.ravel()[pixel], delay), system)
    return Pmf(int(law.support[0]), law.pmf)


@pytest.mark.parametrize(("start", "cycles"), [("armed", 150), ("armed", 400), ("stationary", 150)])
def test_between_the_entries_the_law_is_exact(start: str, cycles: int):
    flux, system = doubted(start=start, cycles=cycles), LOCKED_SYSTEM.replace(start=start, cycles=cycles)
    laws, entries, report = laws_of(flux, system)
    assert report["pixels_exact_count"] == report["laws_evaluated"] == laws.at.size == flux.signal.size
    some = range(0, laws.at.size, max(1, laws.at.size // 12))
    errors = [total_variation(window(laws, k), exact(flux, system, int(entries.pixels[laws.at[k]]))) for k in some]
    assert max(errors) < 1e-4  # far below the aim: only the grid of the nearest entries is the table's


@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_at_the_entries_the_table_keeps_the_law(start: str):
    lut, system = bright_table(start), LOCKED_SYSTEM.replace(start=start)
    result = lut.at(np.repeat(lut.signal, lut.background.size), np.tile(lut.background, lut.signal.size))
    sure = result.trusted()
    assert np.array_equal(np.flatnonzero(~sure), lut.laws.row)
    assert lut.laws.row.size > 3
    flux = doubted(start=start, node=True)
    laws, entries, report = laws_of(flux, system)
    assert report["laws_evaluated"] == 0  # all were in the table
    for k in range(0, laws.at.size, max(1, laws.at.size // 6)):
        pixel = int(entries.pixels[laws.at[k]])
        # evaluated on another grid: that of 64 bins in the table, that of a single bin here
        assert total_variation(window(laws, k), exact(flux, system, pixel)) < 1e-6
    matched = matched_pmf(result.cumulants)
    for row in np.flatnonzero(sure)[::16]:
        law = ml.count_law(
            ml.Flux(lut.signal[row // lut.background.size], lut.background[row % lut.background.size], 50.0), system
        )
        assert total_variation(matched[row], Pmf(int(law.support[0]), law.pmf)) <= AIM


def test_other_delays_and_exposures_are_not_taken_from_the_entries():
    flux = doubted(node=True)
    moved = ml.Flux(flux.signal, flux.background, 31.0)
    assert laws_of(moved, LOCKED_SYSTEM)[2]["laws_evaluated"] > 0
    assert laws_of(flux, LOCKED_SYSTEM.replace(cycles=400))[2]["laws_evaluated"] > 0


def test_the_nearest_entry_gives_its_own_law():
    flux = doubted(seed=3)
    laws, entries, _ = laws_of(flux, LOCKED_SYSTEM, interpolation="nearest")
    lut = bright_table()
    node = entries.rows[laws.at[0], 0]
    pixel = entries.pixels[laws.at[0]]
    signal, background = lut.signal[node // lut.background.size], lut.background[node % lut.background.size]
    law = ml.count_law(ml.Flux(signal, background, float(flux.delay_ns.ravel()[pixel])), LOCKED_SYSTEM)
    assert total_variation(window(laws, 0), Pmf(int(law.support[0]), law.pmf)) < 1e-4


def test_counts_follow_the_exact_law():
    flux = doubted()
    item = ml.Flux(np.full((1, 8), flux.signal[0, 0]), flux.background[0, 0], flux.delay_ns[0, 0])
    report: dict[str, float] = {}
    cube = ml.simulate(item, LOCKED_SYSTEM, engine="mars", table=bright_table(), realizations=4000, report=report)
    assert (report["pixels_exact_count"], report["laws_evaluated"]) == (8, 1)  # alike: evaluated once
    law = exact(item, LOCKED_SYSTEM, 0)
    pmf = np.zeros(law.first + law.p.size)
    pmf[law.first :] = law.p
    require({"count law": counts_against_law(cube.sum(-1).ravel(), pmf)}, "doubted pixel from a table")


def test_usual_pixels_are_drawn_as_before():
    """No pixel in doubt: the same bits as from four cumulants; some in doubt: the others keep theirs."""
    flux, lut = doubted(), bright_table()
    parts = zip(
        (flux.signal, flux.background, flux.delay_ns), ([3.0] * 5, [0.55] * 5, np.linspace(0, 90, 5)), strict=True
    )
    mixed = ml.Flux(*(np.concatenate([some[0, :5], others])[None] for some, others in parts))
    sure = lut.at(mixed.signal, mixed.background, delay_ns=mixed.delay_ns).trusted()
    assert 0 < sure.sum() < 10
    given = {"engine": "mars", "table": lut, "realizations": 50}
    exact, matched = (ml.simulate(mixed, LOCKED_SYSTEM, count=count, **given) for count in ("exact", "matched"))
    assert np.array_equal(exact[:, 0, sure], matched[:, 0, sure])
    assert not np.array_equal(exact, matched)


@pytest.mark.parametrize("light", ["usual", "doubted"])
def test_batches_parts_and_threads_do_not_show(light: str, monkeypatch: pytest.MonkeyPatch):
    flux, system, lut = image(), SYSTEM, table()
    if light == "doubted":
        flux, system, lut = doubted(pixels=160), LOCKED_SYSTEM, bright_table()
    given = {"engine": "mars", "table": lut, "realizations": 3}
    whole = ml.simulate(flux, system, threads=2, **given)
    small = replace(TOL, batch_exposures=4, looked_up=11)
    for module in ("synthesis", "table_reader"):
        monkeypatch.setattr(f"mars_lidar.engines.{module}.TOL", small)
    monkeypatch.setitem(vars(STATISTICS), "block", 3)
    assert np.array_equal(whole, ml.simulate(flux, system, threads=1, **given))
    index = np.arange(flux.signal.size).reshape(flux.shape)[:, 2:6]
    assert np.array_equal(whole[:, :, 2:6], ml.simulate(flux[:, 2:6], system, pixel_index=index, **given))


def test_the_evaluation_can_be_stopped(monkeypatch: pytest.MonkeyPatch):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    flux = doubted()
    out = np.zeros((1, *flux.signal.shape, 64), LOCKED_SYSTEM.histogram_dtype)
    with pytest.raises(KeyboardInterrupt):
        ml.simulate(flux, LOCKED_SYSTEM, engine="mars", table=bright_table(), progress=stop, out=out)


def test_the_paper_s_table_and_count_are_left_alone():
    lut = Table.build(LOCKED_SYSTEM, (2.0, 9.0, 6), (0.02, 0.6, 4), method="mars")
    report: dict[str, float] = {}
    ml.simulate(doubted(), LOCKED_SYSTEM, engine="mars", table=lut, report=report)
    assert report["pixels_exact_count"] == 0
    assert lut.laws.row.size == 0
    ml.simulate(doubted(), LOCKED_SYSTEM, engine="mars", table=bright_table(), count="gaussian", report=report)
    assert "laws_evaluated" not in report


# The renewal baseline: its own count law, the chain's shape at the pixel's delay.


RENEWAL_SYSTEM = make_system(63.75, 400, 128, sigma_ns=1.5, start="stationary")


@pytest.mark.parametrize("with_table", [True, False])
def test_count_and_shape(with_table: bool):
    signal, background, delay = 1.3, 0.4, 31.234
    lut = Table.build(RENEWAL_SYSTEM, np.array([1.2, 1.3]), np.array([0.4, 0.5])) if with_table else None
    flux = ml.Flux(np.full((2, 4), signal), background, delay)
    cube = ml.simulate(flux, RENEWAL_SYSTEM, engine="renewal", table=lut, realizations=1000).reshape(-1, 128)
    renewal = ml.count_law(ml.Flux(signal, background, 0.0), RENEWAL_SYSTEM, "renewal")
    pmf = rounded_normal(float(renewal.mean), float(renewal.variance))
    exact = exposure_moments(ml.Flux(signal, background, delay), RENEWAL_SYSTEM).histogram
    observed = cube.sum(0, dtype=np.int64)
    shape = goodness(observed, exact / exact.sum() * observed.sum())
    require({"count law": counts_against_law(cube.sum(1, dtype=np.int64), pmf), "shape": shape}, f"table {with_table}")


def test_waveforms_and_returns_are_solved_at_their_own_delays():
    pixel = ml.Flux(np.full((1, 4), 0.9), 0.2, 31.7)
    both = ml.Flux.multi(pixel, ml.Flux(np.full((1, 4), 0.5), 0.0, 77.7))
    observed = ml.simulate(both, RENEWAL_SYSTEM, engine="renewal", realizations=1000).sum((0, 1, 2), dtype=np.int64)
    energy = RENEWAL_SYSTEM.pulse.bin_energy(np.array([31.7, 77.7]), 100.0, 128 * 64)
    wave = np.maximum(np.array([0.9, 0.5]) @ energy, 0.0)
    exact = exposure_moments(ml.Flux(waveform=wave, background=0.2), RENEWAL_SYSTEM).histogram
    require({"shape": goodness(observed, exact / exact.sum() * observed.sum())}, "renewal, two returns")
