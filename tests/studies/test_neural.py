"""The neural stand-in: its PDF against the chain, its count's moments, its refusals, its files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from harness import make_system, mean_vector, refused, require

import mars_lidar as ml
from mars_lidar.statistics import PhaseChain, holding_times
from studies.__main__ import main
from studies.compare.comparison import compare
from studies.neural import FluxRange, NeuralEngine, NeuralMap, Training, train
from studies.neural.pairs import Pairs

WITHIN = 0.02  # total variation
SYSTEM = make_system(75.0, 1000, 1024, sigma_ns=0.5, period_ns=1e3 / 7.5)
NEURAL = NeuralEngine()
SMALL = make_system(30.0, 50, 128, sigma_ns=2.0)


def variation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 0.5 * np.abs(a - b).sum(-1)


@pytest.fixture(scope="module")
def held_out() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fluxes of one return that no training saw: S, B and delays."""
    random = np.random.default_rng(20_510)
    signal, background = np.exp(random.uniform(np.log(0.01), np.log(10.0), (2, 200)))
    return signal, background, random.uniform(0.0, SYSTEM.period_ns, 200)


def test_pdf_is_within_a_fiftieth_of_the_chain(held_out):
    signal, background, delay = held_out
    chain = ml.registration_pdf(ml.Flux(signal, background, delay), SYSTEM, "chain")
    result = NEURAL.registration_pdf(ml.Flux(signal, background, delay), SYSTEM)
    np.testing.assert_allclose(result.sum(-1), 1.0, rtol=1e-12)
    assert (result >= 0.0).all()
    off = variation(result, chain)
    assert off.max() < WITHIN
    assert off.mean() < WITHIN / 10
    # what a network that ignores its input would score, in the best of frames: each flux at the same delay
    fixed = ml.registration_pdf(ml.Flux(signal, background, 0.5 * SYSTEM.period_ns), SYSTEM, "chain")
    assert variation(fixed, fixed.mean(0)).mean() > 10 * WITHIN


def test_pdf_of_two_returns():
    model = NeuralMap.example()
    fluxes = FluxRange(signal=(0.1, 10.0), background=(0.05, 10.0))
    pairs = Pairs.of(fluxes.draw(SYSTEM, 150, np.random.default_rng(9)), SYSTEM)
    off = variation(model.pdf(pairs.photons), pairs.pdf)
    assert np.quantile(off, 0.9) < WITHIN


def test_the_delay_is_not_learned_but_exact():
    delay = (200.25 + np.array([0.0, 1.0, 517.0])) * SYSTEM.bin_ns
    pdf = NEURAL.registration_pdf(ml.Flux(3.0, 0.5, delay), SYSTEM)
    np.testing.assert_allclose(np.roll(pdf[0], 1), pdf[1], atol=1e-7)
    np.testing.assert_allclose(np.roll(pdf[0], 517), pdf[2], atol=1e-7)


def test_count_has_the_mean_of_the_chain_and_the_variance_of_one_holding_time(held_out):
    signal, background, _ = (x[:40] for x in held_out)
    law = NEURAL.count_law(ml.Flux(signal, background, 50.0), SYSTEM)
    for k, (s, b) in enumerate(zip(signal, background, strict=True)):
        times = holding_times(PhaseChain.from_flux(ml.Flux(s, b, 0.5 * SYSTEM.period_ns), SYSTEM))
        assert law.mean[k] == pytest.approx(SYSTEM.cycles / times.mu, rel=0.01)
        # (3.5) in place of (3.9): t sigma_ss^2 / mu^3
        assert law.variance[k] == pytest.approx(SYSTEM.cycles * times.sigma_ss2 / times.mu**3, rel=0.1)
    # and that is not the variance of the count: the covariances are what the MaRS paper adds
    exact = ml.count_law(ml.Flux(8.0, 0.1, 0.5 * SYSTEM.period_ns), SYSTEM).variance
    assert NEURAL.count_law(ml.Flux(8.0, 0.1, 50.0), SYSTEM).variance > 1.5 * exact


