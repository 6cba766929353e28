"""`python -m mars_lidar` is the command `mars-lidar`."""

import sys

from mars_lidar.cli import main

if __name__ == "__main__":
    sys.exit(main())
