"""Depth and signal of images from a few photons a pixel: training of the networks, and the study of the method."""
