"""A learned map from the flux waveform to the registration PDF, one network per dead time.

A *stand-in* for the baseline of "Ultrafast High-Flux SP-LiDAR Simulator via Neural Mapping" (arXiv 2505.23992), whose
layers, loss and count formula are not public: an autoencoder in the flux's own frame, trained on pairs from the Markov
chain of phases. It needs PyTorch, the extra ``learn``. ``python -m studies neural --help`` trains one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from studies.neural.engine import NeuralEngine
    from studies.neural.model import NeuralMap
    from studies.neural.pairs import FluxRange, Training
    from studies.neural.training import train

_MODULES = {
    "FluxRange": "pairs",
    "NeuralEngine": "engine",
    "NeuralMap": "model",
    "Training": "pairs",
    "train": "training",
}


def __getattr__(name: str) -> Any:  # PyTorch is loaded by whoever uses it
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"studies.neural.{_MODULES[name]}"), name)


__all__ = ["FluxRange", "NeuralEngine", "NeuralMap", "Training", "train"]
