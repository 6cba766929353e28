"""Errors of reading and writing files."""

from mars_lidar._base.files import IncompleteFileError, Interrupted, WriteError
from mars_lidar._base.imports import MissingLibraryError

__all__ = ["IncompleteFileError", "Interrupted", "MissingLibraryError", "WriteError"]
