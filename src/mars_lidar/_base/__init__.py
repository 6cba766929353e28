"""Shared utilities: argument checks, memory, optional libraries, short texts."""
