"""Intervals of trained networks as the judge of a simulator; it needs PyTorch, the extra ``learn``."""

from mars_lidar._base.optional import needed

needed("torch", "study 'uncertainty'", "learn")
