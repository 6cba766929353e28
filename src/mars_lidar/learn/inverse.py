"""A single-photon LiDAR as a physics operator of deepinv (https://deepinv.github.io), for its inverse problems."""

from __future__ import annotations

from typing import Any

from mars_lidar.io.optional import MissingLibraryError

try:
    import torch
    from deepinv.physics import Physics
except ImportError as _error:
    raise MissingLibraryError(
        f"mars_lidar.learn.LidarPhysics needs PyTorch and deepinv: pip install 'mars-lidar[learn]' deepinv ({_error})"
    ) from _error

from mars_lidar import _validate
from mars_lidar.engines import Engine, find_engine
from mars_lidar.flux import Flux
from mars_lidar.learn.forward import expected_histogram
from mars_lidar.simulate import simulate
from mars_lidar.system import System


class LidarPhysics(Physics):  # type: ignore[misc]  # deepinv is not typed
    """Histograms (B, bins, H, W) of images (B, 3, H, W), whose channels are signal, background and delay (ns).

    ``A(x)`` is the expected histogram, differentiable, and ``physics(x)`` a measured one: drawn by the engine, for
    the noise of histograms under dead time is no function of their mean. The first call draws with `seed`, the next
    with ``seed + 1``, and so on.

    Parameters
    ----------
    system
        As for `mars_lidar.learn.expected_histogram`.
    engine
        As for `mars_lidar.simulate`.
    seed
        Integer in [0, 2**63).
    threads
        As for `mars_lidar.simulate`.
    """

    def __init__(
        self, system: System, *, engine: str | Engine = "exact", seed: int = 0, threads: int | None = None
    ) -> None:
        super().__init__()
        if not isinstance(system, System):
            raise TypeError(f"system must be a System, got {type(system).__name__}")
        self.system, self._engine, self._threads = system, find_engine(engine), threads
        self._seed = _validate.integer("seed", seed, low=0, high=2**63 - 1)

    def A(self, x: torch.Tensor, **kwargs: Any) -> torch.Tensor:
        """Expected histograms."""
        _check(x)
        return expected_histogram(x[:, 0], x[:, 1], x[:, 2], self.system).permute(0, 3, 1, 2)

    def forward(self, x: torch.Tensor, **kwargs: Any) -> torch.Tensor:
        """Measured histograms, in the type of `x`; no gradient passes through them."""
        _check(x)
        images = x.detach().cpu().double().numpy()
        drawn = [
            simulate(Flux(*image), self.system, engine=self._engine, seed=self._seed, realizations=1,
                     first_realization=number, threads=self._threads)[0]
            for number, image in enumerate(images)
        ]  # fmt: skip
        self._seed += 1
        out = torch.stack([torch.from_numpy(cube.astype("float64")) for cube in drawn])
        return out.permute(0, 3, 1, 2).to(x)


def _check(x: Any) -> None:
    if not isinstance(x, torch.Tensor) or x.ndim != 4 or x.shape[1] != 3:
        told = getattr(x, "shape", x)
        raise ValueError(f"x must be a tensor (B, 3, H, W) of signal, background and delay in ns, got {told!r}")
