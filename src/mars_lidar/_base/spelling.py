"""Suggestions for misspelt names: of arguments, keys, choices, options and commands, all in the same words."""

import difflib
from collections.abc import Sequence
from typing import Any

from mars_lidar._base.tolerances import TOL


def did_you_mean(word: Any, allowed: Sequence[Any]) -> str:
    """`` (did you mean 'near'?)`` for the allowed words nearest to `word`, or an empty text where none is near.

    Near are words that begin with `word`, then similar ones.
    """
    word, names = str(word), [str(each) for each in allowed]
    longer = [name for name in names if word.strip("-") and name.startswith(word)]
    near = list(dict.fromkeys(longer + difflib.get_close_matches(word, names, TOL.suggestions, TOL.similarity)))
    return f" (did you mean {' or '.join(map(repr, near[: TOL.suggestions]))}?)" if near else ""
