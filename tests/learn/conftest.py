"""Everything here has PyTorch on one thread."""

from __future__ import annotations

import pytest


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
