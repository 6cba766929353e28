"""Train a small network to read depth from simulated photon histograms: on a CPU, in under two minutes."""

import torch
from torch.utils.data import DataLoader

import mars_lidar as ml
from mars_lidar.learn import CubeStream, LogUniform

SYSTEM = ml.System(
    period_ns=100.0, cycles=100, bins=64, pulse=ml.GaussianPulse(sigma_ns=1.5), detector=ml.Detector(dead_time_ns=75.0)
)


def batches(seed: int, size: int = 32) -> DataLoader:
    """Batches of eight cubes of scenes, light levels and backgrounds that never come again."""
    stream = CubeStream(SYSTEM, size=size, batch_size=8, signal=LogUniform(0.02, 0.5), seed=seed)
    return DataLoader(stream, batch_size=None)


def train(steps: int = 300, size: int = 32) -> tuple[torch.nn.Module, list[float]]:
    """The network, which gives each bin's score as the place of the return, and its loss at each step."""
    torch.manual_seed(0)
    layers = [torch.nn.Conv2d(64, 64, 1), torch.nn.ReLU(), torch.nn.Conv2d(64, 32, 3, padding=1), torch.nn.ReLU()]
    net = torch.nn.Sequential(*layers, torch.nn.Conv2d(32, 64, 3, padding=1))
    optimizer, losses = torch.optim.AdamW(net.parameters(), 3e-3), []
    for _, batch in zip(range(steps), batches(seed=1, size=size), strict=False):
        place = (batch["flux"]["delay"] / SYSTEM.bin_ns).long() % SYSTEM.bins
        losses.append(torch.nn.functional.cross_entropy(net(torch.log1p(batch["cube"])), place))
        optimizer.zero_grad()
        losses[-1].backward()
        optimizer.step()
    return net, [loss.item() for loss in losses]


def within_a_bin(net: torch.nn.Module, size: int = 32) -> dict[str, float]:
    """Share of the pixels of unseen scenes whose return is placed at most one bin off."""
    batch, right = next(iter(batches(seed=2, size=size))), {}
    place, cube = batch["flux"]["delay"] / SYSTEM.bin_ns, batch["cube"]
    matched = ml.reconstruct(cube.permute(0, 2, 3, 1).numpy().astype("uint16"), SYSTEM, "matched_filter")
    with torch.no_grad():
        found = {"network": net(torch.log1p(cube)).argmax(1) + 0.5, "argmax": cube.argmax(1) + 0.5}
    found["matched filter"] = torch.from_numpy(matched.delay_ns / SYSTEM.bin_ns)
    for name, one in found.items():
        off = (one - place + SYSTEM.bins / 2) % SYSTEM.bins - SYSTEM.bins / 2
        right[name] = (off.abs() <= 1).double().mean().item()
    return right


if __name__ == "__main__":
    import matplotlib.pyplot as plt

    network, curve = train()
    print(", ".join(f"{name} {share:.1%}" for name, share in within_a_bin(network).items()), "within one bin")
    plt.plot(curve)
    plt.gca().set(xlabel="step (8 new cubes each)", ylabel="cross entropy of the bin", title="train_depth.py")
    plt.savefig("train_depth.png", dpi=80, bbox_inches="tight")
