"""What decides a table: the key of a request, and the version of the file's layout."""

from __future__ import annotations

import hashlib
import json

from mars_lidar._base.types import FloatArray
from mars_lidar._version import __version__
from mars_lidar.instrument.system import System

FORMAT = 2
KEY_LENGTH = 24


def request_key(
    system: System,
    axes: tuple[FloatArray, FloatArray],
    *,
    method: str,
    rearm: str,
    refine: float | None,
    tolerance: float,
) -> str:
    """Hash of all that decides a table but its cycles, which many tables do not depend on."""
    instrument = system.to_dict()
    del instrument["cycles"]
    request = {
        "format": FORMAT,
        "version": __version__,
        "system": instrument,
        "axes": [[value.hex() for value in axis.tolist()] for axis in axes],
        "method": method,
        "rearm": rearm,
        "refine": refine,
        "tolerance": tolerance,
    }
    text = json.dumps(request, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]
