# %% [markdown]
# # Creases that grow by the logarithm
#
# ![The sheet under its last compression, and crease length against cycle](axial.jpg)
#
# A square sheet of 10 cm is rolled up, pressed along its axis from 10 to 4.5 cm, unfolded and flattened, five
# times (Fig. 9 of Andrejevic & Rycroft, 2022). Self-contact is off, which makes the run cheap. In experiments
# the length of all creases grows as $c_1 \ln(1 + c_2 n)$ with the cycle $n$ (Gottesman et al., Communications
# Physics 1, 70 (2018)), because a sheet folds again along its old creases. Here the creases are 1.6 m long
# after one cycle and 3.1 m after five. Relative to the mean length, the residuals of the logarithm are 3 %,
# and those of a line 7 %; the script asserts less than 10 % for the logarithm. A sheet without memory would
# reach 8.1 m; the script asserts less than 60 % of that. It takes 100 CPU s on one core, compiling included
# (2026-11-28).

# %%
import jax
import numpy as np

import jaxcrumple as jc
from jaxcrumple.measure import crease_length, fit_growth

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 200
cycles = 5
height = 0.045  # m, under compression
gap = 2e-3  # m, between the planes that flatten the sheet
sheet = {"thickness": 0.25e-3, "yield_curvature": 200.0}  # m, 1/m
parts = {"roll": 0.1, "compress": 0.2, "open": 0.03, "unfold": 0.12, "flatten": 0.08, "rest": 0.04}  # s
pixels = 700  # longer side of the sheet in the picture

# %%
material = jc.Material(**sheet)
options = {"height": height, "gap": gap, "material": material, "contact": None}
setup = jc.axial(nodes, seed=1, cycles=cycles, **options, **parts)
state = jc.initial_state(setup.scene, setup.x)
cycle, lasts = np.arange(1, cycles + 1), sum(parts.values())
pressed = (cycle - 1) * lasts + parts["roll"] + parts["compress"]
times = np.stack([pressed, cycle * lasts], axis=1).ravel()
solution = jc.simulate(setup.scene, state, times, solver=jc.integrator(rtol=1e-2), throw=True)

# %%
length = np.array([crease_length(setup.mesh, p) for p in solution.p[1::2]])  # m, after each cycle
laws = fit_growth(cycle, length)
rms = np.sqrt(laws.rss / cycles) / length.mean()
print(length, rms, sep="\n")
assert rms["logarithmic"] < 0.1
assert length[-1] < 0.6 * cycles * length[0]

# %%
run = jc.Run.from_solution(setup.mesh, setup.scene, solution)
picture = jc.picture(run, -2, field="damage", walls=False, pixels=pixels)
picture.figure.axes[1].set_ylabel("plastic curvature $p$ [-]")
axes = picture.beside(xlabel="cycle $n$", ylabel="crease length [m]")
n, (c1, c2) = np.linspace(0, cycles, 100), laws.loc["logarithmic", ["c1", "c2"]]
axes.plot(n, c1 * np.log1p(c2 * n), color="grey", label=r"$c_1 \ln(1 + c_2 n)$")
axes.plot(cycle, length, "o", color="#d9541e")
axes.legend(loc="lower right", frameon=False)
picture.save("axial.jpg")
