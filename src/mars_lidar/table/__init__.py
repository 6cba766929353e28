"""The lookup table over (S, B), its storage and its cache."""

from mars_lidar.table.entries import Lookup
from mars_lidar.table.error import QuantisationError
from mars_lidar.table.table import Table

__all__ = ["Lookup", "QuantisationError", "Table"]
