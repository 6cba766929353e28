"""The style sheet of all figures (mars.mplstyle beside this file), and named colours."""

from pathlib import Path
from typing import Any

SHEET = Path(__file__).with_name("mars.mplstyle")
DPI = 150
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # as the sheet's cycle
INK = "#222222"
PREDICTION = INK  # of laws drawn over counts
MUTED = "#767676"
MISSING = "#c8c8c8"  # pixels without a value


def style() -> Any:
    """Context in which figures are made; the user's settings are restored afterwards."""
    import matplotlib as mpl

    return mpl.rc_context(mpl.rc_params_from_file(SHEET, use_default_template=False))
