"""The example, shortened: it runs, learns, and measures itself."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import torch


def test_train_depth():
    path = Path(__file__).parents[2] / "examples" / "train_depth.py"
    spec = importlib.util.spec_from_file_location("train_depth", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        net, losses = example.train(steps=30, size=12)
        shares = example.within_a_bin(net, size=12)
    finally:
        torch.set_num_threads(threads)
    assert len(losses) == 30
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    assert set(shares) == {"network", "argmax", "matched filter"}
    assert 0.3 < shares["argmax"] <= 1.0  # chance is 0.03
    assert 0.3 < shares["matched filter"] <= 1.0
