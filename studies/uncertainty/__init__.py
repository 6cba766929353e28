"""Intervals of trained networks as the judge of a simulator; it needs PyTorch, the extra ``learn``."""

from importlib.util import find_spec

from mars_lidar._base.optional import MissingLibraryError

if find_spec("torch") is None:
    raise MissingLibraryError("study 'uncertainty' needs PyTorch: pip install 'mars-lidar[learn]'")
