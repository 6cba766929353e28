"""The arrays of our photons.npz belong together, though no sum is over them."""

from __future__ import annotations

import numpy as np
import pytest
from harness import make_system

import mars_lidar as ml
from mars_lidar._base.files import FileError

SYSTEM = make_system(30.0, 50, 32)


def test_bins_belong_to_their_times(tmp_path):
    for detector in (SYSTEM.detector, ml.Detector(dead_time_ns=30.0, jitter=ml.Jitter(sigma_ns=0.5))):
        times = ml.simulate_timestamps(ml.Flux(np.full((3, 4), 1.0), 0.1, 40.0), SYSTEM.replace(detector=detector))
        times.save(tmp_path / "a.npz", overwrite=True)
        assert (ml.Timestamps.load(tmp_path / "a.npz").bin == times.bin).all()
    with np.load(tmp_path / "a.npz") as archive:
        good = {name: archive[name] for name in archive.files}
    for change, message in (
        ({"bin": good["bin"][::-1]}, r"a\.npz.*bin must be that of times_ns"),
        ({"bin": good["bin"].astype(complex)}, r"a\.npz.*bin must be integers"),
        ({"cycle": good["cycle"].astype(float)}, r"a\.npz.*cycle must be integers"),
        ({"times_ns": good["times_ns"].astype("M8[ns]")}, r"a\.npz.*times_ns must be times"),
    ):
        np.savez(tmp_path / "a.npz", **good | change)
        with pytest.raises(FileError, match=message):
            ml.Timestamps.load(tmp_path / "a.npz")


def test_uneven_bins_are_kept(tmp_path):
    widths = tuple(np.tile([0.5, 1.5], 16))
    system = SYSTEM.replace(detector=ml.Detector(dead_time_ns=30.0, code_density=widths))
    times = ml.simulate_timestamps(ml.Flux(np.full((3, 4), 1.0), 0.1, 40.0), system)
    times.save(tmp_path / "a.npz")
    assert (ml.Timestamps.load(tmp_path / "a.npz").bin == times.bin).all()
