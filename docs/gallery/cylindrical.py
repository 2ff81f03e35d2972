# %% [markdown]
# # A rolled sheet pressed along its axis
#
# ![The roll after its compression, and the force against its height](cylindrical.jpg)
#
# A square sheet of 10 cm, rolled up in a cylinder of radius 1.7 cm, is pressed along its axis to 6 cm (Fig. 7
# of Andrejevic & Rycroft, 2022; self-contact is off here). A perfect cylinder of radius $R$ buckles at the
# axial force $2 \sqrt{\kappa Y} / R$ per length of its circumference, with the bending rigidity $\kappa$ and
# the two-dimensional Young modulus $Y$. Real cylinders buckle earlier, and their force then drops (von Karman
# & Tsien, J. Aeronaut. Sci. 8, 303 (1941)). The force on the upper plane peaks at 0.34 of that of a perfect
# cylinder, and its median afterwards is 0.06 of it. The script asserts a peak between 0.1 and 1, and a median
# below half the peak. It takes 60 CPU s on one core, compiling included (2026-11-28).

# %%
import jax
import numpy as np

import jaxcrumple as jc
from jaxcrumple.measure import wall_force

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 400
size, radius = 0.1, 0.017  # m, edge of the sheet and radius of the cylinder
height = 0.06  # m, in the end
compress = 0.2  # s
frames = 80
pixels = 700  # longer side of the sheet in the picture

# %%
setup = jc.cylindrical(nodes, size=size, radius=radius, height=height, compress=compress, contact=None)
state = jc.initial_state(setup.scene, setup.x)
times = np.linspace(0, compress, frames + 1)[1:]
solution = jc.simulate(setup.scene, state, times, solver=jc.integrator(rtol=1e-2), throw=True)
upper = setup.scene.walls[2]  # after the cylinder and the lower plane
force = np.array([wall_force(upper, x, t) for x, t in zip(solution.x, times, strict=True)])  # N

# %%
material = setup.material
classical = size * 2 * np.sqrt(material.bending_rigidity * material.young_modulus_2d) / radius  # N
tall = np.ptp(solution.x[:, :, 2], axis=1)  # m
peak = np.argmax(force[tall > 0.95 * size])
print(force[peak] / classical, np.median(force[peak + 1 :]) / classical, 1 - tall[peak] / size)
assert 0.1 < force[peak] / classical < 1.0
assert np.median(force[peak + 1 :]) < 0.5 * force[peak]

# %%
run = jc.Run.from_solution(setup.mesh, setup.scene, solution)
picture = jc.picture(run, field="paper", walls=False, view=(0.7, -0.8, 0.4), pixels=pixels)
axes = picture.beside(1.4, xlabel="height [cm]", ylabel="force [N]")
axes.plot(100 * tall, force, color="#d9541e")
axes.axhline(classical, color="grey", linestyle="--", label="buckling of a perfect cylinder")
axes.set_xlim(100 * size, 100 * height)
axes.set_ylim(0, 1.2 * classical)
axes.legend(loc="center right", fontsize=8, frameon=False)
picture.save("cylindrical.jpg")
