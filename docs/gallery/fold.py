# %% [markdown]
# # A fold that keeps its angle
#
# ![A folded sheet after its release, and fold curvature against yield curvature](fold.jpg)
#
# A square sheet is folded in half, pressed between two plates, and released. Bending beyond the yield
# curvature $C_y$ is plastic, so the sheet opens only in part. Its final angle $\phi$ defines the fold
# curvature $c_f = 2 \cos(\phi / 2)$. A single hinge bent to $c_{max}$ keeps $c_f = c_{max} - c_0$, where its
# dimensionless yield curvature $c_0$ is proportional to $C_y$. The whole sheet follows the same law: $c_f$
# falls from 1.90 ($\phi$ = 37 degrees) at 25 1/m to 0.22 (168 degrees) at 150 1/m. The correlation of $c_f$
# and $C_y$ is -0.99 (Fig. 3b of Andrejevic & Rycroft, 2022). The script asserts less than -0.97. It takes 50
# CPU s on one core, compiling included (2026-11-28).

# %%
import jax
import numpy as np

import jaxcrumple as jc

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 400
yield_curvatures = [25, 50, 75, 100, 125, 150]  # 1/m
shown = 1  # index of the sheet in the picture
pixels = 700  # longer side of the sheet in the picture

# %% [markdown]
# The plates release the sheet at 0.8 s. Drag brings it to rest within 0.3 s.

# %%
solver = jc.integrator(rtol=1e-2, scheme="dynamic")
runs, angles = [], []
for yield_curvature in yield_curvatures:
    setup = jc.fold(nodes, material=jc.Material(yield_curvature=yield_curvature))
    state = jc.initial_state(setup.scene, setup.x)
    solution = jc.simulate(setup.scene, state, [0.8, 1.1], solver=solver, throw=True)
    runs.append(jc.Run.from_solution(setup.mesh, setup.scene, solution))
    angles.append(float(jc.fold_angle(setup.mesh, solution.state.x)))
c_f = 2.0 * np.cos(0.5 * np.array(angles))
slope, offset = np.polyfit(yield_curvatures, c_f, 1)
correlation = np.corrcoef(yield_curvatures, c_f)[0, 1]
print(np.rad2deg(angles).round(1), c_f.round(2), correlation)
assert np.all(np.diff(c_f) < 0)
assert correlation < -0.97

# %% [markdown]
# A picture holds a matplotlib figure, so a curve fits beside the sheet.

# %%
picture = jc.picture(runs[shown], field="paper", walls=False, view=(0.35, -1.0, 0.2), pixels=pixels)
axes = picture.beside(1.2, xlabel="yield curvature $C_y$ [1/m]", ylabel="fold curvature $c_f$ [-]")
axes.plot(yield_curvatures, np.polyval([slope, offset], yield_curvatures), color="grey")
axes.plot(yield_curvatures, c_f, "o", color="#d9541e")
for place, angle in zip(zip(yield_curvatures, c_f, strict=True), np.rad2deg(angles), strict=True):
    axes.annotate(f"{angle:.0f}°", place, (5, 4), textcoords="offset points", fontsize=8)
axes.margins(x=0.2, y=0.1)
picture.save("fold.jpg")
