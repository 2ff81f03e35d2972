# %% [markdown]
# # An arch that snaps
#
# ![The arch before and after its snap, and its load against its height](snap.jpg)
#
# A clamped arch carries a load at midspan. Under a prescribed height the force rises to a limit point and
# then falls. Under a dead load that grows slowly the arch leaves this curve at the limit point and snaps to
# the inverted shape. Shallow-arch theory predicts the limit load $237\,B f/L^3$ for the span $L$, the rise
# $f$ and the bending stiffness $B = \tfrac{8}{9}\kappa W$ of a narrow strip of width $W$. The limit point
# lies within 15 % of it (here 4 %), and the dead load at the snap within 5 % of the limit point. Run time:
# 22 CPU s (2026-11-28, one core, warm).

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxcrumple as jc

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 1000
heights = 40
pixels = 700
length, width, rise = 0.03, 0.006, 0.002  # m
load, ramp = 0.2, 0.2  # N, s

setup = jc.arch(nodes, length=length, width=width, rise=rise, load=load, ramp=ramp)
limit = 237 * (8 / 9) * setup.material.bending_rigidity * width * rise / length**3  # N
middle = np.abs(setup.x[:, 0]) < 1e-9

# %% [markdown]
# **Prescribed height.** A support moves the middle row down. `jc.relax` finds the equilibrium at each
# height; the load is the reaction of the support.

# %%
held = setup.scene.prescribed.mask.at[:, 2].max(middle)
travel = jnp.where(middle[:, None], jnp.array([0.0, 0.0, -1.7 * rise]), 0.0)  # m per unit of time
support = jc.Prescribed(held, jc.LinearMotion(setup.x, travel))
pushed = jc.sheet(setup.mesh, setup.material, prescribed=support)
state, curve = jc.initial_state(pushed, setup.x), []
for t in jnp.linspace(0, 1, heights):
    rest = jc.relax(pushed, state, t=t)
    assert rest.converged, rest.reason
    state = rest.state
    push = -jc.reaction(pushed, state.x, state.v, state.p, t)[middle, 2].sum()
    curve.append((state.x[middle, 2].mean(), push))
height, force = np.array(curve).T
top = force[height > 0].max()

# %% [markdown]
# **Dead load.** The middle row carries a load that grows to 0.2 N in 0.2 s.

# %%
start = jc.initial_state(setup.scene, setup.x)
run = jc.simulate(setup.scene, start, jc.frame_times(ramp, 100), solver=jc.integrator(rtol=1e-3))
seen, carried = run.x[:, middle, 2].mean(axis=1), load * run.t / ramp
snap = np.argmin(np.diff(seen))  # the last frame before the snap
print(f"limit point {top:.3f} N, theory {limit:.3f} N, snap at {carried[snap]:.3f} N")

assert run.result == "success" and seen[-1] < -0.5 * rise
assert abs(top / limit - 1) < 0.15
assert abs(carried[snap] / top - 1) < 0.05

# %%
figure = plt.figure(figsize=(7.5, 4.2), layout="constrained")
grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.2])
for row, frame in enumerate((0, -1)):
    axes = figure.add_subplot(grid[row, 0])
    look = {"within": run.x, "view": (-0.3, -1.0, 0.25), "pixels": pixels}
    jc.draw_sheet(setup.mesh, run.x[frame], "#e8a25c", axes=axes, **look)
    axes.set_title(f"dead load {carried[frame]:.1f} N")
axes = figure.add_subplot(grid[:, 1])
axes.axhline(limit, color="gray", linestyle="--", label="theory, $237\\,Bf/L^3$")
axes.plot(1e3 * height, force, label="prescribed height")
axes.plot(1e3 * seen, carried, ".", label="dead load")
axes.set(xlabel="height of the middle [mm]", ylabel="load [N]", ylim=(0, 0.23))
axes.invert_xaxis()
axes.legend(loc="upper center", fontsize=9)
figure.savefig("snap.jpg", dpi=120, pil_kwargs={"quality": 85})
