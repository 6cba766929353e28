"""The script `mars-lidar`: outside the package, so that Ctrl-C during the import of the package prints one line."""

import sys


def main() -> int:
    """Entry point; returns the exit code."""
    try:
        from mars_lidar.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("mars-lidar: interrupted", file=sys.stderr)
        return 130
