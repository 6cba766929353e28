"""Ten cases from an independent photon-by-photon simulator (../shared/reference)."""

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from harness.cases import Case, flux_of, shared, system_of

REFERENCE_NAMES = (
    *("s01_mid", "s02_bright", "s03_dim", "s04_saturated", "s05_shortdead", "s06_longdead", "s07_wrap"),
    *("s08_fewphotons", "s09_hw_bright", "s10_resonant"),
)


@dataclass(frozen=True, eq=False)
class Reference:
    """Statistics of one case; times in laser periods."""

    name: str
    signal: float
    background: float
    delay: float
    sigma: float
    dead: float
    cycles: int
    realizations: int
    count: NDArray[np.int64]  # (n,): realizations that counted 0, 1, ...
    count_mean: float
    count_var: float
    mean: NDArray[np.float64]  # (bins,)
    variance: NDArray[np.float64]  # (bins,)
    lag1: NDArray[np.float64]  # (bins,): covariance of bin j with j + 1, cyclic
    window_mean: float
    window_var: float

    @classmethod
    def load(cls, name: str) -> "Reference":
        """Skips the test, saying so, where the cases are not there."""
        data = json.loads(shared(f"reference/{name}.json").read_text())
        times = {int(n): k for n, k in data["count"].items()}
        count = np.zeros(max(times) + 1, np.int64)
        count[list(times)] = list(times.values())
        numbers = {
            "signal": "S",
            "background": "B",
            "delay": "tau",
            "sigma": "sigma",
            "dead": "dead",
            "cycles": "cycles",
        }
        numbers |= {"realizations": "reals", "count_mean": "count_mean", "count_var": "count_var"}
        numbers |= {"window_mean": "win_mean", "window_var": "win_var"}
        arrays = {"mean": "hist_mean", "variance": "hist_var", "lag1": "hist_cov_lag1"}
        fields = {field: data[key] for field, key in numbers.items()}
        return cls(name=name, count=count, **fields, **{field: np.array(data[key]) for field, key in arrays.items()})

    def case(self, photons: float = 3e7, most: int = 20_000) -> Case:
        """The same, to be drawn until about so many photons have arrived."""
        system = system_of(self.dead, self.cycles, self.mean.size, sigma=self.sigma)
        items = int(min(most, photons / ((self.signal + self.background) * self.cycles)))
        return Case(self.name, flux_of(self.signal, self.background, self.delay), system, items // 4 * 4)

    def window_bins(self) -> tuple[int, int, int]:
        """The fewest bins among whose edges are those of the +-3 sigma window, and these two edges."""
        edges = self.delay + 3.0 * self.sigma * np.array([-1.0, 1.0])
        for bins in (400, 800, 1000, 2000, 4000, 8000):
            whole = np.round(edges * bins)
            if np.abs(edges * bins - whole).max() < 1e-9:
                return bins, int(whole[0]), int(whole[1])
        raise AssertionError(f"no number of bins up to 8000 has the edges {edges}")
