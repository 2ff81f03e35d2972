# %% [markdown]
# # A disc pulled through a hole
#
# ![The disc below the plate, and its section with the plate](conical.jpg)
#
# A disc of 10 cm lies on a plate with a round hole of 3 cm. Its middle is pulled by 2.5 cm through the hole
# (Fig. 7 of Andrejevic & Rycroft, 2022; Mellado, Cheng & Concha, Phys. Rev. E 83, 036607 (2011)). The disc
# does not become narrower by compression. Its section with the plate is 1.95 times as long as the
# circumference of the hole, so it folds into layers, and none intersect. A sheet that does not stretch is
# made of cones, so its creases are radial: the mean $|\cos|$ of the angle between crease and radius is 0.81.
# For all edges of the mesh, which have no preferred direction, it is $2 / \pi$ = 0.64. The script asserts a
# length of at least 1.3 and a mean of at least 0.7. It takes 5 CPU minutes on one core, one of them for
# compiling (2026-11-28).

# %%
import jax
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle

import jaxcrumple as jc
from jaxcrumple.measure import count_intersections, crease_pattern, cross_section

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 500
contact = "inverse-power"
yield_curvature = 200.0  # 1/m
opening = 0.015  # m, radius of the hole
pull = 0.025  # m
speed = 0.02  # m/s
pixels = 700  # longer side of the sheet in the picture

# %%
material = jc.Material(yield_curvature=yield_curvature)
setup = jc.conical(nodes, opening=opening, pull=pull, speed=speed, material=material, contact=contact)
state = jc.initial_state(setup.scene, setup.x)
times, solver = np.linspace(0.1, 1, 10) * pull / speed, jc.integrator(rtol=1e-2)
solution = jc.simulate(setup.scene, state, times, solver=solver, throw=True)

# %%
mesh, x = setup.mesh, solution.x[-1]
section = cross_section(mesh, x, (0, 0, 0), (0, 0, 1))
winding = section.length / (2 * np.pi * opening)
edges = mesh.vertices[mesh.hinges[:, :2], :2]  # both ends of the edges of the flat disc
along, middle = edges[:, 1] - edges[:, 0], edges.mean(axis=1)
size = np.linalg.norm(along, axis=1)
radial = np.abs(np.sum(along * middle, axis=1)) / (size * np.linalg.norm(middle, axis=1))
creased = crease_pattern(mesh, solution.p[-1]) != 0
crease_cos, mesh_cos = np.average(radial[creased], weights=size[creased]), np.average(radial, weights=size)
widest = np.linalg.norm(section.ends, axis=-1).max() / opening
print(winding, widest, crease_cos, mesh_cos)
assert winding > 1.3
assert widest < 1.2
assert crease_cos > 0.7
assert contact is None or count_intersections(mesh, x) == 0

# %%
run = jc.Run.from_solution(mesh, setup.scene, solution)
picture = jc.picture(run, field="paper", walls=False, view=(-0.45, -0.8, 0.3), pixels=pixels)
axes = picture.beside(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
axes.set_title("section with the plate", fontsize=10)
axes.add_patch(Circle((0, 0), 1e3 * opening, color="#cfe0ee"))
axes.add_collection(LineCollection(1e3 * section.ends, color="#d9541e", capstyle="round"))
axes.autoscale_view()
picture.save("conical.jpg")
