# %% [markdown]
# # A sheet folds where it is thin
#
# ![A strip with a thin band under end shortening, and its bending moment along the strip](thickness.jpg)
#
# A strip is 0.3 mm thick, but half as thick in a band of 1 cm. Its two hinged ends move together. The strip
# folds at the band, where its bending stiffness is an eighth: `Material(thickness=...)` takes one thickness
# for each node. In equilibrium the bending moment $\tfrac{8}{9}\kappa(h) W C$, with the curvature $C$,
# equals the thrust times the height of the strip over the line of the thrust. The measured curvatures agree
# with this within 10 % of the largest moment. Run time: 12 CPU s (2026-11-28, one core, warm).

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

import jaxcrumple as jc

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

across = 12  # nodes across the strip
pixels = 700
width, length, shortening = 0.02, 0.1, 0.35  # m, m, share of the length
thick, thin, band = 0.3e-3, 0.15e-3, 0.005  # m

# %% [markdown]
# Straight rows of a triangular lattice lie across the strip. One held row is a hinge. The strip has a
# stress-free rise of 0.5 mm.

# %%
spacing = width / (across - 0.5)
rows = round(length / (spacing * np.sqrt(0.75)))
flat = jc.hexagonal(across, rows, spacing, reorder=False)
along = flat.vertices[:, 1] / np.ptp(flat.vertices[:, 1]) * length
rise = 5e-4 * np.cos(np.pi * along / length)
mesh = flat.with_rest_shape(np.column_stack([along, flat.vertices[:, 0], rise]))
thickness = thick - (thick - thin) * np.exp(-(((along - 0.2 * length) / band) ** 2))
material = jc.Material(thickness=thickness, yield_curvature=None)

ends = np.isclose(np.abs(along), 0.5 * length)
velocity = np.where(ends, -0.5 * shortening * length * np.sign(along), 0.0)  # m per unit of time
motion = jc.LinearMotion(jnp.asarray(mesh.vertices), jnp.asarray(np.outer(velocity, [1.0, 0.0, 0.0])))
hinges = jc.Prescribed(jnp.asarray(np.repeat(ends[:, None], 3, axis=1)), motion)
scene = jc.sheet(mesh, material, prescribed=hinges)
state = jc.initial_state(scene, mesh.vertices)
for t in np.linspace(0.02, 1.0, 25):
    rest = jc.relax(scene, state, t=t)
    assert rest.converged and rest.negative == 0, rest.reason
    state = rest.state
thrust = jc.reaction(scene, state.x, state.v, state.p, state.t)[along < -0.49 * length, 0].sum()

# %% [markdown]
# Curvature and height of each row, from the mean position of its nodes.

# %%
path = np.asarray(state.x).reshape(rows + 1, across, 3).mean(axis=1)
step = np.diff(path[:, [0, 2]], axis=0)
turn = np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
rigidity = material.bending_rigidity.reshape(rows + 1, across)[1:-1, 0]
bending = -(8 / 9) * rigidity * width * turn / np.linalg.norm(step, axis=1)[1:]
leverage = np.abs(thrust) * path[1:-1, 2]
error = np.abs(bending - leverage).max() / leverage.max()
place = 1e3 * along.reshape(rows + 1, across)[:, 0]
sharp = along.reshape(rows + 1, across)[1 + np.argmax(np.abs(turn)), 0]
print(f"thrust {thrust:.4f} N, error {error:.1%}, sharpest at {1e3 * sharp:.1f} mm")

assert error < 0.1
assert abs(sharp - 0.2 * length) < band

# %%
figure = plt.figure(figsize=(7.5, 4.2), layout="constrained")
left, right = figure.subfigures(1, 2, width_ratios=[1.1, 1])
x, color = np.asarray(state.x), 1e3 * thickness
axes, scale = left.subplots(), ScalarMappable(Normalize(1e3 * thin, 1e3 * thick))
jc.draw_sheet(mesh, x, color, axes=axes, scale=scale, view=(-0.5, -1.0, 0.4), pixels=pixels)
ticks = [1e3 * thin, 1e3 * thick]
left.colorbar(scale, ax=axes, location="bottom", label="thickness [mm]", shrink=0.7, ticks=ticks)
upper, lower = right.subplots(2, sharex=True)
upper.plot(place[1:-1], np.abs(turn) / np.linalg.norm(step, axis=1)[1:], color="black")
upper.set(ylabel="curvature [1/m]", ylim=(0, None))
lower.plot(place[1:-1], 1e3 * leverage, color="gray", label="thrust times height")
lower.plot(place[1:-1], 1e3 * bending, ".", color="tab:orange", label="stiffness times curvature")
lower.set(xlabel="place along the strip [mm]", ylabel="moment [mN m]")
lower.legend(fontsize=8)
figure.savefig("thickness.jpg", dpi=120, pil_kwargs={"quality": 85})
