"""Shared fixtures, and the account of the statistical checks at the end of a run."""

import gc
import os
from collections.abc import Iterator
from typing import Any

import pytest

if (
    "PYTEST_XDIST_WORKER" in os.environ
):  # before NumPy and PyTorch are imported: other processes have the other processors
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")

from mars_lidar import Flux, System

pytest.register_assert_rewrite("harness")

from harness import ledger, make_system  # noqa: E402  (after the line above, so that its assertions explain themselves)


@pytest.fixture(autouse=True, scope="session")
def tables_of_this_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tables that commands keep go into a folder of the run, not into the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MARS_LIDAR_CACHE", str(tmp_path_factory.mktemp("tables")))
        yield


@pytest.fixture
def system() -> System:
    """The system of the MaRS paper, shortened."""
    return make_system(85.0, 200, 64, sigma_ns=0.5, period_ns=1e3 / 7.5)


@pytest.fixture
def flux() -> Flux:
    """A small image: dim, bright, without signal, without anything."""
    return Flux([[0.5, 3.0, 0.0], [10.0, 0.01, 0.0]], [[0.5, 0.1, 1.0], [2.0, 0.0, 0.0]], [[10, 60, 0], [133, 90, 5]])


@pytest.fixture
def one_torch_thread() -> Iterator[None]:
    """PyTorch on one thread: small tensors, and other tests beside it."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


TIERS = ("fast", "full", "nightly")  # a test without a marker is in the first; CONTRIBUTING.md says what each is for


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--tier", choices=TIERS, default="fast", help="run the tests up to this tier (default: fast)")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """`-n auto`: a process more than there are processors, as tests wait for other processes a fifth of the time."""
    return (os.cpu_count() or 1) + 1


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests of the tiers above the one that `--tier` names; those that take long begin first."""
    above = TIERS[TIERS.index(config.getoption("--tier")) + 1 :]
    deselected = [item for item in items if any(item.get_closest_marker(tier) for tier in above)]
    if deselected:
        config.hook.pytest_deselected(items=deselected)
        items[:] = [item for item in items if item not in set(deselected)]
    items.sort(key=lambda item: -max((mark.kwargs.get("seconds", 0) for mark in item.iter_markers("full")), default=0))


def pytest_collection_finish() -> None:
    """Modules and tests stay to the end: `gc.collect`, which benchmarks call before each turn, may pass over them."""
    gc.freeze()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    lines = ledger.summary()
    if lines:
        terminalreporter.section("statistical checks")
        for line in lines:
            terminalreporter.line(line)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    if hasattr(session.config, "workeroutput"):  # a process of pytest-xdist: its checks count in the one that began it
        session.config.workeroutput["ledger"] = ledger.entries()
    elif ledger.number() * ledger.LEVEL > ledger.FAMILY_LEVEL and exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: object) -> None:
    """Add the statistical checks of a process of pytest-xdist to the account."""
    ledger.add(getattr(node, "workeroutput", {}).get("ledger", ()))


@pytest.fixture(scope="session")
def deepinv():
    """deepinv, also beside a torchvision of another build than PyTorch's (that of PyPI, beside a CPU build).

    There the package's error is looked at first; then the two operators are declared that torchvision misses. deepinv
    calls none of its compiled ones here.
    """
    try:
        import deepinv
    except ImportError as error:
        pytest.skip(f"needs deepinv ({error})")
    except RuntimeError:
        import torch

        with pytest.raises(ImportError, match="torchvision that was built for PyTorch"):
            from mars_lidar.learn import LidarPhysics  # noqa: F401
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor boxes, Tensor scores, float threshold) -> Tensor")
        import deepinv
    return deepinv
