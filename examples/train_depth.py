"""Train a small network to read depth from photon histograms, on a CPU, on cubes that never come again."""

import matplotlib.pyplot as plt
import torch
from torch.nn import Conv2d, ReLU
from torch.utils.data import DataLoader

import mars_lidar as ml
from mars_lidar.learn import CubeStream, LogUniform

PULSE, DETECTOR = ml.GaussianPulse(sigma_ns=1.5), ml.Detector(dead_time_ns=75.0)
SYSTEM = ml.System(period_ns=100.0, cycles=100, bins=64, pulse=PULSE, detector=DETECTOR)


def cubes(seed, batches, size):
    """Batches of eight scenes in any light, SBR 0.1 to 10: counts (8, 64, H, W), and places of the returns in bins."""
    stream = CubeStream(
        SYSTEM, size=size, batch_size=8, epoch_size=8 * batches, signal=LogUniform(0.02, 0.5), seed=seed
    )
    for batch in DataLoader(stream, batch_size=None):
        yield batch["counts"], batch["flux"]["delay"] / SYSTEM.bin_ns


def train(batches=300, size=32):
    """A network that gives each bin a score as the place of the return, and its losses."""
    torch.manual_seed(0)
    layers = Conv2d(64, 64, 1), ReLU(), Conv2d(64, 32, 3, padding=1), ReLU(), Conv2d(32, 64, 3, padding=1)
    net, losses = torch.nn.Sequential(*layers), []
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    for batch, (counts, place) in enumerate(cubes(1, batches, size)):
        loss = torch.nn.functional.cross_entropy(net(counts.log1p()), place.long() % 64)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if batch % 25 == 0:
            print(f"batch {batch} of {batches}: cross entropy {losses[-1]:.2f}", flush=True)
    return net, losses


def within_a_bin(net, size=32):
    """Share of the pixels of unseen scenes that are placed at most one bin off, beside the matched filter's."""
    counts, place = next(cubes(2, 1, size))
    matched = ml.reconstruct(counts.movedim(1, -1).numpy(), SYSTEM, "matched_filter").delay_ns / SYSTEM.bin_ns
    bins = {"network": net(counts.log1p()).argmax(1) + 0.5, "matched filter": torch.from_numpy(matched)}
    return {name: ((bin - place + 32) % 64 - 32).abs().le(1).double().mean().item() for name, bin in bins.items()}


if __name__ == "__main__":
    network, curve = train()
    print("placed within one bin:", within_a_bin(network))
    plt.style.use("mars_lidar.plot.mars")
    plt.figure(figsize=(6, 2.8), layout="constrained")
    plt.plot(curve)
    plt.gca().set(xlabel="batch (8 new cubes each)", ylabel="cross entropy of the bin (nats)")
    plt.savefig("train_depth.png", dpi=130)
