"""Sweeps of the declared domain: random systems, every engine and prediction against whatever is independent of it.

``python -m tests.domain --help`` for hours of it. Systems (`systems`), a simulator that shares nothing with the
engines (`simulator`), comparisons (`checks`), one case and who is to blame (`judge`), the sweep in processes of its own
(`sweep`), its report (`run`), and the engine `feedback` at long exposures (`long_exposures`).
"""
