"""The likelihood of histograms against the exact mean histogram and against simulation: random instruments and light.

At the exact mean histogram (`mars_lidar.statistics.mean_histogram`, which shares no code with the likelihood) the score
at the true light must vanish. What remains, times the inverse curvature, is the bias of the estimate.
"""

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar._base.native import _core
from mars_lidar.learn import histogram_log_likelihood
from mars_lidar.learn.likelihood import _plan

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # torch's own forward mode calls it
LIGHT_M_PER_NS = 0.299792458 / 2.0


@dataclass(frozen=True)
class Case:
    system: ml.System
    light: tuple[float, float, float]  # S, B, delay in ns

    @property
    def bound(self) -> np.ndarray:
        bound = ml.cramer_rao(ml.Flux(*self.light), self.system)
        return np.array([float(bound.signal), float(bound.background), float(bound.depth_m) / LIGHT_M_PER_NS])


def drawn(number: int) -> Case:
    """Bins of 0.2 to 3 sigma; a quarter each: dead times to 1 and 3 periods, near whole periods, and very short."""
    random = np.random.default_rng([36, number])
    bins = int(random.choice([16, 32, 64, 128, 256]))
    sigma = 100.0 / bins / np.exp(random.uniform(np.log(0.2), np.log(3.0)))
    dead = (
        random.uniform(0.0, 100.0),
        random.uniform(0.0, 300.0),
        abs(100.0 * random.integers(0, 3) + 3.0 * sigma * random.normal()),
        np.exp(random.uniform(np.log(0.01), np.log(100.0))),
    )[number % 4]
    system = make_system(dead, 1000, bins, sigma_ns=sigma, start="stationary" if random.random() < 0.5 else "armed")
    signal, background = (np.exp(random.uniform(*np.log(ends))) for ends in ((0.1, 10.0), (0.05, 5.0)))
    return Case(system, (float(signal), float(background), float(random.uniform(0.0, 100.0))))


def bias(case: Case) -> np.ndarray:
    """Of S, B and the delay, at the exact mean histogram, in standard deviations of the bound."""
    mean = ml.statistics.mean_histogram(ml.Flux(*case.light), case.system, tolerance=1e-6)
    counts = torch.from_numpy(np.asarray(mean).reshape(-1))
    at = torch.tensor(case.light, dtype=torch.float64)

    def value(x: torch.Tensor) -> torch.Tensor:
        return histogram_log_likelihood(counts, x[0], x[1], x[2], case.system)

    score = torch.func.grad(value)(at)
    curvature = -torch.func.jacrev(torch.func.grad(value))(at)
    return (torch.linalg.solve(curvature, score)).numpy() / case.bound


def scores(case: Case, exposures: int, seed: int) -> np.ndarray:
    """Score (exposures, 3) of simulated exposures at the true light."""
    cube = ml.simulate(ml.Flux(*case.light), case.system, realizations=exposures, seed=seed, threads=1)
    counts = torch.from_numpy(cube.reshape(exposures, -1).astype(float))
    at = torch.tensor([case.light] * exposures, dtype=torch.float64, requires_grad=True)
    value = histogram_log_likelihood(counts, at[:, 0], at[:, 1], at[:, 2], case.system)
    return torch.autograd.grad(value.sum(), at)[0].numpy()


WARNS = "less than one pass of the pulse is expected to end without a registration"


def end_matters(case: Case) -> bool:
    """Whether it matters which registrations the ends of the exposure cut off, which a histogram does not say.

    So where registrations blind more than a period, if less than one pass of the pulse ends without, or if the pixel is
    armed for less than two dead times.
    """
    passes = float(ml.mean_histogram(ml.Flux(*case.light), case.system).sum())  # no more than registrations and these
    dead = case.system.dead_time_periods
    armed = case.system.cycles - passes * dead
    return dead > 1.0 and (passes * np.exp(-case.light[0]) < 1.0 or armed < 2.0 * dead)


@pytest.mark.nightly
@pytest.mark.parametrize("first", [k + part for k in (0, 1000, 2000) for part in range(0, 200, 20)])
def test_bias_of_random_systems(first):
    """The settings were chosen with the first 200; the others were drawn afterwards."""
    for number in range(first, first + 20):
        case = drawn(number)
        if end_matters(case):
            with pytest.warns(UserWarning, match=WARNS):
                bias(case)
        else:
            worst = float(np.abs(bias(case)).max())
            assert worst < 0.1, (number, case, worst)


def test_a_bias_at_the_end_is_warned_of():
    """0.42 standard deviations, as the docstring says."""
    with pytest.warns(UserWarning, match=WARNS):
        assert 0.3 < np.abs(bias(drawn(1069))).max() < 0.5


