"""The account of all statistical checks: one level for each, the family's level by Bonferroni."""

from collections.abc import Iterable, Mapping

LEVEL = 1e-7  # of each check: 5.3 standard deviations
FAMILY_LEVEL = 1e-3  # of all checks of a run together; more than 10,000 of them make the run fail

_done: list[tuple[float, str]] = []


def require(outcomes: Mapping[str, float], about: str = "") -> None:
    """Enter p-values into the account and fail if one is below `LEVEL`."""
    _done.extend((p, f"{about}: {name}") for name, p in outcomes.items())
    failed = {name: p for name, p in outcomes.items() if not p >= LEVEL}
    assert not failed, f"{about}: p-values below {LEVEL:g}: " + ", ".join(f"{n} {p:.2g}" for n, p in failed.items())


def rejected(outcomes: Mapping[str, float]) -> set[str]:
    """Names of the comparisons that would fail; for the tests of the harness itself, not entered."""
    return {name for name, p in outcomes.items() if not p >= LEVEL}


def entries() -> list[tuple[float, str]]:
    """All checks so far: p-value and name."""
    return [(float(p), about) for p, about in _done]


def add(others: Iterable[tuple[float, str]]) -> None:
    """Enter the checks of another process."""
    _done.extend((p, about) for p, about in others)


def number() -> int:
    """Checks so far."""
    return len(_done)


def summary() -> list[str]:
    """Lines for the end of a run."""
    if not _done:
        return []
    smallest, where = min(_done)
    return [
        f"{number()} statistical checks, family false-alarm level {number() * LEVEL:.2g} "
        f"({LEVEL:g} each, at most {FAMILY_LEVEL:g} allowed)",
        f"smallest p-value {smallest:.2g} ({where}); {1 / number():.1g} is expected",
    ]
