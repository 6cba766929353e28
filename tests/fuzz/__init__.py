"""Mutated files of every format, each read in a process of its own: `python -m tests.fuzz --help` for hours of it."""
