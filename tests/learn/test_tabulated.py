"""The differentiable forward model from a table: against the exact mean histogram, and its gradients."""

import numpy as np
import pytest
import torch
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar.learn import HistogramTable

AXES = np.array([0.0, 0.1, 0.98, 1.02, 4.9, 5.1]), np.array([0.0, 0.05, 0.98, 1.02, 2.0])


def build(sigma_ns=0.5, dead_ns=64.0, start="stationary", bins=1024) -> ml.Table:
    system = make_system(dead_ns, 1000, bins, sigma_ns=sigma_ns, start=start)
    return ml.Table.build(system, *AXES, threads=1)


@pytest.fixture(scope="module")
def table() -> ml.Table:
    return build()


def point(*values, dtype=torch.float64):
    return [torch.tensor(value, dtype=dtype, requires_grad=True) for value in values]


@pytest.mark.full
@pytest.mark.parametrize(
    ("sigma_ns", "dead_ns", "start", "bins", "error"),
    [
        (0.5, 64.0, "stationary", 1024, 1e-4),
        (0.5, 0.0, "armed", 1024, 1e-4),
        (0.5, 64.0, "armed", 1024, 1e-3),  # its start-up part stays at the canonical delay (docs/table.md, 4)
        (0.13, 64.0, "stationary", 256, 1e-3),  # a third of a bin: what lies inside is told by the edges alone
    ],
)
def test_it_is_the_exact_mean_histogram(sigma_ns, dead_ns, start, bins, error):
    """At nodes and in small cells, moved to any delay; in float32, total variation."""
    table = build(sigma_ns, dead_ns, start, bins)
    s = np.array([0.1, 1.0, 5.0, 5.0, 0.0, 1.0, 5.02])
    b = np.array([0.05, 1.0, 0.05, 2.0, 1.0, 0.0, 0.99])
    tau = np.array([40.03, 50.0, 99.98, 75.02, 5.0, 0.01, 20.07])
    result = HistogramTable(table)(*point(s, b, tau, dtype=torch.float32)).detach().double().numpy()
    exact = ml.statistics.mean_histogram(ml.Flux(s, b, tau), table.system)
    assert (result >= 0.0).all()
    off = np.abs(result - exact).sum(-1) / 2 / exact.sum(-1)
    assert (off < error).all(), off


@pytest.mark.full
def test_gradients(table):
    """Sums over windows that cut the pulse; all delays, also where a bin's edge meets the canonical one."""
    model = HistogramTable(table).double()
    at = point([0.5, 0.05, 2.0, 3.0], [0.3, 0.3, 0.02, 1.5], [40.0, 1.0, 99.9, 50.0 + 3e-5])

    def windows(*x):
        return model(*x)[:, :1020].reshape(4, 60, 17).sum(-1) / 1000

    assert torch.autograd.gradcheck(windows, at, eps=1e-6, atol=1e-6)


@pytest.mark.full
def test_kinks_at_the_nodes_are_as_small_as_is_said():
    """The spacing of the paper's 256 x 100 table; jumps over what the derivatives are, summed over the bins."""
    system = build(bins=256, sigma_ns=1.0).system
    axes = (10 ** (-0.3 + 3.0 * np.arange(6) / 255), 10 ** (-0.3 + 3.0 * np.arange(6) / 99))
    model = HistogramTable(ml.Table.build(system, *axes, threads=1)).double()
    nodes = [float(axes[0][3]), float(axes[1][2]), (0.5 - 40 / 256) * system.period_ns]
    for place, most in enumerate((0.05, 0.15, 1e-3)):
        others = [torch.tensor([0.999 * x], dtype=torch.float64) for x in nodes]

        def along(x, place=place, others=others):
            return model(*(x if k == place else other for k, other in enumerate(others)))[0]

        below, above = (
            torch.autograd.functional.jacobian(along, torch.tensor([nodes[place] * (1.0 + step)], dtype=torch.float64))
            for step in (-1e-9, 1e-9)
        )
        assert 0.0 < float((above - below).abs().sum() / above.abs().sum()) < most


def test_delay_moves_it_continuously_and_keeps_the_total(table):
    model = HistogramTable(table).double()
    bin_ns = table.system.bin_ns
    near = 33.0 + bin_ns * torch.tensor([1 - 1e-9, 1.0, 1 + 1e-9], dtype=torch.float64)
    delay = torch.cat([torch.linspace(33.0, 33.5, 50).double(), near])
    level = torch.tensor(3.0).double(), torch.tensor(0.5).double()
    single = model(*level, delay)
    torch.testing.assert_close(single.sum(-1), single.sum(-1)[:1].expand(53), rtol=1e-12, atol=0)
    torch.testing.assert_close(single[-3], single[-1], rtol=1e-6, atol=1e-6)
    whole = model(*level, torch.tensor([33.0, 33.0 + 7 * bin_ns, 133.0]).double())
    torch.testing.assert_close(whole[1], torch.roll(whole[0], 7, -1))
    torch.testing.assert_close(whole[2], whole[0])


@pytest.mark.full
def test_it_leads_back_to_the_pixel_of_an_exact_mean(table):
    """From a mean histogram that no table knows, by its gradients alone (L-BFGS), pixel by pixel of a map."""
    true = np.array([[1.0, 0.5, 61.3], [3.0, 1.5, 12.34], [0.5, 0.1, 99.9]])
    single = table.system
    mean = torch.from_numpy(ml.statistics.mean_histogram(ml.Flux(*true.T), single))
    fine = HistogramTable(ml.Table.build(single, (0.2, 5.0, 24), (0.05, 2.0, 16), threads=1)).double()
    x = (torch.from_numpy(true) * torch.tensor([0.8, 1.3, 1.0]) + torch.tensor([0.0, 0.0, 0.4])).requires_grad_()
    optimizer = torch.optim.LBFGS([x], max_iter=60, line_search_fn="strong_wolfe", tolerance_change=1e-12)

    def loss():
        optimizer.zero_grad()
        s, b, tau = x.unbind(-1)
        result = fine(s.clamp(0.0, 5.0), b.clamp(0.0, 2.0), tau)
        value = (result - mean * torch.log(result.clamp_min(1e-12))).sum() / 1000
        value.backward()
        return value

    optimizer.step(loss)
    np.testing.assert_allclose(x.detach()[:, :2], true[:, :2], rtol=2e-2)
    np.testing.assert_allclose(x.detach()[:, 2], true[:, 2], atol=5e-3)


def test_bad_arguments(table):
    model = HistogramTable(table)
    maps = torch.full((2, 3), 0.5), torch.tensor(0.5), torch.tensor(30.0)
    assert model(*maps).shape == (2, 3, 1024)
    assert model(*(values.double() for values in maps)).dtype == torch.float64
    assert model(*(torch.zeros(0) for _ in range(3))).shape == (0, 1024)
    assert "6 x 5 x 1024, 1000 cycles" in repr(model)
    refused(r"signal must lie in the table's \[0, 5.1\] .* got 6 to 6", model, torch.tensor(6.0), *maps[1:])
    refused("delay_ns finite", model, *maps[:2], torch.tensor(float("nan")))
    refused(r"table must be a mars_lidar\.Table", HistogramTable, "table.h5", error=TypeError)
    longer = HistogramTable(table, cycles=5000)
    torch.testing.assert_close(longer(*maps), 5 * model(*maps), rtol=1e-5, atol=1e-6)
