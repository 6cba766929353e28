"""`simulate`, and the engines by the names of its argument `engine`, one file each."""

from mars_lidar.engines.engine import Engine, EngineOptions
from mars_lidar.engines.mars import MarsEngine
from mars_lidar.engines.registry import ANY_SYSTEM, ENGINES, check_detector, find_engine
from mars_lidar.engines.renewal import RenewalEngine

__all__ = [
    "ANY_SYSTEM",
    "ENGINES",
    "Engine",
    "EngineOptions",
    "MarsEngine",
    "RenewalEngine",
    "check_detector",
    "find_engine",
]
