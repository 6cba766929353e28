"""The feedback engine at a million cycles and more."""
