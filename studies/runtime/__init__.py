"""Stages of a cube, runtime along four axes, size of the table (T2, T3)."""
