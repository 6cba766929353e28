"""The neural-mapping baseline: the shape from a trained autoencoder, the count without covariance terms."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mars_lidar.engines.alignment import Alignment
from mars_lidar.engines.count_shape import normalised
from mars_lidar.engines.counts import RoundedGaussian
from mars_lidar.engines.engine import Engine, Task
from mars_lidar.engines.pixels import Group, groups, single_return
from mars_lidar.engines.synthesis import Batch, Run
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

if TYPE_CHECKING:
    from mars_lidar.learn.neural import NeuralMap
    from mars_lidar.statistics.cells import Cells

FloatArray = NDArray[np.float64]


class NeuralEngine(Engine):
    """N from a Gaussian law of the right mean, Multinomial(N, pi) with pi from a network; needs the extra ``learn``.

    A stand-in for the baseline of arXiv 2505.23992, "Zhang et al." in the MaRS paper (arXiv 2512.04924): an autoencoder
    for each dead time that maps the flux waveform to the registration PDF. Its layers, its loss and its law of the
    count are not public; this is an autoencoder of our own, trained on the Markov chain of phases, and the count has
    the mean of the renewal argument and the variance of independent holding times, t sigma_ss^2 / mu^3: the covariances
    are missing, and the variance is wrong where a pulse matters. The joint law of the bins is multinomial, as in
    `MarsEngine`.

    Parameters
    ----------
    model
        A `mars_lidar.learn.neural.NeuralMap` or the file of one (``mars-lidar neural train``). None: the one that comes
        with the package, for a period of 133.33 ns, dead time 75 ns, 1024 bins and a Gaussian pulse of 0.5 ns.
    level
        Forces one of ``_core.levels()`` (vector widths); it changes speed only.
    """

    name = "neural"
    description = "a trained network's shape, a count without covariances: a baseline, for the system trained for"
    options: ClassVar[tuple[str, ...]] = ("model",)
    any_system = False

    def __init__(self, model: NeuralMap | str | Path | None = None, *, level: str = "") -> None:
        self._model: Any = model
        self.level = level

    @property
    def model(self) -> NeuralMap:
        """The map, read when first asked for."""
        from mars_lidar.learn.neural.model import NeuralMap

        if self._model is None:
            self._model = NeuralMap.example()
        elif not isinstance(self._model, NeuralMap):
            self._model = NeuralMap.load(self._model)
        found: NeuralMap = self._model
        return found

    @property
    def settings(self) -> dict[str, Any]:
        """Hash of the weights, and what the training found."""
        return {"model": self.model.digest, "tv_mean": self.model.record["tv_mean"]}

    def check(self, flux: Flux, system: System) -> None:
        """The system is that of the training, and every pixel has returns within its range."""
        model = self.model
        model.check(system)
        if flux.waveform is not None:
            raise ValueError("engine 'neural' was trained on returns of the system's pulse, not on a flux waveform")
        returns = int((flux.returns_signal > 0).sum(0).max(initial=0))
        if returns > model.fluxes.returns:
            raise ValueError(f"engine 'neural' was trained on {model.fluxes.returns} returns a pixel, got {returns}")
        flux = flux.detected(system)
        model.check_range(flux.signal.reshape(-1), flux.background.reshape(-1))

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """The network's answer to each distinct pixel; one return is asked for at the canonical delay and moved."""
        run = Run(task, out, self.level)
        single = single_return(task.flux)
        for group in groups(task.flux, task.system, np.arange(task.pixel_index.size), delays=single is None):
            with run.stage("evaluation_s"):
                batch = self._batch(run, group, None if single is None else single[1])
            run.draw(batch)

    def of_cells(self, cells: Cells) -> tuple[FloatArray, FloatArray, FloatArray]:
        """PDFs (cells, bins), means and variances (cells,): uniform, 0 and 0 where there is no light."""
        from mars_lidar.statistics.grid import photons_per_bin
        from mars_lidar.statistics.methods import pixel_of

        system, model = cells.system, self.model
        model.check(system)
        model.check_range(cells.signal, cells.background)
        flux = np.empty((cells.size, system.bins))
        for k in range(cells.size):
            signal, waveform, delay = pixel_of(cells, k)
            back = float(cells.background[k])
            flux[k] = photons_per_bin(signal, back, system, bins=system.bins, delay_ns=delay, waveform=waveform)
        pdf = np.full(flux.shape, 1.0 / system.bins)
        mean, variance = np.zeros(cells.size), np.zeros(cells.size)
        lit = cells.signal > 0.0  # a constant flux has a uniform PDF: nothing to ask a network for
        pdf[lit] = model.pdf(flux[lit])
        some = cells.signal + cells.background > 0.0
        mean[some], variance[some] = model.moments(flux[some], pdf[some], system.cycles)
        return pdf, mean, variance

    def _batch(self, run: Run, group: Group, delay: FloatArray | None) -> Batch:
        system, cells, cell = run.task.system, group.cells, group.cell
        pdf, mean, variance = self.of_cells(cells)
        laws, alignment = RoundedGaussian(mean[cell], variance[cell]), None
        if delay is not None:
            signal, background = cells.signal[cell], cells.background[cell]
            rate = mean[cell] / system.cycles
            alignment = Alignment.of(system, signal, background, delay[group.pixels], rate)
        return Batch.unmixed(group.pixels, normalised(pdf), cell, laws, alignment)
