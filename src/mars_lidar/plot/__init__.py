"""Figures of histogram cubes and calibrated streams, for screens and papers.

Every figure is a `matplotlib.figure.Figure` and changes no global state of matplotlib: no window opens, no
backend is selected, and figures can be made in any thread. ``figure.savefig(path)`` writes a figure.
"""

from mars_lidar.plot.figures import map_image, overview, pixel_histogram
from mars_lidar.plot.stream import calibration
from mars_lidar.plot.views import count_maps, depth_error_m, example_pixels, incident_rate

__all__ = [
    "calibration",
    "count_maps",
    "depth_error_m",
    "example_pixels",
    "incident_rate",
    "map_image",
    "overview",
    "pixel_histogram",
]
