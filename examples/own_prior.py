"""Signal, background and depth of a pixel with a prior of one's own: simulation-based inference by the package sbi."""

import sys

import numpy as np
import torch
from sbi.inference import NPE

import mars_lidar as ml
from mars_lidar.learn import CubeStream, LogUniform

PULSE, DETECTOR = ml.GaussianPulse(sigma_ns=3.0), ml.Detector(dead_time_ns=75.0)
SYSTEM = ml.System(period_ns=100.0, cycles=200, bins=64, pulse=PULSE, detector=DETECTOR)
NAMES = ("log S", "log B", "delay")


def pixels(number, seed):
    """Unknowns (number, 3) and histograms (number, 64) of pixels of the prior: whatever `CubeStream` is asked to draw.

    Histograms are turned so that their fullest bins come first, and the delay is in bins from there.
    """
    stream = CubeStream(
        SYSTEM, size=32, batch_size=1, signal=LogUniform(0.2, 2.0), sbr=LogUniform(0.5, 5.0), seed=seed, threads=1
    )
    unknown, turned = [], []
    random = torch.Generator().manual_seed(seed)
    for batch, _ in zip(stream, range(-(-number // 64)), strict=False):
        some = torch.randperm(32 * 32, generator=random)[:64]  # of each scene, so that there are many scenes
        counts = batch["counts"][0].flatten(1)[:, some].T
        signal, background, delay = (batch["flux"][key][0].flatten()[some] for key in ("signal", "background", "delay"))
        first = (counts + counts.roll(-1, 1) + counts.roll(-2, 1)).argmax(1)
        turned.append(counts.gather(1, (torch.arange(64) + first[:, None]) % 64))
        away = torch.remainder(delay / SYSTEM.bin_ns - first - 1.5 + 32, 64) - 32
        unknown.append(torch.stack([signal.clamp_min(1e-3).log(), background.log(), away], 1))
    return torch.cat(unknown)[:number], torch.cat(turned)[:number].sqrt()


def train(number=16_384, epochs=20):
    """The posterior of a pixel, given its histogram: a normalising flow, trained on simulated pixels."""
    torch.manual_seed(0)
    inference = NPE(density_estimator="maf", show_progress_bars=False)
    inference.append_simulations(*pixels(number, 1))
    inference.train(training_batch_size=256, learning_rate=2e-3, max_num_epochs=epochs)
    print(f"validation loss {inference.summary['best_validation_loss'][-1]:.2f}", flush=True)
    return inference.build_posterior()


def coverage(posterior, number=512, draws=400):
    """Shares of pixels that are in none of the training whose 90 % intervals hold the truth, and its standard error."""
    truth, counts = pixels(number, 2)
    drawn = posterior.sample_batched((draws,), counts, show_progress_bars=False)
    low, high = torch.quantile(drawn, torch.tensor([0.05, 0.95]), dim=0)
    inside = ((truth >= low) & (truth <= high)).double().mean(0)
    return dict(zip(NAMES, inside.tolist(), strict=True)), float(np.sqrt(0.09 / number))


if __name__ == "__main__":
    torch.set_num_threads(1)
    print("simulating and training", flush=True)
    shares, error = coverage(train(*map(int, sys.argv[1:])))
    for name, share in shares.items():
        print(f"90 % intervals of {name}: {share:.3f} +- {error:.3f}")
