"""``python -m studies compare``: its errors and scores are honest, it finds what is wrong, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from harness import make_system
from harness.ledger import require
from matplotlib.figure import Figure
from scipy import stats

import mars_lidar as ml
from mars_lidar.engines import ENGINES, Engine
from studies.compare.comparison import compare, telling_pixels
from studies.compare.report import comparison, show

SYSTEM = make_system(63.0, 200, 100, sigma_ns=1.5)
CALM = {"threads": 2, "budget_s": 600.0}  # as many exposures on a busy machine
TRUE = ("exact", "sequential")  # engines that claim everything


def scene(height: int = 8, width: int = 10) -> ml.Flux:
    """Two planes, the right one farther and darker."""
    right = np.arange(width) >= width // 2
    s = np.tile(np.where(right, 0.5, 2.0), (height, 1)) * np.linspace(0.8, 1.2, height)[:, None]
    return ml.Flux(s, 0.4, np.tile(np.where(right, 60.0, 20.0), (height, 1)))


def p_value(z: float, *, one_sided: bool = False) -> float:
    return float(stats.norm.sf(z)) if one_sided else float(2.0 * stats.norm.sf(abs(z)))


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


class Dimmed(Engine):
    """The exact engine of a scene 3 % darker."""

    name = "dimmed"
    description = "for tests"

    def histogram(self, task, out):
        flux = task.flux
        darker = ml.Flux(0.97 * flux.signal, 0.97 * flux.background, flux.delay_ns)
        ml.simulate(
            darker,
            task.system,
            realizations=task.realizations,
            first_realization=task.first_realization,
            pixel_index=task.pixel_index,
            seed=task.seed,
            threads=task.threads,
            out=out.reshape(task.realizations, *flux.shape, -1),
        )


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
    engines = ["exact", "sequential", "poisson", Dimmed()]
    return compare(scene(), SYSTEM, engines, realizations=3000, repeats=8, pixels=3, seed=5, **CALM)


@pytest.mark.full
@pytest.mark.parametrize("engine", TRUE)
def test_true_engines_are_not_accused(result, engine):
    for pixel, row in result.statistics.items():
        scored = {name: e for name, e in row[engine].scored.items() if not math.isnan(e.z)}
        assert scored.keys() >= {"mean", "variance", "fano", "window_variance", "lag1_error", "shape", "law"}
        assert ("window_ratio" in scored) == (engine != result.against)
        p = {name: p_value(e.z, one_sided=name in ("shape", "law")) for name, e in scored.items()}
        require(p, f"compare: {engine}, {pixel}")
    s = result.scenes[engine]
    whole = {"bias": s.bias.z, "relative": s.relative_bias.z, "dispersion": s.dispersion.z}
    require({name: p_value(z) for name, z in whole.items()}, f"compare: {engine}, image")


def test_no_dead_time_is_found_in_everything(result):
    s = result.scenes["poisson"]
    assert s.bias.wrong
    assert s.relative_bias.wrong
    assert s.dispersion.wrong
    expected = float(result.flux.total.sum()) * SYSTEM.cycles / float(result.expected.mean.sum()) - 1.0
    assert s.relative_bias.value == pytest.approx(expected, abs=8 * s.relative_bias.error)
    bright = result.statistics["bright"]["poisson"]
    wrong = {name for name, e in bright.scored.items() if e.wrong}
    assert wrong >= {"mean", "variance", "fano", "window_mean", "window_variance", "window_ratio", "shape", "law"}


def test_a_wrong_joint_law_is_found_and_nothing_else():
    system, flux = SYSTEM.replace(detector=ml.Detector(dead_time_ns=10.0)), ml.Flux(np.full((2, 2), 2.0), 2.0, 20.0)
    result = compare(flux, system, [CountTimesShape()], realizations=3000, repeats=8, pixels=1, seed=5, **CALM)
    row = result.statistics["bright"]["count-times-shape"].scored
    assert {name for name, e in row.items() if e.wrong} == {"window_variance", "window_ratio", "lag1_error"}
    right = ("mean", "variance", "fano", "window_mean", "shape", "law")
    require({name: p_value(row[name].z, one_sided=name in ("shape", "law")) for name in right}, "compare: joint only")
    assert not result.scenes["count-times-shape"].bias.wrong
    # the bins of the window given the count are binomial: Var = Var(N) q^2 + E(N) q (1 - q)
    law = result.laws["bright"]
    window = np.abs(system.time_ns - 20.0) < 4.5
    q = float(law.histogram[window].sum() / law.histogram.sum())
    variance = law.counts.variance.value * q * q + law.counts.mean.value * q * (1 - q)
    drawn = result.statistics["bright"]["count-times-shape"].window.variance
    require({"window variance": p_value((drawn.value - variance) / drawn.error)}, "compare: multinomial window")


def test_a_small_bias_of_the_image_is_found(result):
    dimmed, flux = result.scenes["dimmed"], result.flux
    assert dimmed.relative_bias.wrong
    darker = ml.count_law(ml.Flux(0.97 * flux.signal, 0.97 * flux.background, flux.delay_ns), SYSTEM)
    expected = float(darker.mean.sum() / result.expected.mean.sum()) - 1.0
    z = (dimmed.relative_bias.value - expected) / dimmed.relative_bias.error
    require({"relative bias": p_value(z)}, "compare: a darker scene")


def test_predictions_are_those_of_the_count_law(result):
    law = ml.count_law(ml.Flux(result.flux.signal, result.flux.background, result.flux.delay_ns), SYSTEM)
    assert np.allclose(result.expected.mean, law.mean, rtol=1e-6)
    assert np.allclose(result.expected.variance, law.variance, rtol=1e-3)
    y, x = result.pixels["dim"]
    assert result.laws["dim"].counts.variance.value == pytest.approx(float(law.variance[y, x]), rel=1e-3)


def test_a_seed_gives_the_same_numbers_whoever_runs_beside(result):
    alone = compare(
        scene(), SYSTEM, ["sequential"], realizations=3000, repeats=8, pixels=3, seed=5, **{**CALM, "threads": 1}
    )
    assert alone.engines == ["exact", "sequential"]
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
def test_every_kind_of_flux_is_compared_and_drawn(tmp_path, kind):
    result = compare(KINDS[kind], SYSTEM, TRUE, realizations=200, repeats=2, **CALM)
    for row in result.statistics.values():
        for engine in TRUE:
            assert not [name for name, e in row[engine].scored.items() if e.wrong]
    assert not result.unpredicted
    figure = comparison(result)
    assert isinstance(figure, Figure)
    figure.savefig(tmp_path / "compare.png", dpi=40)
    assert (tmp_path / "compare.png").stat().st_size > 2000


def test_a_large_image_is_predicted_on_a_grid():
    system = SYSTEM.replace(bins=8, cycles=20)
    result = compare(scene(70, 66), system, ["exact"], realizations=50, repeats=1, pixels=1, **CALM)
    assert result.expected.step == 2
    assert result.expected.mean.shape == (35, 33)
    assert result.expected.known.all()
    require({"bias": p_value(result.scenes["exact"].bias.z)}, "compare: on a grid")
    assert isinstance(comparison(result), Figure)


def test_engines_that_cannot_are_skipped_and_told():
    for late, words in ((False, "cycles must be odd"), (True, "outside of the table")):
        result = compare(scene(), SYSTEM, ["exact", Refusing(late)], realizations=50, repeats=1, pixels=1, **CALM)
        assert result.engines == ["exact"]
        assert words in result.skipped["refusing"]
        with pytest.raises(ValueError, match=words):
            compare(scene(), SYSTEM, ["exact", Refusing(late)], against="refusing", realizations=50, repeats=1)


def test_without_a_prediction_the_reference_engine_is_the_goal(monkeypatch, capsys):
    monkeypatch.setattr("studies.compare.comparison.pixel_law", lambda *_: "it does not settle")
    result = compare(scene(), SYSTEM, [*TRUE, "poisson"], realizations=1000, repeats=2, pixels=2, seed=8, **CALM)
    assert result.unpredicted == {"bright": "it does not settle", "dim": "it does not settle"}
    for pixel, row in result.statistics.items():
        assert all(math.isnan(e.z) for e in row["exact"].scored.values())
        p = {k: p_value(e.z, one_sided=k in ("shape", "law")) for k, e in row["sequential"].scored.items()}
        require(p, f"compare: two samples, {pixel}")
        wrong = {name for name, e in row["poisson"].scored.items() if e.wrong}
        assert wrong >= {"mean", "variance", "window_ratio", "law"}
    assert isinstance(comparison(result), Figure)
    show(result)
    assert "bright pixel has no prediction: it does not settle" in capsys.readouterr().out


def test_less_time_means_fewer_exposures():
    result = compare(scene(), SYSTEM, ["exact"], realizations=10**5, repeats=500, pixels=1, budget_s=1e-6)
    assert result.statistics["bright"]["exact"].realizations == 50
    assert len(result.scenes["exact"].seconds) == 1
    assert not result.expected.known.any()
    assert math.isnan(result.scenes["exact"].bias.value)
    assert isinstance(comparison(result), Figure)


def test_pixels_are_different_and_in_order():
    named = telling_pixels(scene(), np.asarray(SYSTEM.depth_m(scene().delay_ns)), 6)
    assert list(named)[:3] == ["bright", "dim", "edge"]
    assert len(set(named.values())) == len(named)
    assert list(telling_pixels(scene(), np.zeros((8, 10)), 1)) == ["bright"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"realizations": 10}, r"realizations must be an integer in \[50, 10000000\], got 10"),
        ({"repeats": 0}, "repeats must be"),
        ({"pixels": 7}, r"pixels must be an integer in \[1, 6\], got 7"),
        ({"pixels": {"far": (0, 10)}}, r"pixels must lie in the image of shape \(8, 10\), got 'far' at \(0, 10\)"),
        ({"pixels": {}}, "pixels must be 1 to 6"),
        ({"engines": ["exact", "exact"]}, "engines must differ"),
        ({"engines": ["fast"]}, "engine must be one of"),
        ({"against": "fast"}, "against must be one of"),
        ({"budget_s": 0.0}, "budget_s must be"),
        ({"depth_m": np.zeros((3, 3))}, r"depth_m must have the shape \(8, 10\)"),
        ({"seed": -1}, "seed must be"),
    ],
)
def test_bad_input_names_the_argument(arguments, words):
    with pytest.raises(ValueError, match=words):
        compare(scene(), SYSTEM, **arguments)


def test_wrong_types_are_named():
    with pytest.raises(TypeError, match="flux must be a Flux, got str"):
        compare("room", SYSTEM)
    with pytest.raises(TypeError, match="system must be a System"):
        compare(scene(), None)
    with pytest.raises(TypeError, match="engines must be a sequence of names, got 'exact'"):
        compare(scene(), SYSTEM, "exact")
