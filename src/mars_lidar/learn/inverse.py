"""A single-photon LiDAR as a physics operator of deepinv (https://deepinv.github.io)."""

from __future__ import annotations

from typing import Any, Literal

from mars_lidar._base.imports import MissingLibraryError

try:
    import torch
    from deepinv.optim import DataFidelity
    from deepinv.optim.potential import Potential
    from deepinv.physics import Physics
except ImportError as _error:
    raise MissingLibraryError(
        f"mars_lidar.learn.LidarPhysics needs PyTorch and deepinv: pip install 'mars-lidar[learn]' deepinv ({_error})"
    ) from _error
except RuntimeError as _error:  # of torchvision, where its operators are not those of this PyTorch
    raise MissingLibraryError(
        f"mars_lidar.learn.LidarPhysics needs deepinv, and deepinv the torchvision that was built for PyTorch "
        f"{torch.__version__}, from the same index ({_error})"
    ) from _error

from mars_lidar._base import checks
from mars_lidar.engines import Engine, find_engine
from mars_lidar.engines.simulation import simulate
from mars_lidar.instrument.system import System
from mars_lidar.learn.forward import check_detector, expected_histogram
from mars_lidar.learn.likelihood import histogram_log_likelihood
from mars_lidar.learn.tabulated import HistogramTable
from mars_lidar.learn.tolerances import TOLERANCES
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction.histogram_record import relative_width
from mars_lidar.reconstruction.reconstruction import reconstruct
from mars_lidar.table import Table


