"""Bias and error of depth and signal beside the Cramer-Rao bound."""
