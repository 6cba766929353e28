"""YAML as people write it: 1e-3 is a number, as in YAML 1.2 and in Python, which PyYAML (1.1) takes for text."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

_EXPONENT = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")


@lru_cache(maxsize=1)
def loader() -> Any:
    """PyYAML's safe loader with such numbers."""
    import yaml

    class Loader(yaml.SafeLoader):
        """A loader with resolvers of its own: adding one leaves those of `yaml.SafeLoader` alone."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+0123456789"))
    return Loader