class LidarPhysics(Physics):  # type: ignore[misc]  # deepinv is not typed
    """Operator from images (B, 3, H, W), with channels given by `images`, to histograms (B, bins, H, W).

    ``A(x)`` is the expected histogram, ``A_vjp`` and ``A_jvp`` the products with its Jacobian, ``A_dagger(y)`` the
    estimate of each pixel alone; ``custom_init=LidarPhysics.custom_init`` starts an algorithm of deepinv from it.
    ``physics(x)`` is a histogram drawn by the engine, because the noise of histograms under dead time is not a
    function of their mean. The first call draws with `seed`, the next with ``seed + 1``, and so on; ``physics(x,
    seed=s)`` draws with s. Photons must stay >= 0: project them between steps.

    Parameters
    ----------
    system
        As for `mars_lidar.learn.expected_histogram`.
    table
        A `mars_lidar.Table` of `system`: ``A`` is then a `mars_lidar.learn.HistogramTable`, some 30 times as fast.
    images
        ``"log"``: logarithms of signal and background, photons per period, and the delay over the width of the pulse
        (sigma of a Gaussian): any real numbers are valid, and errors are about 1 / sqrt(photons) in all
        three, as the priors, denoisers and step sizes of deepinv's algorithms assume.
        ``"signal"``: signal and background, photons per period, and the delay, ns. ``"depth"``: those of deepinv's own
        ``SinglePhotonLidar``: depth in bins, an integer in the middle of a bin; intensity, photons of the return in the
        exposure; background, photons of a bin in the exposure. Without dead time both operators have the same mean.
        With these two, photons must stay >= 0, which stock algorithms do not ensure.
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
        images: Literal["log", "signal", "depth"] = "signal",
        engine: str | Engine = "exact",
        seed: int = 0,
        threads: int | None = None,
    ) -> None:
        super().__init__()
        check_detector(system)
        if table is not None and table.system.replace(cycles=system.cycles) != system:
            raise ValueError(f"table must be of this system, got one of {table.system}")
        self.system, self._engine, self._threads = system, find_engine(engine), threads
        self._table = None if table is None else HistogramTable(table, cycles=system.cycles)
        self._images = checks.choice("images", images, ("log", "signal", "depth"))
        self._width_ns = relative_width(system) * system.period_ns
        self._seed = checks.integer("seed", seed, low=0, high=2**63 - 1)

    def A(self, x: torch.Tensor, **kwargs: Any) -> torch.Tensor:
        """Expected histograms."""
        maps = self.light(x)
        mean = expected_histogram(*maps, self.system) if self._table is None else self._table(*maps)
        return mean.permute(0, 3, 1, 2)

    def A_vjp(self, x: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """``(dA/dx)' v`` (B, 3, H, W) of v (B, bins, H, W)."""
        _, pull = torch.func.vjp(self.A, x)[:2]
        moved: torch.Tensor = pull(v)[0]
        return moved

    def A_jvp(self, x: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """``(dA/dx) v`` (B, bins, H, W) of v (B, 3, H, W)."""
        # expanded views have no dual
        whole = (tensor.clone(memory_format=torch.contiguous_format) for tensor in (x, v))
        moved: torch.Tensor = torch.func.jvp(self.A, *((tensor,) for tensor in whole))[1]
        return moved

    @staticmethod
    def custom_init(y: torch.Tensor, physics: LidarPhysics) -> dict[str, Any]:
        """Initial estimate of an algorithm of deepinv: ``physics.A_dagger(y)``, also for its auxiliary variable."""
        start = physics.A_dagger(y)
        return {"est": (start, start.clone())}

    def A_dagger(self, y: torch.Tensor, x_init: torch.Tensor | None = None, **kwargs: Any) -> torch.Tensor:
        """Maximum likelihood of every pixel alone (B, 3, H, W), by `mars_lidar.reconstruct`; `x_init` is not used.

        For a pixel without a detected return the signal is 0 and the delay half a period.
        """
        cubes = y.detach().cpu().double().permute(0, 2, 3, 1).contiguous().numpy()
        estimate = reconstruct(cubes, self.system, threads=self._threads)
        signal, background, delay_ns = (
            torch.from_numpy(values).nan_to_num(fill)
            for values, fill in (
                (estimate.signal, 0.0),
                (estimate.background, 0.0),
                (estimate.delay_ns, 0.5 * self.system.period_ns),
            )
        )
        return self.images(signal, background, delay_ns).to(y)

    def images(self, signal: torch.Tensor, background: torch.Tensor, delay_ns: torch.Tensor) -> torch.Tensor:
        """Images (B, 3, H, W) of light (B, H, W); of logarithms no less than 0.2 photons in the exposure."""
        if self._images == "log":
            least = TOLERANCES.zero_photons / self.system.cycles
            logs = [light.clamp_min(least).log() for light in (signal, background)]
            return torch.stack([*logs, delay_ns / self._width_ns], 1)
        if self._images == "signal":
            return torch.stack([signal, background, delay_ns], 1)
        cycles, bins = self.system.cycles, self.system.bins
        depth = delay_ns / self.system.bin_ns - 0.5
        return torch.stack([depth, signal * cycles, background * (cycles / bins)], 1)

    def forward(self, x: torch.Tensor, seed: int | None = None, **kwargs: Any) -> torch.Tensor:
        """Measured histograms, in the type of `x`; no gradient passes through them.

        `seed`: of this draw only; None: the next seed of the operator.
        """
        own = seed is None
        number = self._seed if seed is None else checks.integer("seed", seed, low=0, high=2**63 - 1)
        images = torch.stack(self.light(x), 1).detach().cpu().double().numpy()
        drawn = [
            simulate(
                Flux(*image),
                self.system,
                engine=self._engine,
                seed=number,
                realizations=1,
                first_realization=place,
                threads=self._threads,
            )[0]
            for place, image in enumerate(images)
        ]
        self._seed += own
        out = torch.stack([torch.from_numpy(cube.astype("float64")) for cube in drawn])
        return out.permute(0, 3, 1, 2).to(x)

    def light(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Signal, background and delay in ns (B, H, W) of images."""
        if not isinstance(x, torch.Tensor) or x.ndim != 4 or x.shape[1] != 3:
            given = getattr(x, "shape", x)
            words = "depth, intensity and background" if self._images == "depth" else "signal, background and delay"
            raise ValueError(f"x must be a tensor (B, 3, H, W) of {words}, got {given!r}")
        first, second, third = x.unbind(1)
        if self._images == "log":
            return first.exp(), second.exp(), third * self._width_ns
        if self._images == "signal":
            return first, second, third
        cycles = self.system.cycles
        return second / cycles, third * (self.system.bins / cycles), (first + 0.5) * self.system.bin_ns


class LidarLikelihood(DataFidelity):  # type: ignore[misc]
    """Negative log likelihood of histograms under dead time, `mars_lidar.learn.histogram_log_likelihood`.

    The data term of an algorithm of deepinv with a `LidarPhysics` of any images; with ``images="log"`` steps need no
    projection.
    """

    grad = Potential.grad  # of `fn`: the base class takes the distance between mean and data for granted

    def fn(self, x: torch.Tensor, y: torch.Tensor, physics: LidarPhysics, *args: Any, **kwargs: Any) -> torch.Tensor:
        """One number for each image (B,)."""
        value = histogram_log_likelihood(y.movedim(1, -1), *physics.light(x), physics.system)
        return -value.sum((1, 2))
