"""Writes what files_of_0.1.0.zip holds: run once, by version 0.1.0, in an empty folder.

Its system.yaml is what `mars-lidar init` wrote.
"""

import numpy as np

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.maps import save_maps

PLAIN = ml.System(
    period_ns=100.0, cycles=200, bins=32, pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=40.0)
)
DETECTOR = ml.Detector(
    dead_time_ns=40.0,
    jitter=ml.Jitter(sigma_ns=0.3),
    dark_count_hz=1e4,
    afterpulsing=ml.Afterpulsing(probability=0.01, delay_ns=30.0),
)
RECIPE = """scenes:
  - example: room
    size: [6, 8]
systems:
  - period_ns: 100.0
    cycles: 50
    bins: 32
    pulse: {kind: gaussian, sigma_ns: 1.0}
    detector: {dead_time_ns: 40.0}
light: {signal: [0.5], sbr: [1.0]}
realizations: 2
"""

system, scene = PLAIN.replace(detector=DETECTOR), ml.Scene.example("room", size=(3, 4))
flux = scene.flux(system, signal=0.5, sbr=1.0)
for suffix in ("zarr", "h5", "npz"):
    io.simulate_to(
        f"cube.{suffix}",
        flux,
        system,
        realizations=2,
        seed=3,
        depth_m=scene.depth_m,
        reflectivity=scene.reflectivity,
    )
for suffix in ("mat", "ptu"):
    io.convert("cube.h5", f"cube.{suffix}", realization=0)
times = ml.simulate_timestamps(flux, system, seed=3)
for suffix in ("npz", "h5", "ptu"):
    times.save(f"stream.{suffix}")
ml.Table.build(PLAIN, signal=(0.1, 1, 3), background=(0.1, 1, 3), threads=1).save("table.h5")
counts = np.asarray(io.load("cube.h5").histogram)
maps = {method: ml.reconstruct(counts, system, method=method) for method in ("peak", "maximum_likelihood")}
for suffix in ("zarr", "h5", "npz"):
    save_maps(f"maps.{suffix}", maps)
with open("recipe.yaml", "w") as file:
    file.write(RECIPE)
ml.generate("recipe.yaml", "set.zarr", threads=1)
np.savez("expected.npz", cube=counts, times_ns=times.times_ns, depth=scene.depth_m)
