"""A trained map: weights, the system and fluxes that they are for, and the statistics that follow from a PDF."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mars_lidar import System
from mars_lidar._base import files
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import PhaseChain
from mars_lidar.statistics.renewal import row_moments
from studies.neural.network import PdfAutoencoder, canonical, one_thread, rolled
from studies.neural.pairs import FluxRange

_FORMAT = 1
_BATCH = 32  # always filled up to: the answer to a flux must not depend on what else is asked
_TOLERANCE = 1e-9  # relative, of the range of fluxes
# what the stationary chain depends on; any number of cycles, and any start, is served
_FIELDS = ("period_ns", "bins", "pulse", "detector")


@dataclass(frozen=True, eq=False)
class NeuralMap:
    """Flux waveform to registration PDF, for one system.

    Attributes
    ----------
    system
        What it was trained for; `cycles` and `start` do not matter.
    fluxes
        The range of fluxes it was trained on, outside of which it refuses.
    network
        The autoencoder, for evaluation.
    record
        What the training found: steps, seconds, total variations on held-out fluxes.
    """

    system: System
    fluxes: FluxRange
    network: PdfAutoencoder
    record: dict[str, Any]

    @cached_property
    def digest(self) -> str:
        """Hash of the weights, which names them in the file of a cube."""
        digest = blake2b(digest_size=16)
        for name, value in self.network.state_dict().items():
            digest.update(name.encode() + value.cpu().numpy().tobytes())
        return digest.hexdigest()

    def check(self, system: System) -> None:
        """Raise ValueError, naming the field, unless `system` is the one trained for, but for cycles and start."""
        ours, theirs = self.system.to_dict(), system.detected().to_dict()
        for name in _FIELDS:
            if ours[name] == theirs[name]:
                continue
            if name == "detector":
                name = next(key for key in ours[name] if ours[name][key] != theirs["detector"].get(key))
                ours, theirs = ours["detector"], theirs["detector"]
            raise ValueError(
                f"engine 'neural' draws only the system it was trained for: {name} is {theirs[name]}, trained for "
                f"{ours[name]}; train another (python -m studies neural train) and give it: NeuralEngine(file)"
            )

    def check_range(self, signal: FloatArray, background: FloatArray) -> None:
        """Raise ValueError where detected photons per period (pixels,) lie outside of the range of the training."""
        (_, most), (least, highest) = self.fluxes.signal, self.fluxes.background
        edge = 1.0 + _TOLERANCE
        lit = signal > 0.0
        for name, photons, low, high in (
            ("signal", signal, 0.0, most),
            ("background", background[lit], least, highest),
        ):
            out = (photons < low / edge) | (photons > high * edge)
            if out.any():
                raise ValueError(
                    f"engine 'neural' was trained on a {name} of {low:g} to {high:g} photons per period, got "
                    f"{photons[out].min():.4g} to {photons[out].max():.4g} in {int(out.sum())} of {out.size} pixels; "
                    "train on that range (studies.neural.train), or use another engine"
                )

    def pdf(self, photons: FloatArray) -> FloatArray:
        """Registration PDFs (P, bins) of fluxes (P, bins), photons per bin and period, each with some light."""
        out = np.empty(photons.shape)
        with one_thread(), torch.inference_mode():
            for first in range(0, len(photons), _BATCH):
                some = photons[first : first + _BATCH]
                filled = np.concatenate([some, np.repeat(some[:1], _BATCH - len(some), axis=0)])
                flux, shift = canonical(torch.from_numpy(filled).to(torch.float32))
                result = rolled(self.network(flux), -shift).to(torch.float64).exp().numpy()[: len(some)]
                out[first : first + _BATCH] = result / result.sum(-1, keepdims=True)
        return out

    def moments(self, photons: FloatArray, pdf: FloatArray, cycles: int) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (P,) of the count of an exposure, from fluxes and their PDFs (P, bins).

        Mean t / mu and variance t sigma_ss^2 / mu^3, with mu and sigma_ss^2 the mean and variance of *one* holding
        time after a registration distributed as the PDF (docs/theory.md, 3.5): successive holding times are taken to
        be independent, the covariance terms of (3.10) are left out.
        """
        mean, variance = np.empty(len(photons)), np.empty(len(photons))
        for k, (flux, pi) in enumerate(zip(photons, pdf, strict=True)):
            wait, spread = row_moments(PhaseChain(flux, self.system.dead_time_periods))
            mu = float(pi @ wait)
            mean[k] = cycles / mu
            variance[k] = cycles * float(pi @ (spread + (wait - mu) ** 2)) / mu**3
        return mean, variance

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write an ``.npz`` of weights (float32) and one line of JSON: no code, nothing pickled."""
        target = check_target(path, overwrite)
        header = {
            "format": _FORMAT,
            "system": self.system.to_dict(),
            "fluxes": self.fluxes.to_dict(),
            "width": self.network.width,
            "code": self.network.code,
            "record": self.record,
        }
        weights = {name: value.cpu().numpy() for name, value in self.network.state_dict().items()}
        with files.beside(target) as unfinished, unfinished.open("wb") as file:
            np.savez_compressed(file, header=np.array(json.dumps(header)), **weights)

    @classmethod
    def load(cls, path: str | Path) -> NeuralMap:
        """Read what `save` wrote; ValueError names the file where it is none."""
        source = Path(path)
        if not source.is_file():
            raise FileNotFoundError(f"{source}: there is no such file of a neural map")
        if not zipfile.is_zipfile(source):
            raise ValueError(f"{source} must be a neural map (python -m studies neural train writes one)")
        try:
            with source.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                header = json.loads(str(stored["header"]))
                weights = {name: torch.from_numpy(stored[name]) for name in stored.files if name != "header"}
            if header["format"] != _FORMAT:
                raise ValueError(f"format {header['format']}, this version reads {_FORMAT}")
            system = System.from_dict(header["system"])
            network = PdfAutoencoder(system.bins, system.dead_time_periods, header["width"], header["code"])
            network.load_state_dict(weights)
            fluxes = FluxRange(**header["fluxes"])
        except Exception as error:  # a damaged archive fails in many ways
            raise ValueError(f"{source} must be a neural map (python -m studies neural train): {error}") from error
        network.eval().requires_grad_(False)
        return cls(system, fluxes, network, header["record"])

    @staticmethod
    @lru_cache(maxsize=1)
    def example() -> NeuralMap:
        """The network of this folder: period 133.33 ns, dead time 75 ns, 1024 bins, pulse of sigma 0.5 ns."""
        return NeuralMap.load(Path(__file__).with_name("example.npz"))


def check_target(path: str | Path, overwrite: bool) -> Path:
    """The file to write, checked before any work."""
    target = Path(path)
    if target.suffix != ".npz":
        raise ValueError(f"path must end in .npz, got {str(path)!r}")
    files.check_target(target, folder=False, overwrite=overwrite)
    return target
