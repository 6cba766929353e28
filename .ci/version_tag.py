#!/usr/bin/env python3
"""Compare a release tag with the version of the package: `.ci/version_tag.py v0.3.0`; ends with 1 if they differ."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def main() -> str | None:
    """Return the error, if there is one."""
    version = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["version"]
    tag = sys.argv[1]
    return None if tag == f"v{version}" else f"tag {tag} is not v{version}, the version in pyproject.toml"


if __name__ == "__main__":
    sys.exit(main())
