"""Streams calibrated and validated: matched, faulty and measured detectors (T6)."""
