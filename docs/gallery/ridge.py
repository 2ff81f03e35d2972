# %% [markdown]
# # A stretching ridge
#
# ![A sheet with a ridge between two corners, and its curvature against its thickness](ridge.jpg)
#
# Two frames bend opposite ends of an elastic sheet to a right angle. A ridge of length $X$ connects the two
# corners. A sharp ridge would cost too much bending energy, so its middle stretches and its curvature $C$
# stays finite. In the limit of vanishing thickness $h$, $C X \propto (X / h)^{1/3}$ (Lobkovsky et al.,
# Science 270, 1482 (1995)). For $X / h$ from 200 to 800 the fitted exponent is 0.332. The script asserts 1/3
# within 0.05. It takes 40 CPU s on one core, compiling included (2026-11-28).

# %%
import jax
import numpy as np

import jaxcrumple as jc

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 2000
length = 0.1  # m, of the ridge
thicknesses = [0.5e-3, 0.354e-3, 0.25e-3, 0.177e-3, 0.125e-3]  # m
pixels = 700  # longer side of the sheet in the picture

# %% [markdown]
# The frames close within 0.2 s. Drag then brings the sheet to rest.

# %%
curvatures = []
for thickness in thicknesses:
    material = jc.Material(thickness=thickness, yield_curvature=None)
    setup = jc.ridge(nodes, length=length, material=material, contact=None)
    state = jc.initial_state(setup.scene, setup.x)
    solver = jc.integrator(rtol=1e-2, scheme="dynamic")
    solution = jc.simulate(setup.scene, state, 0.3, solver=solver, throw=True)
    curvatures.append(jc.ridge_curvature(setup.mesh, solution.x[-1]))
exponent, _ = np.polyfit(np.log(thicknesses), np.log(curvatures), 1)
print(curvatures, exponent)
assert abs(exponent + 1 / 3) < 0.05

# %% [markdown]
# A picture holds a matplotlib figure, so a curve fits beside the sheet.

# %%
run = jc.Run.from_solution(setup.mesh, setup.scene, solution)
picture = jc.picture(run, field="curvature", view=(0.6, -0.8, -0.6), up=(0, 0, -1), pixels=pixels)
picture.figure.axes[1].set_ylabel("mean curvature [1/m]")
axes = picture.beside(1 / 1.3, xlabel="slenderness $X / h$ [-]", ylabel="$C X$ [-]")
slender = length / np.array(thicknesses)
axes.loglog(slender, length * curvatures[-1] * (slender / slender[-1]) ** (1 / 3), color="grey")
axes.loglog(slender, length * np.array(curvatures), "o", color="#d9541e")
axes.minorticks_off()
axes.set_xticks([200, 400, 800], ["200", "400", "800"])
axes.set_yticks([6, 7, 8, 9, 10], ["6", "7", "8", "9", "10"])
axes.annotate("$(X/h)^{1/3}$", (0.2, 0.7), xycoords="axes fraction")
picture.save("ridge.jpg")
