"""A single-photon LiDAR as a physics operator of deepinv (https://deepinv.github.io), for its inverse problems."""

from __future__ import annotations

from typing import Any

from mars_lidar._base.optional import MissingLibraryError

try:
    import torch
    from deepinv.physics import Physics
except ImportError as _error:
    raise MissingLibraryError(
        f"mars_lidar.learn.LidarPhysics needs PyTorch and deepinv: pip install 'mars-lidar[learn]' deepinv ({_error})"
    ) from _error

from mars_lidar._base import checks
from mars_lidar.engines import Engine, find_engine
from mars_lidar.instrument.system import System
from mars_lidar.learn.forward import expected_histogram
from mars_lidar.learn.light import check_detector
from mars_lidar.learn.tabulated import HistogramTable
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruct.reconstruction import reconstruct
from mars_lidar.simulate import simulate
from mars_lidar.table import Table


class LidarPhysics(Physics):  # type: ignore[misc]  # deepinv is not typed
    """Histograms (B, bins, H, W) of images (B, 3, H, W), whose channels are signal, background and delay (ns).

    ``A(x)`` is the expected histogram, ``A_vjp`` the product with its Jacobian that deepinv's data fidelities ask for,
    ``A_dagger(y)`` the estimate of each pixel by itself, from which to start. ``physics(x)`` is a measured histogram:
    drawn by the engine, for the noise of histograms under dead time is no function of their mean. The first call draws
    with `seed`, the next with ``seed + 1``, and so on. Signal and background must stay >= 0: project onto that between
    steps.

    Parameters
    ----------
    system
        As for `mars_lidar.learn.expected_histogram`.
    table
        A `mars_lidar.Table` of it: ``A`` is then a `mars_lidar.learn.HistogramTable`, some 30 times as fast.
    engine
        As for `mars_lidar.simulate`.
    seed
        Integer in [0, 2**63).
    threads
        As for `mars_lidar.simulate`.
    """

    def __init__(
        self,
        system: System,
        *,
        table: Table | None = None,
        engine: str | Engine = "exact",
        seed: int = 0,
        threads: int | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(system, System):
            raise TypeError(f"system must be a System, got {type(system).__name__}")
        check_detector(system)
        if table is not None and table.system.replace(cycles=system.cycles) != system:
            raise ValueError(f"table must be of this system, got one of {table.system}")
        self.system, self._engine, self._threads = system, find_engine(engine), threads
        self._table = None if table is None else HistogramTable(table, cycles=system.cycles)
        self._seed = checks.integer("seed", seed, low=0, high=2**63 - 1)

    def A(self, x: torch.Tensor, **kwargs: Any) -> torch.Tensor:
        """Expected histograms."""
        _check(x)
        maps = x[:, 0], x[:, 1], x[:, 2]
        mean = expected_histogram(*maps, self.system) if self._table is None else self._table(*maps)
        return mean.permute(0, 3, 1, 2)

    def A_vjp(self, x: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """``(dA/dx)' v`` (B, 3, H, W), by autograd: deepinv's own takes functions that torch.func can transform."""
        with torch.enable_grad():
            at = x.detach().requires_grad_()
            return torch.autograd.grad(self.A(at), at, v)[0]

    def A_dagger(self, y: torch.Tensor, x_init: torch.Tensor | None = None) -> torch.Tensor:
        """Maximum likelihood of every pixel by itself (B, 3, H, W), by `mars_lidar.reconstruct`; `x_init` is not used.

        Where a pixel shows no return its signal is 0 and its delay half a period.
        """
        cubes = y.detach().cpu().double().permute(0, 2, 3, 1).contiguous().numpy()
        found = reconstruct(cubes, self.system, threads=self._threads)
        maps = [
            torch.from_numpy(one).nan_to_num(fill)
            for one, fill in (
                (found.signal, 0.0),
                (found.background, 0.0),
                (found.delay_ns, 0.5 * self.system.period_ns),
            )
        ]
        return torch.stack(maps, 1).to(y)

    def forward(self, x: torch.Tensor, **kwargs: Any) -> torch.Tensor:
        """Measured histograms, in the type of `x`; no gradient passes through them."""
        _check(x)
        images = x.detach().cpu().double().numpy()
        drawn = [
            simulate(
                Flux(*image),
                self.system,
                engine=self._engine,
                seed=self._seed,
                realizations=1,
                first_realization=number,
                threads=self._threads,
            )[0]
            for number, image in enumerate(images)
        ]
        self._seed += 1
        out = torch.stack([torch.from_numpy(cube.astype("float64")) for cube in drawn])
        return out.permute(0, 3, 1, 2).to(x)


def _check(x: Any) -> None:
    if not isinstance(x, torch.Tensor) or x.ndim != 4 or x.shape[1] != 3:
        told = getattr(x, "shape", x)
        raise ValueError(f"x must be a tensor (B, 3, H, W) of signal, background and delay in ns, got {told!r}")
