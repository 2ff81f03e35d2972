# %% [markdown]
# # A disc pressed into a spherical die
#
# ![The disc between ball and die, and its outline](stamping.jpg)
#
# A ball presses a disc of 10 cm to the bottom of a spherical die (Fig. 7 of Andrejevic & Rycroft, 2022; Hure,
# Roman & Bico, Phys. Rev. Lett. 109, 054302 (2012)). On a sphere of radius $R$ a circle at the distance $a$
# from the pole has the radius $R \sin(a / R)$, less than the radius $a$ of the flat disc. A sheet that
# stretches little must therefore fold. The length of the rim stays the same to 0.1 %, and its mean distance
# from its centre is $R \sin(a / R)$ to 2 %; the script asserts 2 and 5 %. Small folds and one overlap take up
# the excess length of 18 %. No two layers intersect. The script takes 4 CPU minutes on one core, one of them
# for compiling (2026-11-28).

# %%
import jax
import numpy as np

import jaxcrumple as jc
from jaxcrumple.measure import count_intersections, edge_strain

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 800
contact = "inverse-power"
disc, die = 0.05, 0.053  # m, radii
gap = 5e-3  # m, between ball and die in the end
speed = 0.02  # m/s
pixels = 700  # longer side of the sheet in the picture

# %% [markdown]
# The ball stops when the gap between ball and die is 5 mm everywhere.

# %%
setup = jc.stamping(nodes, radius=disc, die=die, gap=gap, speed=speed, contact=contact)
state = jc.initial_state(setup.scene, setup.x)
t_end = (die - gap - np.sqrt(die**2 - disc**2)) / speed
times = np.linspace(0.25, 1, 4) * t_end
solution = jc.simulate(setup.scene, state, times, solver=jc.integrator(rtol=1e-2), throw=True)

# %%
mesh, x = setup.mesh, solution.x[-1]
rim = mesh.boundary_nodes
rim = rim[np.argsort(np.arctan2(mesh.vertices[rim, 1], mesh.vertices[rim, 0]))]
outline = x[np.append(rim, rim[0])] - x[rim].mean(axis=0)
length = np.linalg.norm(np.diff(outline, axis=0), axis=1).sum() / (2 * np.pi * disc)
distance = np.linalg.norm(outline[1:], axis=1).mean()  # m, of the rim from its middle
middle = die - 0.5 * gap  # m, radius of the sphere halfway between ball and die
circle = middle * np.sin(disc / middle)
print(length, distance / circle, disc / circle, np.quantile(np.abs(edge_strain(mesh, x)), 0.9))
assert abs(length - 1) < 0.02
assert abs(distance / circle - 1) < 0.05
assert disc / circle > 1.1
assert contact is None or count_intersections(mesh, x) == 0

# %%
run = jc.Run.from_solution(mesh, setup.scene, solution)
picture = jc.picture(run, field="paper", walls=False, view=(-0.2, -0.8, 1.0), pixels=pixels)
axes = picture.beside(1 / 1.1, xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
turn = np.linspace(0, 2 * np.pi, 200)
axes.plot(
    1e3 * circle * np.cos(turn), 1e3 * circle * np.sin(turn), "--", color="grey", label="circle on the sphere"
)
axes.plot(*1e3 * outline[:, :2].T, color="#d9541e", label="rim")
axes.legend(loc="center", fontsize=8, frameon=False)
picture.save("stamping.jpg")
