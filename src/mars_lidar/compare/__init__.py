"""Engines side by side on one scene: counts, errors and times."""
