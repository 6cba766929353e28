"""Files: histogram cubes with everything that is needed to make them again.

Every library is imported when its format is first used.
"""

from mars_lidar.io.convert import Converted, convert, photons
from mars_lidar.io.cube import SUFFIXES, Cube, load, save
from mars_lidar.io.optional import MissingLibraryError
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.store import IncompleteFileError
from mars_lidar.io.stream import Interrupted, WriteError, Written, regenerate, simulate_to, verify

__all__ = [
    "SUFFIXES",
    "Converted",
    "Cube",
    "IncompleteFileError",
    "Interrupted",
    "MissingLibraryError",
    "Recipe",
    "WriteError",
    "Written",
    "convert",
    "load",
    "photons",
    "regenerate",
    "save",
    "simulate_to",
    "verify",
]
