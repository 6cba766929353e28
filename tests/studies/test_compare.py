"""``python -m studies compare``: its errors and scores are honest, it finds what is wrong, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from harness import make_system, require
from scipy import stats

import mars_lidar as ml
from mars_lidar.engines import ENGINES, Engine
from studies.compare.command import cell, main, show, with_error
from studies.compare.comparison import Estimate, Moments, PixelLaw, compare, ratio
from tests.harness.command import command_line

SYSTEM = make_system(63.0, 200, 100, sigma_ns=1.5)
TRUE = ("exact", "sequential")  # engines that claim everything


def scene(height: int = 8, width: int = 10) -> ml.Flux:
    """Two planes, the right one farther and darker."""
    right = np.arange(width) >= width // 2
    s = np.tile(np.where(right, 0.5, 2.0), (height, 1)) * np.linspace(0.8, 1.2, height)[:, None]
    return ml.Flux(s, 0.4, np.tile(np.where(right, 60.0, 20.0), (height, 1)))


def p_value(z: float) -> float:
    return float(2.0 * stats.norm.sf(abs(z)))


class CountTimesShape(Engine):
    """The right count and the right mean histogram, but independent bins given the count: the wrong joint law."""

    name = "count-times-shape"
    description = "for tests"

    def histogram(self, task, out):
        exact = np.empty_like(out)
        ENGINES["exact"].histogram(task, exact)
        number = exact.sum(1, dtype=np.int64)
        flux, system = task.flux, task.system
        shape = ml.registration_pdf(ml.Flux(flux.signal, flux.background, flux.delay_ns), system, threads=1)
        shape = np.tile(shape.reshape(-1, system.bins), (task.realizations, 1))
        random = np.random.default_rng([task.seed, task.first_realization])
        out[:] = random.multinomial(number, shape / shape.sum(1, keepdims=True))


class Refusing(Engine):
    name = "refusing"
    description = "for tests"

    def __init__(self, late: bool) -> None:
        self.late = late

    def check(self, flux, system):
        if not self.late:
            raise ValueError("system.cycles must be odd")

    def histogram(self, task, out):
        raise ValueError("flux lies outside of the table")


@pytest.fixture(scope="module")
def result():
    engines = ["exact", "sequential", "poisson"]
    return compare(scene(), SYSTEM, engines, realizations=3000, repeats=8, seed=5, threads=2)


@pytest.mark.full
@pytest.mark.parametrize("engine", TRUE)
def test_true_engines_are_not_accused(result, engine):
    for pixel, row in result.statistics.items():
        scored = {name: e for name, e in row[engine].scored.items() if not math.isnan(e.z)}
        assert scored.keys() >= {"mean", "variance", "window_mean", "window_variance", "lag1"}
        assert ("window_ratio" in scored) == (engine != result.against)
        require({name: p_value(e.z) for name, e in scored.items()}, f"compare: {engine}, {pixel}")
    s = result.scenes[engine]
    whole = {"relative": s.relative_bias.z, "dispersion": s.dispersion.z}
    require({name: p_value(z) for name, z in whole.items()}, f"compare: {engine}, image")


def test_no_dead_time_is_found_in_everything(result):
    s = result.scenes["poisson"]
    assert s.relative_bias.wrong
    assert s.dispersion.wrong
    expected = float(result.flux.total.sum()) * SYSTEM.cycles / float(result.expected.mean.sum()) - 1.0
    assert s.relative_bias.value == pytest.approx(expected, abs=8 * s.relative_bias.error)
    assert all(e.wrong for e in result.statistics["bright"]["poisson"].scored.values())


def test_a_wrong_joint_law_is_found_and_nothing_else():
    system, flux = SYSTEM.replace(detector=ml.Detector(dead_time_ns=10.0)), ml.Flux(np.full((2, 2), 2.0), 2.0, 20.0)
    result = compare(flux, system, [CountTimesShape()], realizations=3000, repeats=8, seed=5, threads=2)
    statistics = result.statistics["bright"]["count-times-shape"]
    row = statistics.scored
    assert {name for name, e in row.items() if e.wrong} == {"window_variance", "window_ratio", "lag1"}
    require({name: p_value(row[name].z) for name in ("mean", "variance", "window_mean")}, "compare: joint only")
    assert not result.scenes["count-times-shape"].relative_bias.wrong
    # the bins of the window given the count are binomial: Var = Var(N) q^2 + E(N) q (1 - q)
    law, histogram = result.laws["bright"], ml.mean_histogram(flux[0, 0], system)
    q = float(histogram[np.abs(system.time_ns - 20.0) < 4.5].sum() / histogram.sum())
    variance = law.cumulants[1] * q * q + law.cumulants[0] * q * (1 - q)
    drawn = statistics.window.variance
    require({"window variance": p_value((drawn.value - variance) / drawn.error)}, "compare: multinomial window")


def test_a_seed_gives_the_same_numbers_whoever_runs_beside(result):
    alone = compare(scene(), SYSTEM, ["sequential"], realizations=3000, repeats=8, seed=5, threads=1)
    assert list(alone.scenes) == ["exact", "sequential"]
    for pixel, row in alone.statistics.items():
        again = result.statistics[pixel]["sequential"].scored
        assert {k: v.value for k, v in row["sequential"].scored.items()} == {k: v.value for k, v in again.items()}


KINDS = {
    "several returns": ml.Flux.multi(scene(4, 5), ml.Flux(0.4, 0.0, 99.5)),
    "waveform": ml.Flux(waveform=np.random.default_rng(0).gamma(0.3, 0.05, (4, 5, 40)), background=0.1),
    "no signal": ml.Flux(np.zeros((4, 5)), 0.3, np.nan),
    "nothing at all": ml.Flux(0.0, 0.0, np.nan),
    "one pixel": ml.Flux(2.0, 0.5, 99.9),
    "few photons": ml.Flux(np.full((3, 3), 1e-3), 1e-3, 50.0),
}


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_flux_is_compared(kind, capsys):
    result = compare(KINDS[kind], SYSTEM, TRUE, realizations=200, repeats=2)
    for row in result.statistics.values():
        for engine in TRUE:
            assert not [name for name, e in row[engine].scored.items() if e.wrong]
    assert not result.unpredicted
    show(result)
    assert all(f"{pixel} pixel" in capsys.readouterr().out for pixel in list(result.pixels)[:1])


def test_a_large_image_is_predicted_on_a_grid():
    system = SYSTEM.replace(bins=8, cycles=20)
    result = compare(scene(70, 66), system, ["exact"], realizations=50, repeats=1)
    assert result.expected.step == 2
    assert result.expected.mean.shape == (35, 33)
    require({"bias": p_value(result.scenes["exact"].relative_bias.z)}, "compare: on a grid")


def test_engines_that_cannot_are_skipped_and_told():
    for late, words in ((False, "cycles must be odd"), (True, "outside of the table")):
        result = compare(scene(), SYSTEM, ["exact", Refusing(late)], realizations=50, repeats=1)
        assert list(result.scenes) == ["exact"]
        assert words in result.skipped["refusing"]
        with pytest.raises(ValueError, match=words):
            compare(scene(), SYSTEM, ["exact", Refusing(late)], against="refusing", realizations=50, repeats=1)


def test_without_a_prediction_the_reference_engine_is_the_goal(monkeypatch, capsys):
    def refused(*_):
        raise ValueError("it does not settle")

    monkeypatch.setattr(PixelLaw, "of", refused)
    result = compare(scene(), SYSTEM, [*TRUE, "poisson"], realizations=1000, repeats=2, seed=8)
    assert set(result.unpredicted.values()) == {"it does not settle"}
    for pixel, row in result.statistics.items():
        assert all(math.isnan(e.z) for e in row["exact"].scored.values())
        require({k: p_value(e.z) for k, e in row["sequential"].scored.items()}, f"compare: two samples, {pixel}")
        wrong = {name for name, e in row["poisson"].scored.items() if e.wrong}
        assert wrong >= {"mean", "variance", "window_ratio"}
    show(result)
    assert "bright pixel has no prediction: it does not settle" in capsys.readouterr().out


SMALL = ["--scene", "room", "--size", "12", "--cycles", "50", "--bins", "64", "--realizations", "300"]


def test_the_command_prints_its_tables():
    arguments = ["--engines", "exact, poisson", "--pixel", "3,4", "--pixel", "7,8", "--repeats", "2"]
    done = command_line([*SMALL, *arguments], main=main)
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 100
    rows = {name: [line for line in lines if line.startswith(name)] for name in ("exact", "poisson", "predicted")}
    assert [len(rows[name]) for name in ("exact", "poisson", "predicted")] == [3, 3, 2]
    assert all("!" in line for line in rows["poisson"])
    assert not any("!" in line for line in rows["exact"])
    assert "3,4 pixel (y 3, x 4)" in done.stdout
    assert "7,8 pixel (y 7, x 8)" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--engines", "exact,fast"], "--engines must be one of"),
        (["--against", "fast"], "against must be one of"),
        (["--pixel", "3"], "--pixel must be two integers Y,X"),
        (["--realizations", "10"], "realizations must be an integer in [50, 10000000], got 10"),
        (["--repeats", "0"], "repeats must be"),
        (["--pixel", "3,12"], "pixels must lie in the image of shape (12, 12), got '3,12'"),
    ],
)
def test_bad_input_of_the_command_is_exit_code_2(arguments, words):
    done = command_line([*SMALL, "--repeats", "1", *arguments], main=main)
    assert done.exit_code == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_numbers_are_written_to_their_error():
    assert with_error(858.4412, 0.1234) == "858.44(12)"
    assert with_error(858.4412, 0.34) == "858.4(3)"
    assert with_error(13181.3, 309.4) == "13181(309)"
    assert with_error(161013133.0, 6331063.0) == "1.61e+08"
    assert with_error(-0.0262, 0.0015) == "-0.0262(15)"
    assert with_error(1.0, 0.97) == "1.0(10)"
    assert with_error(0.25, math.nan) == "0.25"
    assert with_error(math.nan, 1.0) == "–"
    wrong = cell(Estimate(1.0, 0.1, -5.1))
    assert (wrong.plain, wrong.style) == ("1.00(10)!", "bold red")
    assert cell(Estimate(1.0, 0.1, -4.9)).plain == "1.00(10) "
    assert not Estimate(1.0, 0.1, math.nan).wrong


def test_standard_errors_are_those_of_repeated_samples():
    random = np.random.default_rng(3)
    law = stats.nbinom(6, 0.3)  # skewed and over-dispersed
    mean, variance, skew, kurtosis = (float(v) for v in law.stats("mvsk"))
    many = [Moments.of(law.rvs(size=500, random_state=random)) for _ in range(400)]
    for name, true in {"mean": mean, "variance": variance}.items():
        z = [(getattr(m, name).value - true) / getattr(m, name).error for m in many]
        assert 0.88 < np.std(z) < 1.12, name  # 0.035 by chance; the variance's own error adds some
    cumulants = np.array([mean, variance, skew * variance**1.5, kurtosis * variance**2])
    scored = [Moments.of(law.rvs(size=500, random_state=random), cumulants) for _ in range(400)]
    z = np.array([[m.mean.z, m.variance.z] for m in scored])
    assert np.all((z.std(0) > 0.8) & (z.std(0) < 1.15))
    a, b = many[0].variance, many[1].variance
    assert ratio(a, b).value == a.value / b.value
    assert ratio(a, b).z == pytest.approx((a.value - b.value) / math.hypot(a.error, b.error))


def test_a_certain_count_is_certain():
    same = Moments.of(np.full(100, 7), np.array([7.0, 0.0, 0.0, 0.0]))
    assert (same.mean.z, same.variance.z) == (0.0, 0.0)
    assert Moments.of(np.full(100, 8), np.array([7.0, 0.0, 0.0, 0.0])).mean.wrong
    rare = Moments.of(np.full(100, 7), np.array([7.0 + 1e-6, 1e-6, 1e-6, 1e-6]))
    assert not rare.mean.wrong
