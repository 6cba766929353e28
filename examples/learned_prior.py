"""A learned prior in deepinv's proximal gradient descent, beside total variation, method "image" and each pixel alone.

``python examples/learned_prior.py FOLDER`` trains the denoiser on a CPU and writes learned_prior.md and its picture.
"""

import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from deepinv.models import DRUNet
from deepinv.optim import PGD
from deepinv.optim.prior import PnP, TVPrior
from torch.nn.functional import avg_pool2d, pad

import mars_lidar as ml
from mars_lidar.learn import LidarLikelihood, LidarPhysics

PULSE_NS, PHOTONS, SBR = 1.0, 5.0, 1.0  # photons of the return: of a pixel, on average, in the whole exposure
PULSE, DETECTOR = ml.GaussianPulse(sigma_ns=PULSE_NS), ml.Detector(dead_time_ns=75.0)
SYSTEM = ml.System(period_ns=128.0, cycles=1000, bins=128, pulse=PULSE, detector=DETECTOR)
M_PER_WIDTH = 0.5 * 0.299792458 * PULSE_NS
ALONE, AROUND, SMOOTH = "a pixel alone, maximum likelihood", "method `image`", "total variation, weight "
PICTURED = ("truth", ALONE, AROUND, SMOOTH + "2", "learned prior")
SIZE = 96  # of the scenes that are reconstructed
FLOOR = 0.2 / SYSTEM.cycles  # photons per period that an estimate of zero stands for, in a logarithm


def scenes(name, size, seeds):
    """Light (N, 3, H, W) of built-in scenes: signal and background, photons per period, and delay, ns."""
    lights = [ml.Scene.example(name, size, k).flux(SYSTEM, signal=PHOTONS / SYSTEM.cycles, sbr=SBR) for k in seeds]
    return torch.stack([torch.from_numpy(np.stack([f.signal, f.background, f.delay_ns])) for f in lights]).float()


def images(light):
    """Of light: log signal, log background, delay in widths of the pulse; an error is 1/sqrt(photons) in all three."""
    logs = light[:, :2].nan_to_num(0.0).clamp_min(FLOOR).log()
    return torch.cat([logs, light[:, 2:].nan_to_num(0.5 * SYSTEM.period_ns) / PULSE_NS], 1)


def light_of(images):
    """Back again."""
    return torch.cat([images[:, :2].exp(), images[:, 2:] * PULSE_NS], 1)


class Denoiser(torch.nn.Module):
    """deepinv's DRUNet, small and untrained, which tells the noise from what a pixel has more than those around it."""

    def __init__(self):
        super().__init__()
        self.net = DRUNet(3, 3, nc=(32, 32, 48, 64), nb=1, pretrained=None)

    def forward(self, x, sigma):
        """Images (N, 3, H, W) without noise of standard deviation `sigma`: one number, or one for each image."""
        around = avg_pool2d(pad(x, (4, 4, 4, 4), mode="replicate"), 9, 1)
        return x + self.net(4.0 * torch.tanh(0.25 * (x - around)), torch.as_tensor(sigma))


def train(steps=1500, rooms=300, batch=8):
    """A denoiser of Gaussian noise of 0.05 to 1 on crops of "random" scenes, and its losses."""
    torch.manual_seed(0)
    clean = images(scenes("random", 96, range(100, 100 + rooms)))
    denoiser, losses = Denoiser(), []
    optimizer = torch.optim.AdamW(denoiser.parameters())
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2.5e-3, total_steps=steps)
    for step in range(steps):
        if step % 100 == 0:
            print(f"training, step {step} of {steps}", flush=True)
        row, column = torch.randint(65, (2,)).tolist()
        x = clean[torch.randint(rooms, (batch,)), :, row : row + 32, column : column + 32]
        x[:, 1] += torch.randn(batch, 1, 1)  # any background
        sigma = torch.exp(torch.empty(batch, 1, 1, 1).uniform_(np.log(0.1), np.log(0.7)))
        loss = ((denoiser(x + sigma * torch.randn_like(x), sigma[:, 0, 0, 0]) - x).abs() / sigma).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(denoiser.parameters(), 1.0)
        optimizer.step()
        rate.step()
        losses.append(loss.item())
    return denoiser.eval(), losses


def solve(y, start, prior, **options):
    """Images by deepinv's proximal gradient descent."""
    descent = PGD(data_fidelity=LidarLikelihood(), prior=prior, **options)
    return descent(y, LidarPhysics(SYSTEM, images="log"), init=(start.clone(), start.clone())).detach()


