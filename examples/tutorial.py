"""The cells of tutorial.ipynb; `python examples/make_notebook.py` runs them and writes the notebook."""

# %% [markdown]
# # mars-lidar in a quarter of an hour
# From your own depth and image to histograms under dead time, a prediction, and a depth map. Objects show themselves:
# put one on the last line of a cell.

# %%
import numpy as np

import mars_lidar as ml

pulse, detector = ml.GaussianPulse(sigma_ns=0.5), ml.Detector(dead_time_ns=75.0)
system = ml.System(period_ns=1e3 / 7.5, cycles=1000, bins=1024, pulse=pulse, detector=detector)
system

# %% [markdown]
# **A scene** is depth (m) and reflectivity of every pixel: from arrays, `ml.Scene(depth_m=..., reflectivity=...)`, from
# files, `ml.Scene.from_rgbd("depth.png", "colors.png")`, or built in.

# %%
scene = ml.Scene.example("room", size=(48, 64))
scene

# %% [markdown]
# **Flux**: S and B, expected detectable photons per laser period. `signal` is the mean of S, `sbr` the ratio of means.

# %%
flux = scene.flux(system, signal=1.0, sbr=1.0)
flux

# %% [markdown]
# **Simulate.** `engine="auto"` is faster for long exposures, and draws the same law. `ml.plot` draws what is in a cube.

# %%
counts = ml.simulate(flux, system, seed=0, progress=True)
print(counts.shape, counts.dtype, counts.sum(), "registrations")
ml.plot.map_image(counts[0].sum(-1), "registrations")

# %% [markdown]
# **Predict** a pixel without drawing anything: the exact law of its count, and the mean histogram with its covariance.

# %%
y, x = 20, 30
law = ml.count_law(flux[y, x], system)
print(f"drawn {counts[0, y, x].sum()}, expected {law.mean:.1f} ± {law.std:.1f}")
law

# %%
ml.joint_law(flux[y, x], system)

# %% [markdown]
# **Reconstruct**, and compare with the truth.

# %%
estimate = ml.reconstruct(counts, system)
error_m = np.abs(estimate.depth_m[0] - scene.depth_m)[estimate.detected[0]]
print(f"median error {1e3 * np.median(error_m):.1f} mm over {100 * estimate.detected.mean():.1f} % of the pixels")
estimate

# %% [markdown]
# **On to files**: `ml.io.simulate_to("cube.zarr", flux, system)` for cubes of any size, `ml.io.load`,
# `ml.plot.overview(cube)` for the picture of README; `ml.generate` for training sets; `mars-lidar --help` for all of it
# without Python.
