"""mars-lidar: exact, fast simulation of single-photon LiDAR under SPAD dead time.

Its names, and those of some packages in it, stand in a stub beside their source; modules are imported on first use.
"""

from importlib import import_module
from pkgutil import iter_modules

import lazy_loader

_attribute, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
_packages = {module.name for module in iter_modules(__path__)}
__all__ = [name for name in _names if name not in _packages]  # `import *` would put `io` before that of Python


def __getattr__(name: str) -> object:
    if name in _names:
        return _attribute(name)
    packages = [import_module(f"mars_lidar.{package}") for package in ("engines", "reconstruction", "statistics")]
    place = next((f"; it is {package.__name__}.{name}" for package in packages if name in package.__all__), "")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{place}")
