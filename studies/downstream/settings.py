"""The networks of the study "downstream": each has its kind, the data that it is trained on, and its seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from studies.downstream.data import MAIN, PAIR, Config


@dataclass(frozen=True)
class Run:
    """One network: its kind, the simulator of its data, dead time in periods, ratio, seed."""

    kind: str
    arm: str
    dead: float
    sbr: float
    seed: int

    @property
    def file(self) -> str:
        """Of its result."""
        return f"{self.kind}-{self.arm}-dead{self.dead:g}-sbr{self.sbr:g}-{self.seed}.json"


def runs(config: Config) -> Iterator[Run]:
    """All networks, seed by seed; a spatial network follows the pixel network of the same data."""
    for seed in range(config.seeds):
        for sbr in config.sbr:
            for arm in config.arms:
                yield Run("pixel", arm, MAIN, sbr, seed)
                if config.spatial and (seed == 0 or arm in PAIR):
                    yield Run("spatial", arm, MAIN, sbr, seed)
        if seed == 0:
            yield from (Run("pixel", arm, dead, 1.0, seed) for dead in config.dead for arm in PAIR)
