"""The colours of all figures. The first six and INK stand in mars.mplstyle too, where matplotlib reads them."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # of pixels and series, in this order
INK = "#222222"  # text, axes
PREDICTION = INK  # laws drawn over counts
MUTED = "#767676"  # what is drawn for comparison
MISSING = "#c8c8c8"  # pixels without a value
HALO = "white"  # around marks on a map
DEPTH_MAP = "viridis"  # depths, backgrounds, numbers of returns
SHARE_MAP = "gray"  # reflectivities, signals
COUNTS_MAP = "magma"
