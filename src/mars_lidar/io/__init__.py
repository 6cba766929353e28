"""Files: histogram cubes with everything needed to simulate them again.

Every library is imported when its format is first used.
"""

from mars_lidar._base.files import IncompleteFileError, Interrupted, WriteError
from mars_lidar._base.imports import MissingLibraryError
from mars_lidar.io import maps as maps
from mars_lidar.io.capture import save_capture
from mars_lidar.io.cloud import points, save_cloud
from mars_lidar.io.conversion import Converted, convert, photons
from mars_lidar.io.cube import SUFFIXES, Cube, load, save, to_xarray
from mars_lidar.io.foreign import foreign_cube
from mars_lidar.io.mat import save_mat
from mars_lidar.io.measured import from_histograms, from_photon_times
from mars_lidar.io.recipe import Recipe, Recording
from mars_lidar.io.scene_files import Problem, SceneFile, scan
from mars_lidar.io.simulated_file import Written, regenerate, simulate_to, verify
from mars_lidar.io.transient import read_transient
from mars_lidar.light.transient import Transient

__all__ = [
    "SUFFIXES",
    "Converted",
    "Cube",
    "IncompleteFileError",
    "Interrupted",
    "MissingLibraryError",
    "Problem",
    "Recipe",
    "Recording",
    "SceneFile",
    "Transient",
    "WriteError",
    "Written",
    "convert",
    "foreign_cube",
    "from_histograms",
    "from_photon_times",
    "load",
    "photons",
    "points",
    "read_transient",
    "regenerate",
    "save",
    "save_capture",
    "save_cloud",
    "save_mat",
    "scan",
    "simulate_to",
    "to_xarray",
    "verify",
]
