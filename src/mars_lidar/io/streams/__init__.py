"""Streams of photons on disk: our own files, Photon-HDF5, PicoQuant PTU, and bare arrays."""
