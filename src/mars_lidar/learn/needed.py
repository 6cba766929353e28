"""Import of PyTorch, or an error that states how to install it; all of `mars_lidar.learn` but the ranges needs it."""

from mars_lidar._base.imports import MissingLibraryError

try:
    import torch as torch
    import torch.utils.data as _data  # noqa: F401
except ImportError as _error:
    raise MissingLibraryError(f"mars_lidar.learn needs PyTorch: pip install 'mars-lidar[learn]' ({_error})") from _error
