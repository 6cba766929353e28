"""Benchmarks of mars_lidar: ``python -m benchmarks`` prints and saves a table (``--help`` says more).

Machines are noisy. Cases that are compared run in turn in one process, ratios are taken within a turn, and
the median and the least of several turns are reported, with CPU time beside wall time: nanoseconds per
registration and core stay nearly right on a machine that is busy with other work.
"""
