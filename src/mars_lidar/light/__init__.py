"""Light at the detector: photon rates of every pixel, and registered photons."""
