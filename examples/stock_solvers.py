"""Three solvers of deepinv, unchanged, on one dim cube, beside maximum likelihood of each pixel.

``python examples/stock_solvers.py`` prints their errors. The weights that deepinv would download for DRUNet are trained
here, on log light and delays of other scenes with Gaussian noise: deepinv's own are of photographs.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from deepinv.models import DRUNet, TVDenoiser
from deepinv.optim import PGD
from deepinv.optim.prior import PnP, TVPrior

import mars_lidar as ml
from mars_lidar.learn import LidarLikelihood, LidarPhysics

PULSE, DETECTOR = ml.GaussianPulse(sigma_ns=4.0), ml.Detector(dead_time_ns=75.0)
SYSTEM = ml.System(period_ns=128.0, cycles=200, bins=64, pulse=PULSE, detector=DETECTOR)
PHYSICS = LidarPhysics(SYSTEM, images="log", seed=3)
SIZE, CHANNELS = 32, (16, 24, 32, 48)  # pixels; of DRUNet, which has 64, 128, 256 and 512 with deepinv's weights


def scenes(name, seeds):
    """Images (N, 3, H, W) of built-in scenes: 40 photons of the return a pixel on average, and of the background."""
    lights = [ml.Scene.example(name, SIZE, seed).flux(SYSTEM, signal=0.2, sbr=1.0) for seed in seeds]
    maps = np.stack([[np.broadcast_to(m, (SIZE, SIZE)) for m in (f.signal, f.background, f.delay_ns)] for f in lights])
    return PHYSICS.images(*torch.from_numpy(maps).movedim(1, 0))


def weights(steps=1500, rooms=200, batch=4):
    """Of a DRUNet that removes noise of standard deviation 0.05 to 0.4 from images."""
    torch.manual_seed(0)
    clean = torch.cat([scenes(name, range(100, 100 + rooms)) for name in ("room", "random")]).float()
    clean = clean[clean.isfinite().all((1, 2, 3))]
    net = DRUNet(3, 3, nc=CHANNELS, nb=1, pretrained=None)
    optimizer = torch.optim.AdamW(net.parameters())
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
    for step in range(steps):
        if step % 100 == 0:
            print(f"training of DRUNet, step {step} of {steps}", flush=True)
        x = clean[torch.randint(len(clean), (batch,))]
        sigma = torch.exp(torch.empty(batch).uniform_(np.log(0.05), np.log(0.4)))
        loss = (net(x + sigma.reshape(-1, 1, 1, 1) * torch.randn_like(x), sigma) - x).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        rate.step()
    return net.state_dict()


def solvers(file):
    """Pairs of a name and an algorithm of deepinv; `file`: weights of DRUNet."""
    drunet = DRUNet(3, 3, nc=CHANNELS, nb=1, pretrained=str(file)).eval()
    priors = {
        "PGD, TVPrior, weight 2": (TVPrior(n_it_max=20), {"lambda_reg": 2.0}),
        "PGD, PnP(TVDenoiser), sigma 0.04": (PnP(TVDenoiser(n_it_max=20)), {"sigma_denoiser": 0.04}),
        "PGD, PnP(DRUNet), sigma 0.1": (PnP(drunet), {"sigma_denoiser": 0.1}),
    }
    for name, (prior, options) in priors.items():
        common = {"data_fidelity": LidarLikelihood(), "custom_init": LidarPhysics.custom_init}
        yield name, PGD(prior=prior, stepsize=0.02, max_iter=40, **common, **options)


def errors(file, seed=1):
    """Root mean squared errors of every method on a room: log signal, log background, delay in widths of the pulse."""
    true = scenes("room", [seed]).float()
    y = PHYSICS(true)
    estimates = {"maximum likelihood, each pixel alone": PHYSICS.A_dagger(y)}
    for name, algorithm in solvers(file):
        print(name, flush=True)
        estimates[name] = algorithm(y, PHYSICS).detach()
    return {name: (images - true).square().mean((0, 2, 3)).sqrt().tolist() for name, images in estimates.items()}


if __name__ == "__main__":
    torch.set_num_threads(1)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "drunet.pt")
        torch.save(weights(), file)
        print(f"{time.process_time() - began:.0f} s of a processor", flush=True)
        rows = errors(file)
    print("| | log signal | log background | delay |\n|---|---|---|---|")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(f'{value:.3f}' for value in row)} |")
