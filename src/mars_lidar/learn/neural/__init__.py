"""A learned map from the flux waveform to the registration PDF, one network per dead time.

A *stand-in* for the baseline of "Ultrafast High-Flux SP-LiDAR Simulator via Neural Mapping" (arXiv 2505.23992), whose
layers, loss and count formula are not public: an autoencoder in the flux's own frame, trained on pairs from the Markov
chain of phases. Needs the extra ``learn``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mars_lidar.learn.neural.model import NeuralMap
    from mars_lidar.learn.neural.pairs import FluxRange
    from mars_lidar.learn.neural.plan import Training
    from mars_lidar.learn.neural.training import train

_MODULES = {"NeuralMap": "model", "FluxRange": "pairs", "Training": "plan", "train": "training"}


def __getattr__(name: str) -> Any:  # PyTorch is loaded by whoever uses it
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"mars_lidar.learn.neural.{_MODULES[name]}"), name)


__all__ = ["FluxRange", "NeuralMap", "Training", "train"]