def test_engine_draws_its_own_law():
    signal, background, delay = 4.0, 0.7, 31.7
    flux = ml.Flux(np.full((1, 4), signal), background, delay)
    cube = ml.simulate(flux, SYSTEM, engine=NEURAL, realizations=500, seed=3).reshape(-1, SYSTEM.bins)
    law = NEURAL.count_law(ml.Flux(signal, background, 50.0), SYSTEM)
    pdf = NEURAL.registration_pdf(ml.Flux(signal, background, delay), SYSTEM)
    counts = cube.sum(-1, dtype=np.int64)
    groups = cube.reshape(-1, 32, SYSTEM.bins // 32).sum(-1, dtype=np.int64)
    mean, variance = float(law.mean), float(law.variance)
    require({"count mean": mean_vector(counts[:, None], np.array([mean]), variance=np.array([variance + 1 / 12]))})
    # Sheppard: rounding adds 1/12
    assert counts.var() == pytest.approx(variance + 1.0 / 12.0, rel=0.15)
    require({"mean histogram": mean_vector(groups[:, :-1], mean * pdf.reshape(32, -1).sum(-1)[:-1])})


def test_bits_do_not_depend_on_threads_or_company():
    scene = ml.Scene.example("room", size=8).flux(SYSTEM, signal=1.0, sbr=1.0)
    whole = ml.simulate(scene, SYSTEM, engine=NEURAL, seed=4, threads=2)
    part = ml.simulate(scene[3:], SYSTEM, engine=NEURAL, seed=4, threads=1, pixel_index=np.arange(24, 64))
    assert np.array_equal(part, whole[:, 3:])


def test_without_light_or_without_signal():
    flux = ml.Flux(np.array([[0.0, 0.0]]), np.array([[0.0, 1.0]]))
    cube = ml.simulate(flux, SYSTEM, engine=NEURAL)
    assert not cube[0, 0, 0].any()
    assert cube[0, 0, 1].sum() > 500
    assert np.ptp(NEURAL.registration_pdf(ml.Flux(0.0, 1.0), SYSTEM)) == 0.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"detector": ml.Detector(dead_time_ns=80.0)}, "dead_time_ns is 80"),
        ({"bins": 512}, "bins is 512"),
        ({"period_ns": 100.0}, "period_ns is 100"),
        ({"pulse": ml.GaussianPulse(sigma_ns=1.0)}, "pulse is"),
    ],
)
def test_another_system_is_refused_by_name(changes, words):
    refused(re.escape(words), ml.simulate, ml.Flux(1.0, 1.0, 5.0), SYSTEM.replace(**changes), engine=NEURAL)
    refused(re.escape(words), NEURAL.count_law, ml.Flux(1.0, 1.0, 50.0), SYSTEM.replace(**changes))


def test_other_fluxes_are_refused():
    for flux, words in (
        (ml.Flux(50.0, 1.0, 5.0), "signal of 0 to 12"),
        (ml.Flux(1.0, 0.0, 5.0), "background of 0.002 to 12"),
        (ml.Flux(waveform=np.ones(64) / 64), "waveform"),
        (ml.Flux.multi(*(ml.Flux(1.0, 0.1, d) for d in (5.0, 9.0, 20.0))), "3"),
    ):
        refused(words, ml.simulate, flux, SYSTEM, engine=NEURAL)


def test_cycles_and_start_do_not_matter():
    flux = ml.Flux(1.0, 1.0, 5.0)
    ml.simulate(flux, SYSTEM.replace(cycles=5, start="stationary"), engine=NEURAL)
    thin = SYSTEM.replace(detector=ml.Detector(dead_time_ns=75.0, detection_efficiency=0.5))
    half = NEURAL.count_law(ml.Flux(2.0, 2.0, 50.0), thin)
    assert half.mean == NEURAL.count_law(ml.Flux(1.0, 1.0, 50.0), SYSTEM).mean


@pytest.mark.full
def test_training_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "net.npz"
    system = tmp_path / "small.yaml"
    SMALL.save(system)
    arguments = ["neural", "train", "--system", str(system), "-o", str(path)]
    arguments += ["--steps", "150", "--pairs", "300"]
    assert main(arguments) == 0
    assert "total variation to the chain" in capsys.readouterr().out
    assert {p.name for p in tmp_path.iterdir()} == {"net.npz", "net.csv", "net.png", "small.yaml"}
    result = NeuralMap.load(path)
    assert result.system.dead_time_periods == 0.3
    # learned, not merely guessed: better than before the first step, and than the mean PDF
    rows = (tmp_path / "net.csv").read_text().splitlines()
    first, last = (float(rows[k].split(",")[3]) for k in (1, -1))
    assert last < 0.5 * first
    assert last < 0.2 * result.record["tv_unconditional"]
    flux = ml.Flux(1.0, 1.0, 5.0)
    cube = ml.simulate(flux, SMALL, engine=NeuralEngine(path))
    assert np.array_equal(cube, ml.simulate(flux, SMALL, engine=NeuralEngine(result)))
    assert main(["neural", "info", str(path)]) == 0
    assert "trained" not in capsys.readouterr().err
    assert main(arguments) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["neural", "info", str(system)]) == 2
    assert path.exists()


@pytest.mark.full
def test_it_is_compared_beside_the_engines_of_the_package():
    scene = ml.Scene.example("room", size=4)
    result = compare(scene.flux(SYSTEM, signal=1.0, sbr=1.0), SYSTEM, ["exact", NEURAL], realizations=50, seed=1)
    assert list(result.scenes) == ["exact", "neural"]
    assert not result.skipped


def test_training_is_repeatable():
    plan = Training(steps=3, pairs=40, held_out=10, batch=8, width=4, code=8)
    first, two = (train(SMALL, plan).map for _ in range(2))
    assert first.digest == two.digest != train(SMALL, Training(**{**vars(plan), "seed": 1})).map.digest


def test_bad_files_and_plans(tmp_path: Path):
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"PK\x03\x04 nothing")
    refused(r"broken\.npz must be a neural map", NeuralMap.load, broken)
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, header=np.array([{"a": 1}], dtype=object))
    refused("must be a neural map", NeuralMap.load, pickled)
    with pytest.raises(ValueError, match="bins must be a multiple of 64"):
        train(SMALL.replace(bins=200))
    with pytest.raises(ValueError, match="mode"):
        train(SMALL.replace(detector=ml.Detector(dead_time_ns=30.0, mode="paralyzable")))
    refused("steps", Training, steps=0)
    refused("signal", FluxRange, signal=(1.0, 0.5))
