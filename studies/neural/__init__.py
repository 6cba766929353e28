"""A learned map from the flux waveform to the registration PDF, one network per dead time.

A *stand-in* for the baseline of "Ultrafast High-Flux SP-LiDAR Simulator via Neural Mapping" (arXiv 2505.23992), whose
layers, loss and count formula are not public: an autoencoder in the flux's own frame, trained on pairs from the Markov
chain of phases. It needs PyTorch, the extra ``learn``. ``python -m studies neural --help`` trains one.
"""

from studies.neural.engine import NeuralEngine
from studies.neural.model import NeuralMap
from studies.neural.pairs import FluxRange, Training
from studies.neural.training import train

__all__ = ["FluxRange", "NeuralEngine", "NeuralMap", "Training", "train"]
