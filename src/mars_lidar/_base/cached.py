"""The cached property of functools of Python 3.12, without the lock of 3.11.

The lock of 3.11 is shared by all instances of the class. A process that is forked while another thread holds it, such
as a loader worker while a stream is simulated in the background, would wait for it forever.
"""

import functools
import sys
from typing import TYPE_CHECKING, Any

__all__ = ["cached_property"]

if TYPE_CHECKING or sys.version_info >= (3, 12):
    from functools import cached_property
else:

    class cached_property(functools.cached_property):
        """A property that is computed on first use and kept in the object's `__dict__`."""

        def __get__(self, instance: Any, owner: Any = None) -> Any:
            """The value; the property itself of a class."""
            if instance is None:
                return self
            values = instance.__dict__
            if self.attrname not in values:
                values[self.attrname] = self.func(instance)
            return values[self.attrname]
