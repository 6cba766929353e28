"""Light at the detector: photon rates of every pixel, and the photons that were registered."""
