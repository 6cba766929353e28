"""Training: streams and datasets for PyTorch, histograms and likelihoods that have gradients, inverse problems.

Needs the extra ``learn``: pip install 'mars-lidar[learn]'.
"""

import lazy_loader

__getattr__, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = [name for name in _names if not name.startswith("Lidar")]  # `import *` would ask for deepinv
