"""Everything here is of the full tier, has PyTorch on one thread, and is left out where there is none."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    return True if collection_path.name.startswith("test_") and find_spec("torch") is None else None


def pytest_itemcollected(item: pytest.Item) -> None:
    if HERE in item.path.parents:
        item.add_marker(pytest.mark.full)


@pytest.fixture(autouse=True)
def _one_thread(one_torch_thread: None) -> None:
    pass


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
