"""The style sheet of all figures (mars.mplstyle beside this file); colours.py names their colours."""

from pathlib import Path
from typing import Any

SHEET = Path(__file__).with_name("mars.mplstyle")
DPI = 150


def style() -> Any:
    """Context in which figures are made; the user's settings are restored afterwards."""
    import matplotlib as mpl

    return mpl.rc_context(mpl.rc_params_from_file(SHEET, use_default_template=False))
