"""A sweep of the declared domain: every engine and prediction on random systems, against whatever is independent of it.

Systems (`case`, `systems`), what is drawn of each (`samples`), comparisons (`checks`, `records`), what they are held
against (`predictions`, `closed_forms`, `simulator`), one case (`judge`, in its own process: `watch`),
who is to blame (`verdict`), the sweep (`sweep`) and its report (`run`, `figures`).
"""
