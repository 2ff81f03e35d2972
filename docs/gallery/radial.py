# %% [markdown]
# # A sheet in a shrinking sphere
#
# ![The sheet in its sphere, and the energy that takes up the work of the sphere](radial.jpg)
#
# A square sheet of 10 cm, 0.125 mm thick, crumples in a sphere that shrinks from 7.1 to 3.1 cm (Fig. 5 of
# Andrejevic & Rycroft, 2022). The ledger of the run splits the work of the sphere into stored energy and
# dissipation. Both add up to the work; the script asserts 1 %. Of 41 mJ, plastic creases dissipate 35 %,
# bending stores 32 % and drag dissipates 28 %. Stretching stores 1.5 %: a thin sheet bends rather than
# stretches. No two layers intersect. The script takes 5 CPU minutes on one core, one of them for compiling
# (2026-11-28).

# %%
import jax
import numpy as np

import jaxcrumple as jc
from jaxcrumple.measure import count_intersections

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 1000
contact = "inverse-power"
t_end = 4.0  # s
pixels = 700  # longer side of the sheet in the picture

# %%
setup = jc.radial(nodes, material=jc.Material(thickness=0.125e-3), contact=contact)
state = jc.initial_state(setup.scene, setup.x, ledger=True)
times, solver = np.linspace(t_end / 8, t_end, 8), jc.integrator(rtol=2e-2)
solution = jc.simulate(setup.scene, state, times, solver=solver, throw=True)
ledger = 1e3 * solution.history.drop(columns="stage")  # energies in mJ
stored = ledger[["stretch", "bending", "contact", "walls", "kinetic"]]
lost = -ledger[["work_plastic", "work_drag", "work_damping", "work_numerical"]]
work = ledger["work_walls"]
radius = 0.071 - 0.01 * solution.history["t"]  # m

# %%
total = stored.sum(axis=1) + lost.sum(axis=1)
print((lost.iloc[-1] / work.iloc[-1]).round(3), (stored.iloc[-1] / work.iloc[-1]).round(3), work.iloc[-1])
assert abs(total.iloc[-1] - work.iloc[-1]) < 0.01 * work.iloc[-1]
assert lost["work_numerical"].abs().iloc[-1] < 0.03 * work.iloc[-1]
assert stored["stretch"].iloc[-1] < 0.2 * stored["bending"].iloc[-1]
assert np.linalg.norm(solution.x[-1], axis=1).max() < radius.iloc[-1]
assert contact is None or count_intersections(setup.mesh, solution.x[-1]) == 0

# %%
run = jc.Run.from_solution(setup.mesh, setup.scene, solution)
picture = jc.picture(run, field="paper", pixels=pixels)
axes = picture.beside(1.1, xlabel="radius of the sphere [cm]", ylabel="energy [mJ]")
parts = {
    "bending": stored["bending"],
    "stretch, contact": stored.drop(columns="bending").sum(axis=1),
    "creases": lost["work_plastic"],
    "drag, damping": lost.drop(columns="work_plastic").sum(axis=1),
}
colors = ["#d9541e", "#7a2e0e", "#1f6fb4", "#a9cbe8"]
axes.stackplot(100 * radius, *parts.values(), labels=parts, colors=colors)
axes.plot(100 * radius, work, "k--", label="work of the sphere")
axes.set_xlim(100 * radius.iloc[0], 100 * radius.iloc[-1])
axes.legend(loc="upper left", fontsize=8, frameon=False)
picture.save("radial.jpg")
