"""Photon streams on disk: files of mars-lidar, Photon-HDF5, PicoQuant PTU, and bare arrays."""