@pytest.mark.parametrize(
    ("start", "dead", "light", "least"),
    [
        ("stationary", 924.0, (9.4, 1.2, 40.3), 0.5),  # no pass of the pulse is left
        ("armed", 1387.0, (2.0, 3.6, 40.3), 0.5),  # armed for about one dead time
        ("armed", 1387.0, (0.5, 0.6, 40.3), 0.0),  # for four, and no warning
    ],
)
def test_ends_that_matter_are_warned_of(start, dead, light, least):
    """Mean score of 500 exposures, in standard deviations of the bound: within 5 standard errors of 0, or far off."""
    case = Case(make_system(dead, 1000, 32, sigma_ns=2.5, start=start), light)
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        score = scores(case, 500, 3) * case.bound
    assert bool([w for w in given if WARNS in str(w.message)]) == (least > 0.0)
    off = np.abs(score.mean(0))
    assert off.max() > least
    if least == 0.0:
        assert (off < 5.0 * score.std(0) / 500**0.5).all(), off


@pytest.mark.parametrize("level", _core.levels())
def test_vectors_agree_to_the_bit(level):
    """Pixels beside others, at every level, as each alone at the narrowest."""
    case = drawn(149)
    random = np.random.default_rng(1)
    light = np.stack([random.uniform(*ends, 37) for ends in ((0.1, 5.0), (0.1, 2.0), (0.0, 1.0))], -1)
    counts = random.poisson(20.0, (37, case.system.bins)).astype(float)
    together = np.empty((37, 4))
    _core.coarse_likelihood(_plan(case.system), counts, light, together, level=level, threads=1)
    for pixel in range(37):
        alone, rows = np.empty((1, 4)), slice(pixel, pixel + 1)
        args = (counts[rows], light[rows], alone)
        _core.coarse_likelihood(_plan(case.system), *args, level=_core.levels()[-1], threads=1)
        np.testing.assert_array_equal(alone[0], together[pixel])


@pytest.mark.parametrize("number", [12, 149, 203, 390, 1033, 1150])
def test_bias_of_the_worst_of_600_systems(number):
    """Bins of 2 sigma after three dead times, dead times within a cell, a nearly locked pixel, and others."""
    assert np.abs(bias(drawn(number))).max() < 0.06


@pytest.mark.full
@pytest.mark.parametrize(
    ("bins", "sigma", "dead", "light"),
    [
        (64, 1.5, 75.0, (3.0, 1.0, 40.3)),  # with the pulse as wide as a bin: -1.8 by armed times of whole bins
        (64, 0.52, 75.0, (6.4, 0.5, 41.0)),  # a third of a bin: -40
        (64, 1.5, 99.0, (6.4, 0.5, 40.3)),  # re-armed within the pulse of the next period
        (64, 3.0, 6.0, (10.0, 0.5, 41.0)),  # within the same pulse
    ],
)
def test_bias_of_simulated_exposures(bins, sigma, dead, light):
    """Mean of 2,000 one-step estimates from the truth; 0.1 and 4 standard errors (false alarm 2e-4 a case)."""
    exposures = 2000
    score = scores(Case(make_system(dead, 1000, bins, sigma_ns=sigma), light), exposures, 2)
    inverse = np.linalg.inv(np.cov(score.T))  # the information, estimated by the scatter of the score
    off = (score @ inverse).mean(0) / np.sqrt(inverse.diagonal())
    assert (np.abs(off) < 0.1 + 4.0 / exposures**0.5).all(), off


@pytest.mark.full
def test_the_fit_of_the_page_ends_where_reconstruct_does():
    """64 x 64 pixels of 64 bins by Newton's method on the gradient: the page's own assertions, half an error."""
    text = (Path(__file__).parents[2] / "docs" / "learn.md").read_text()
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "def log_likelihood" in block)
    assert code.count("\nassert ") == 3
    exec(code, {"torch": torch, "ml": ml, "histogram_log_likelihood": histogram_log_likelihood})


@pytest.mark.full
@pytest.mark.parametrize(("sigma", "dead"), [(3.0, 42.3), (1.7, 42.3), (4.0, 97.0), (4.0, 0.7), (4.0, 103.0)])
def test_gradient_in_bins_that_are_cut(sigma, dead):
    """Of 5 ns: beside differences, to 1e-6 of the largest; and what is refused."""
    system = make_system(dead, 500, 20, sigma_ns=sigma)
    counts = torch.from_numpy(ml.simulate(ml.Flux([[2.0]], 0.5, 40.0), system, seed=1).reshape(-1).astype(float))
    at = torch.tensor([1.8, 0.6, 40.7], dtype=torch.float64)

    def value(x: torch.Tensor) -> torch.Tensor:
        return histogram_log_likelihood(counts, x[0], x[1], x[2], system)

    steps = 1e-4 * torch.eye(3, dtype=torch.float64)
    central = torch.stack(
        [(8 * (value(at + h) - value(at - h)) - value(at + 2 * h) + value(at - 2 * h)) / 12e-4 for h in steps]
    )
    for mode in (torch.func.grad, torch.func.jacrev, torch.func.jacfwd):
        slope = mode(value)(at)
        assert float((slope - central).abs().max()) < 1e-6 * float(central.abs().max())
    refused("first and second derivatives only", torch.func.jacrev(torch.func.hessian(value)), at)
    refused("forward mode within forward mode", torch.func.jacfwd(torch.func.jacfwd(value)), at)
    with pytest.raises(ValueError, match="no derivatives with respect to the histogram"):
        histogram_log_likelihood(counts.requires_grad_(), at[0], at[1], at[2], system)
