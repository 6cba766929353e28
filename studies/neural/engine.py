"""The neural-mapping baseline: the shape from a trained autoencoder, the count without covariance terms."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import CountLaw, Flux, System
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import Engine
from mars_lidar.engines.engine import Task
from mars_lidar.engines.pixels import Alignment, groups, single_return
from mars_lidar.engines.synthesis import Batch, RoundedGaussian, Run
from mars_lidar.engines.table_reader import as_shapes
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.statistics import photons_per_bin
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.pmf import gaussian_pmf
from studies.neural.model import NeuralMap


class NeuralEngine(Engine):
    """N from a Gaussian law of the right mean, Multinomial(N, pi) with pi from a network; needs the extra ``learn``.

    A stand-in for the baseline of arXiv 2505.23992, "Zhang et al." in the MaRS paper (arXiv 2512.04924): an autoencoder
    for each dead time that maps the flux waveform to the registration PDF. Its layers, its loss and its law of the
    count are not public; this is an autoencoder of our own, trained on the Markov chain of phases, and the count has
    the mean of the renewal argument and the variance of independent holding times, t sigma_ss^2 / mu^3: the covariances
    are missing, and the variance is wrong where a pulse matters. The joint law of the bins is multinomial, as in
    `mars_lidar.engines.MarsEngine`. It goes into ``mars_lidar.simulate(engine=NeuralEngine())``.

    Parameters
    ----------
    model
        A `studies.neural.NeuralMap` or the file of one (``python -m studies neural train``). None: the one beside this
        file, for a period of 133.33 ns, dead time 75 ns, 1024 bins and a Gaussian pulse of 0.5 ns.
    level
        Forces one of ``_core.levels()`` (vector widths); it changes speed only.
    """

    name = "neural"
    description = "a trained network's shape, a count without covariances: a baseline, for the system trained for"
    any_system = False

    def __init__(self, model: NeuralMap | str | Path | None = None, *, level: str = "") -> None:
        self._given = model
        self.level = level

    @cached_property
    def model(self) -> NeuralMap:
        """The map, read when first asked for."""
        if self._given is None:
            return NeuralMap.example()
        return self._given if isinstance(self._given, NeuralMap) else NeuralMap.load(self._given)

    @property
    def settings(self) -> dict[str, Any]:
        """Hash of the weights, and the total variation that the training reached."""
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
                cells, cell, alignment = group.cells, group.cell, None
                pdf, mean, variance = self._moments(cells)
                laws = RoundedGaussian(mean[cell], variance[cell])
                if single is not None:
                    light, rate = (cells.signal[cell], cells.background[cell]), mean[cell] / task.system.cycles
                    alignment = Alignment.of(task.system, *light, single[1][group.pixels], rate)
            run.draw(Batch.unmixed(group.pixels, as_shapes(pdf), cell, laws, alignment))

    def registration_pdf(self, flux: Flux, system: System) -> FloatArray:
        """PDFs (..., bins) by the network, in place of the chain's (`mars_lidar.registration_pdf`)."""
        cells = _cells(flux, system)
        return self._moments(cells)[0].reshape(*cells.shape, system.bins)

    def count_law(self, flux: Flux, system: System) -> CountLaw:
        """The Gaussian count law of this engine, for pixels (...)."""
        cells = _cells(flux, system)
        _, mean, variance = self._moments(cells)
        cumulants = np.zeros((*cells.shape, 4))
        cumulants[..., 0], cumulants[..., 1] = mean.reshape(cells.shape), variance.reshape(cells.shape)
        moments = list(zip(mean, variance, strict=True))
        return CountLaw(system, self.name, cumulants, lambda: [gaussian_pmf(float(m), float(v)) for m, v in moments])

    def _moments(self, cells: Cells) -> tuple[FloatArray, FloatArray, FloatArray]:
        """PDFs (cells, bins), means and variances (cells,): uniform, 0 and 0 where there is no light."""
        system, model = cells.system, self.model
        model.check(system)
        model.check_range(cells.signal, cells.background)
        flux = np.empty((cells.size, system.bins))
        for k in range(cells.size):
            flux[k] = photons_per_bin(cells.flux(k), system, bins=system.bins)
        pdf = np.full(flux.shape, 1.0 / system.bins)
        mean, variance = np.zeros(cells.size), np.zeros(cells.size)
        lit = cells.signal > 0.0  # a constant flux has a uniform PDF: nothing to ask a network for
        pdf[lit] = model.pdf(flux[lit])
        some = cells.signal + cells.background > 0.0
        mean[some], variance[some] = model.moments(flux[some], pdf[some], system.cycles)
        return pdf, mean, variance


def _cells(flux: Flux, system: System) -> Cells:
    effects = LIGHT_EFFECTS + TIMING_EFFECTS  # the network refuses those that it was not trained for, by their fields
    return Cells.of_flux(flux, system, what="the neural map", effects=effects)
