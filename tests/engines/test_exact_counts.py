"""Counts of pixels from a table whose four cumulants do not fix the law: kept by the table, or evaluated."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from harness import Case, counts_against_law, make_system, require, task_of

import mars_lidar as ml
from mars_lidar.engines import MarsEngine
from mars_lidar.engines.synthesis import Matched, PartlyReplaced, Run, Streams, Tabulated
from mars_lidar.engines.table_reader import PixelEntries
from mars_lidar.engines.tolerances import TOL
from mars_lidar.statistics.count_pmf import Pmf, total_variation
from mars_lidar.statistics.tolerances import TOL as STATISTICS
from mars_lidar.table import Table

AIM = 0.002
SYSTEM = make_system(63.75, 150, 64)


@cache
def table(start: str = "armed") -> Table:
    # bright enough that the count all but locks to the laser
    return Table.build(SYSTEM.replace(start=start), (2.0, 9.0, 12), (0.02, 0.6, 8))


def doubted(seed: int = 0, pixels: int = 400, start: str = "armed", cycles: int = 150, node: bool = False) -> ml.Flux:
    """Pixels whose cumulants are not trusted; off the nodes unless told."""
    rng, lut = np.random.default_rng(seed), table(start)
    if node:
        row, column = np.divmod(lut.laws.row, lut.background.size)
        return ml.Flux(lut.signal[row][None], lut.background[column][None], 50.0)
    signal, background = rng.uniform(2.0, 9.0, pixels), np.exp(rng.uniform(np.log(0.02), np.log(0.6), pixels))
    delay = rng.uniform(0.0, 100.0, pixels)
    bad = ~lut.at(signal, background, delay_ns=delay, cycles=cycles).trusted()
    return ml.Flux(signal[bad][None], background[bad][None], delay[bad][None])


def laws_of(flux: ml.Flux, system: ml.System, **options: str) -> tuple[PartlyReplaced, PixelEntries, dict[str, float]]:
    """What the engine draws the counts of these pixels from, the table's entries of them, and its report."""
    engine = MarsEngine(table(system.start), **options)
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
    flux, system = doubted(start=start, cycles=cycles), SYSTEM.replace(start=start, cycles=cycles)
    laws, entries, report = laws_of(flux, system)
    assert report["pixels_exact_count"] == report["laws_evaluated"] == laws.at.size == flux.signal.size
    some = range(0, laws.at.size, max(1, laws.at.size // 12))
    errors = [total_variation(window(laws, k), exact(flux, system, int(entries.pixels[laws.at[k]]))) for k in some]
    assert max(errors) < 1e-4  # far below the aim: only the grid of the nearest entries is the table's


def test_the_four_cumulants_would_not_do():
    """What the exact laws are for: at some of these pixels the law of the cumulants is beyond the aim."""
    lut, flux = table(), doubted()
    result = lut.lookup(flux)
    from mars_lidar.statistics.matched import matched_pmf

    off = [total_variation(law, exact(flux, SYSTEM, k)) for k, law in enumerate(matched_pmf(result.cumulants)[:80])]
    assert max(off) > AIM


@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_at_the_entries_the_table_keeps_the_law(start: str):
    lut, system = table(start), SYSTEM.replace(start=start)
    result = lut.at(np.repeat(lut.signal, lut.background.size), np.tile(lut.background, lut.signal.size))
    from mars_lidar.statistics.matched import matched_pmf

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
    assert laws_of(moved, SYSTEM)[2]["laws_evaluated"] > 0
    assert laws_of(flux, SYSTEM.replace(cycles=400))[2]["laws_evaluated"] > 0


def test_the_nearest_entry_gives_its_own_law():
    flux = doubted(seed=3)
    laws, entries, _ = laws_of(flux, SYSTEM, interpolation="nearest")
    lut = table()
    node = entries.rows[laws.at[0], 0]
    pixel = entries.pixels[laws.at[0]]
    signal, background = lut.signal[node // lut.background.size], lut.background[node % lut.background.size]
    law = ml.count_law(ml.Flux(signal, background, float(flux.delay_ns.ravel()[pixel])), SYSTEM)
    assert total_variation(window(laws, 0), Pmf(int(law.support[0]), law.pmf)) < 1e-4


def test_counts_follow_the_exact_law():
    flux = doubted()
    item = ml.Flux(np.full((1, 8), flux.signal[0, 0]), flux.background[0, 0], flux.delay_ns[0, 0])
    report: dict[str, float] = {}
    cube = ml.simulate(item, SYSTEM, engine="mars", table=table(), realizations=4000, report=report)
    assert (report["pixels_exact_count"], report["laws_evaluated"]) == (8, 1)  # alike: evaluated once
    law = exact(item, SYSTEM, 0)
    pmf = np.zeros(law.first + law.p.size)
    pmf[law.first :] = law.p
    require({"count law": counts_against_law(cube.sum(-1).ravel(), pmf)}, "doubted pixel from a table")


def test_usual_pixels_are_drawn_as_before():
    """No pixel in doubt: the same bits as from four cumulants; some in doubt: the others keep theirs."""
    flux = doubted()
    parts = zip(
        (flux.signal, flux.background, flux.delay_ns), ([3.0] * 5, [0.55] * 5, np.linspace(0, 90, 5)), strict=True
    )
    mixed = ml.Flux(*(np.concatenate([some[0, :5], others])[None] for some, others in parts))
    lut = table()
    sure = lut.at(mixed.signal, mixed.background, delay_ns=mixed.delay_ns).trusted()
    assert 0 < sure.sum() < 10
    cubes = {
        count: ml.simulate(mixed, SYSTEM, engine="mars", table=lut, count=count, realizations=50)
        for count in ("exact", "matched")
    }
    assert np.array_equal(cubes["exact"][:, 0, sure], cubes["matched"][:, 0, sure])
    assert not np.array_equal(cubes["exact"], cubes["matched"])


def test_parts_batches_and_threads_do_not_show(monkeypatch: pytest.MonkeyPatch):
    from mars_lidar.engines import synthesis as _synthesis
    from mars_lidar.engines import table_reader as _table_reader

    flux = doubted(pixels=160)
    whole = ml.simulate(flux, SYSTEM, engine="mars", table=table(), realizations=3, threads=2)
    small = replace(TOL, batch_exposures=4, looked_up=11)
    monkeypatch.setattr(_synthesis, "TOL", small)
    monkeypatch.setattr(_table_reader, "TOL", small)
    monkeypatch.setitem(vars(STATISTICS), "block", 3)
    assert np.array_equal(whole, ml.simulate(flux, SYSTEM, engine="mars", table=table(), realizations=3, threads=1))
    index = np.arange(flux.signal.size).reshape(1, -1)[:, 7:20]
    part = ml.simulate(flux[:, 7:20], SYSTEM, engine="mars", table=table(), realizations=3, pixel_index=index)
    assert np.array_equal(part, whole[:, :, 7:20])


def test_a_part_of_mended_laws_is_mended_alike():
    cumulants = np.tile([[40.0, 3.0, -0.7, 0.3]], (9, 1))
    other = Tabulated.of([Pmf(7, np.array([0.5, 0.5]))], np.zeros(3, np.int64))
    laws = PartlyReplaced(Matched(cumulants), np.array([1, 4, 8]), other)
    streams = Streams(np.arange(9, dtype=np.uint32), 4, 0, 1, 1)
    whole = laws.draw(streams)
    assert (whole[:, [1, 4, 8]] < 9).all()
    for some in (slice(0, 3), slice(3, 7), slice(2, 4), slice(5, 20)):
        part = Streams(streams.pixel_index[some], 4, 0, 1, 1)
        assert np.array_equal(laws.part(some).draw(part), whole[:, some])


def test_the_evaluation_can_be_stopped(monkeypatch: pytest.MonkeyPatch):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    flux = doubted()
    out = np.zeros((1, *flux.signal.shape, 64), SYSTEM.histogram_dtype)
    with pytest.raises(KeyboardInterrupt):
        ml.simulate(flux, SYSTEM, engine="mars", table=table(), progress=stop, out=out)


def test_the_paper_s_table_and_count_are_left_alone():
    lut = Table.build(SYSTEM, (2.0, 9.0, 6), (0.02, 0.6, 4), method="mars")
    report: dict[str, float] = {}
    ml.simulate(doubted(), SYSTEM, engine="mars", table=lut, report=report)
    assert report["pixels_exact_count"] == 0
    assert lut.laws.row.size == 0
    ml.simulate(doubted(), SYSTEM, engine="mars", table=table(), count="gaussian", report=report)
    assert "laws_evaluated" not in report
