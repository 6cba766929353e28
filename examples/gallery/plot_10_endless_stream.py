"""
A network on an endless stream
==============================

`mars_lidar.learn.CubeStream` simulates cubes as PyTorch requests them: scenes and light that never repeat. A network
of three convolutions learns in seconds, on a processor, the bin of the return in dim scenes. The matched filter, for
comparison, uses one pixel at a time. From the left: the true depth, the matched filter's, the network's.
The program prints
``More than half a metre off: 8.5% by the matched filter, fewer than half as many by the network: True.``

How-to: :doc:`/learn`.
"""

import matplotlib.pyplot as plt
from torch import from_numpy, manual_seed, nn, optim

import mars_lidar as ml
from mars_lidar.learn import CubeStream, LogUniform

pulse, detector = ml.GaussianPulse(sigma_ns=1.5), ml.Detector(dead_time_ns=75.0)
system = ml.System(period_ns=100.0, cycles=100, bins=64, pulse=pulse, detector=detector)
layers = nn.Conv2d(64, 64, 1), nn.ReLU(), nn.Conv2d(64, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 64, 3, padding=1)
manual_seed(0)  # weights before training
net = nn.Sequential(*layers)
optimizer = optim.AdamW(net.parameters(), 3e-3)
for batch in CubeStream(system, size=32, batch_size=8, epoch_size=8 * 120, signal=LogUniform(0.02, 0.5), seed=1):
    optimizer.zero_grad()
    place = (batch["flux"]["delay"] / system.bin_ns).long() % 64
    nn.functional.cross_entropy(net(batch["counts"].log1p()), place).backward()
    optimizer.step()

(test,) = CubeStream(system, size=64, batch_size=1, epoch_size=1, signal=0.05, seed=2)
truth = test["depth"][0]
matched = ml.reconstruct(test["counts"][0].movedim(0, -1).numpy(), system, "matched_filter").depth_m
learned = 0.1499 * system.bin_ns * (net(test["counts"].log1p()).argmax(1)[0] + 0.5)
fig, axes = plt.subplots(1, 3, figsize=(8.2, 2.9))
for ax, name, depth in zip(
    axes, ("true depth", "matched filter", "network"), (truth, from_numpy(matched), learned), strict=True
):
    image = ax.imshow(depth, vmin=0, vmax=6)
    ax.set(title=name, xticks=[], yticks=[])
fig.colorbar(image, ax=axes, label="depth (m)", shrink=0.8)
plt.show()
by_filter, by_network = (
    float(((depth - truth).abs() > 0.5).float().mean()) for depth in (from_numpy(matched), learned)
)
fewer = f"fewer than half as many by the network: {by_network < by_filter / 2}."
print(f"More than half a metre off: {by_filter:.1%} by the matched filter, {fewer}")
