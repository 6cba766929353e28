"""T5 of the MaRS paper: networks trained on every simulator's data; it needs PyTorch, the extra ``learn``."""

from importlib.util import find_spec

from mars_lidar._base.optional import MissingLibraryError

if find_spec("torch") is None:
    raise MissingLibraryError("study 'downstream' needs PyTorch: pip install 'mars-lidar[learn]'")
