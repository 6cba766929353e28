"""The script `mars-lidar`: outside of the package, so that Ctrl-C while the package is imported ends it in one line."""

import sys


def main() -> int:
    """Entry point; returns the exit code."""
    try:
        from mars_lidar.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("mars-lidar: interrupted", file=sys.stderr)
        return 130