def estimates(y, denoiser, steps=100):
    """Images of histograms (N, bins, H, W) by each method: pairs of its name and (N, 3, H, W)."""
    cubes, start = y.movedim(1, -1).double().contiguous().numpy(), None
    for name, method in ((ALONE, "maximum_likelihood"), (AROUND, "image")):
        parts = [ml.reconstruct(cube, SYSTEM, method) for cube in cubes]
        maps = [np.stack([part.signal, part.background, part.delay_ns]) for part in parts]
        start = images(torch.from_numpy(np.stack(maps)).float())
        yield name, start
    for weight in (1.0, 2.0, 4.0):
        prior = TVPrior(n_it_max=20)
        yield (
            f"total variation, weight {weight:g}",
            solve(y, start, prior, stepsize=0.02, lambda_reg=weight, max_iter=steps),
        )
    noise = np.r_[np.geomspace(0.5, 0.2, steps - steps // 3), np.full(steps // 3, 0.2)].tolist()
    yield "learned prior", solve(y, start, PnP(denoiser), stepsize=0.08, sigma_denoiser=noise, max_iter=steps)


def compared(denoiser, name, seed, size=SIZE, steps=100):
    """Errors of every method on a built-in scene: rows of name and numbers; and the images by name."""
    light = scenes(name, size, [seed])
    y = LidarPhysics(SYSTEM)(light, seed=3)
    true = images(light)
    rows, maps = [], {"truth": true}
    for method, estimate in estimates(y, denoiser, steps):
        print(f"{name}: {method}", flush=True)
        depth = M_PER_WIDTH * (estimate - true)[:, 2].abs()
        far = depth > 3.0 * M_PER_WIDTH
        signal = (light_of(estimate) - light)[:, 0] / light[:, 0].mean()
        rows.append((method, _rms(depth), _rms(depth[~far]), depth.median(), 100.0 * far.float().mean(), _rms(signal)))
        maps[method] = estimate
    signal, background, delay_ns = light[0].double().numpy()
    bound = ml.cramer_rao(ml.Flux(signal, background, delay_ns), SYSTEM)
    least = [_rms(torch.from_numpy(error)) for error in (bound.depth_m, bound.signal / signal.mean())]
    rows.append(("Cramer-Rao bound of a pixel alone", least[0], "-", "-", "-", least[1]))
    return rows, maps


def _rms(errors):
    return errors.square().mean().sqrt()


HEAD = f"""# A learned prior: a denoiser of deepinv with the likelihood of dead time

Made by `python examples/learned_prior.py FOLDER`. deepinv's DRUNet, small and trained here in {{spent:.0f}} s of a
processor on crops of scenes `"random"` with Gaussian noise, is the plug-and-play prior of deepinv's proximal gradient
descent. The data term is `histogram_log_likelihood` of a dim cube: {PHOTONS:g} photons of the return a pixel on average
and as many of the background in {SYSTEM.cycles} periods of {SYSTEM.period_ns:g} ns, {SYSTEM.bins} bins, pulse of
sigma = {PULSE_NS:g} ns, dead time {DETECTOR.dead_time_ns:g} ns. Total variation (`TVPrior`) has the same data term.
Both start from the estimate of method `image`. Of total variation three weights are shown; the learned prior's
settings were chosen on two scenes, of either kind, that are in none of the tables.

Errors of depth in m: *near*, of the pixels within 3 sigma of the pulse; *off*, the share of the others. Errors of
reflectivity in units of its mean. The bound is that of estimates without a prior: root of the mean over the pixels. One
exposure of one scene each, of {{size}} x {{size}} pixels.

"""


def write(folder):
    """Train, compare, and write learned_prior.md and learned_prior.png."""
    began = time.process_time()
    denoiser, _ = train()
    text = HEAD.format(spent=time.process_time() - began, size=SIZE)
    figure, axes = plt.subplots(2, 5, figsize=(13, 5.4), layout="constrained")
    for row, (name, seed, law) in zip(axes, (("room", 1, "another"), ("random", 2, "their own")), strict=True):
        rows, maps = compared(denoiser, name, seed)
        text += f'## `"{name}"`, not among the scenes of the training, of {law} law\n\n'
        text += "| method | depth rms | rms, near | median | off, % | reflectivity rms |\n|---|---|---|---|---|---|\n"
        for method, *numbers in rows:
            cells = [number if isinstance(number, str) else f"{float(number):.3g}" for number in numbers]
            text += f"| {method} | {' | '.join(cells)} |\n"
        learned = next(row for row in rows if row[0] == "learned prior")
        best = [min(row[k] for row in rows if row[0].startswith(SMOOTH)) for k in range(1, 6)]
        shares = [f"{float(a / b):.2f}" for a, b in zip(learned[1:], best, strict=True)]
        text += f"\nLearned prior over the best weight of total variation, by column: {', '.join(shares)}.\n\n"
        far = M_PER_WIDTH * maps["truth"][0, 2].max().item()
        for axis, method in zip(row, PICTURED, strict=True):
            picture = axis.imshow(M_PER_WIDTH * maps[method][0, 2], vmin=0.0, vmax=far)
            axis.set(title=method, xticks=[], yticks=[])
        figure.colorbar(picture, ax=row, label="depth (m)")
    Path(folder).mkdir(parents=True, exist_ok=True)
    Path(folder, "learned_prior.md").write_text(text + "![Depths](learned_prior.png)\n", encoding="utf-8")
    figure.savefig(Path(folder, "learned_prior.png"), dpi=60, metadata={"Software": None})


if __name__ == "__main__":
    torch.set_num_threads(1)  # small tensors: more is hardly faster
    write(sys.argv[1])
