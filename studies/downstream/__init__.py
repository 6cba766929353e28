"""T5 of the MaRS paper: networks trained on every simulator's data; it needs PyTorch, the extra ``learn``."""

from mars_lidar._base.imports import needed

needed("torch", "study 'downstream'", "learn")
