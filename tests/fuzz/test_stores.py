"""Some of `python -m tests.fuzz.stores`: what was opened is what is read, or an error names the store."""

import pytest

pytest.importorskip("torch")

from tests.fuzz.stores import ATTACKS, READERS, attacks, make


@pytest.mark.parametrize("seed", [3, pytest.param(20261123, marks=pytest.mark.full)])
def test_attacked_stores_are_refused_or_the_same(tmp_path, seed):
    make(tmp_path)
    every = 2 * len(READERS) * len(ATTACKS)  # before and after opening
    number = every // 8 if seed == 3 else every
    outcomes = list(attacks(tmp_path, number, seed))
    assert len(outcomes) == number
    assert [row for row in outcomes if row[2] not in ("refused", "same")] == []
    assert {"refused"} <= {row[2] for row in outcomes}
