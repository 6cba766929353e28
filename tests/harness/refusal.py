"""What is refused, and in which words: a line for each."""

from collections.abc import Callable
from typing import Any

import pytest


def refused(
    words: str,
    call: Callable[..., Any],
    /,
    *arguments: Any,
    error: type[BaseException] | tuple[type[BaseException], ...] = ValueError,
    **options: Any,
) -> str:
    """Message of the error of `call` with these arguments, which the regular expression `words` matches ("": any)."""
    with pytest.raises(error, match=words or None) as caught:
        call(*arguments, **options)
    return str(caught.value)
