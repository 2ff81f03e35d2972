# %% [markdown]
# # Eight sheets, two ways to fold
#
# ![Two sheets of the ensemble, and the crease lengths of all against the radius of the sphere](ensemble.jpg)
#
# Eight sheets that differ only in mesh and imperfection (the seed) crumple in a sphere that shrinks. The
# seed decides how a sheet buckles first. Here four sheets end with about 0.9 m of creases and four with
# about 1.4 m. A single run does not tell this, nor does the mean. A bootstrap estimates the uncertainty of
# the mean. Its standard error agrees with $s/\sqrt n$, for the standard deviation $s$ of $n$ sheets, within
# 30 %. The ratio of $s$ to the mean falls by more than half while the sphere shrinks. Run time: 35 CPU s
# (2026-11-28, one core, warm).

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import bootstrap

import jaxcrumple as jc
from jaxcrumple.measure import crease_length

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 200
seeds = 8
pixels = 500
radius, speed = 0.071, 0.02  # m, m/s
times = np.linspace(0.2, 1.2, 11)  # s
material = jc.Material(yield_curvature=25.0)  # 1/m

lengths, sheets = [], []
for seed in range(seeds):
    setup = jc.radial(nodes, seed, contact=None, material=material, speed=speed)
    start = jc.initial_state(setup.scene, setup.x)
    solution = jc.simulate(setup.scene, start, times, solver=jc.integrator(rtol=2e-2))
    assert solution.result == "success"
    lengths.append([crease_length(setup.mesh, p) for p in solution.p])
    sheets.append((setup.mesh, solution.x[-1]))
lengths = np.array(lengths)  # (seeds, times) m

# %%
mean, spread = lengths.mean(axis=0), lengths.std(axis=0, ddof=1)
found = bootstrap((lengths,), np.mean, axis=0, method="percentile", rng=0)
error = found.standard_error
ratio = spread / mean
print(f"{mean[-1]:.2f} m +- {error[-1]:.2f} m; spread over mean {ratio[5]:.2f}, {ratio[-1]:.2f}")

assert np.all(np.diff(mean) > 0)
assert abs(error[-1] / (spread[-1] / np.sqrt(seeds)) - 1) < 0.3
assert ratio[-1] < 0.5 * ratio[5]

# %%
figure = plt.figure(figsize=(7.5, 4.2), layout="constrained")
grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.9])
for row, number in enumerate((np.argmin(lengths[:, -1]), np.argmax(lengths[:, -1]))):
    axes = figure.add_subplot(grid[row, 0])
    mesh, x = sheets[number]
    jc.draw_sheet(mesh, x, "#e8a25c", axes=axes, pixels=pixels)
    axes.set_title(f"seed {number}: {lengths[number, -1]:.2f} m", fontsize=10)
axes = figure.add_subplot(grid[:, 1])
place = 1e2 * (radius - speed * times)  # cm
axes.plot(place, lengths.T, color="gray", linewidth=0.7)
axes.plot(place, mean, color="tab:orange", linewidth=2.5, label=f"mean of {seeds}")
axes.fill_between(place, *found.confidence_interval, color="tab:orange", alpha=0.3, label="95 %, bootstrap")
axes.set(xlabel="radius of the sphere [cm]", ylabel="crease length [m]")
axes.invert_xaxis()
axes.legend(loc="upper left")
figure.savefig("ensemble.jpg", dpi=120, pil_kwargs={"quality": 85})
