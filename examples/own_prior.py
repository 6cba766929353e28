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


def pixels(number, seed, each=16):
    """Unknowns (number, 3) and histograms (number, 64) of pixels of the prior: whatever `CubeStream` is asked to draw.

    `each` pixels of a scene. All of a scene have the same light, so a flow needs many scenes, and an independent test
    one pixel of each. Histograms are turned so that their fullest bins come first, and the delay is in bins from there.
    """
    light = {"signal": LogUniform(0.2, 2.0), "sbr": LogUniform(0.5, 5.0)}
    stream = CubeStream(SYSTEM, size=16, batch_size=8, **light, seed=seed, threads=1)
    unknown, turned = [], []
    random = torch.Generator().manual_seed(seed)
    for batch, _ in zip(stream, range(-(-number // (8 * each))), strict=False):
        some = torch.stack([torch.randperm(16 * 16, generator=random)[:each] for _ in range(8)])
        counts = batch["counts"].flatten(2).gather(2, some[:, None].expand(-1, 64, -1)).mT.flatten(0, 1)
        maps = (batch["flux"][key].flatten(1).gather(1, some).flatten() for key in ("signal", "background", "delay"))
        signal, background, delay = maps
        first = (counts + counts.roll(-1, 1) + counts.roll(-2, 1)).argmax(1)
        turned.append(counts.gather(1, (torch.arange(64) + first[:, None]) % 64))
        away = torch.remainder(delay / SYSTEM.bin_ns - first - 1.5 + 32, 64) - 32
        unknown.append(torch.stack([signal.log(), background.log(), away], 1))
    return torch.cat(unknown)[:number], torch.cat(turned)[:number].sqrt()


def train(number=98_304, epochs=4):
    """The posterior of a pixel, given its histogram: a normalising flow, trained on simulated pixels.

    Few epochs of many pixels: in more of fewer the flow learns its training by heart, and its intervals get too narrow.
    """
    torch.manual_seed(0)
    inference = NPE(density_estimator="maf", show_progress_bars=False)
    inference.append_simulations(*pixels(number, 1))
    print("training", flush=True)
    inference.train(training_batch_size=512, learning_rate=1e-3, max_num_epochs=epochs)
    print(f"validation loss {inference.summary['best_validation_loss'][-1]:.2f}", flush=True)
    return inference.build_posterior()


def coverage(posterior, number=3000, draws=200):
    """Shares of pixels of new scenes whose 50 and 90 % intervals hold the truth, by name, and their standard errors.

    From the rank of the truth among draws of its posterior, over the prior (simulation-based calibration).
    """
    truth, counts = pixels(number, 2, each=1)
    rank = (posterior.sample_batched((draws,), counts, show_progress_bars=False) < truth).double().mean(0)
    levels = np.array([0.5, 0.9])
    inside = [((rank - 0.5).abs() <= level / 2).double().mean(0).tolist() for level in levels]
    return dict(zip(NAMES, zip(*inside, strict=True), strict=True)), np.sqrt(levels * (1 - levels) / number)


if __name__ == "__main__":
    torch.set_num_threads(1)
    print("simulating", flush=True)
    shares, errors = coverage(train(*map(int, sys.argv[1:])))
    for name, (half, most) in shares.items():
        print(f"{name}: 50 % intervals {half:.3f} +- {errors[0]:.3f}, 90 % {most:.3f} +- {errors[1]:.3f}")
