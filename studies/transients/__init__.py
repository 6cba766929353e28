"""Two returns in fog through the dead time of three detectors."""
