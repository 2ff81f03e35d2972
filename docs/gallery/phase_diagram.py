# %% [markdown]
# # When does a fold stay?
#
# ![The angle that a fold keeps, over the gap of the press and the yield curvature](phase_diagram.jpg)
#
# A sheet is folded in half, pressed between two plates a gap $g$ apart, and let go. It keeps an angle only
# if its curvature exceeded the yield curvature $C_y$. The loop of an elastic sheet between two plates has
# the largest curvature $2.396/g$ (Matthewson, Kurkjian & Gulati, J. Am. Ceram. Soc. 69, 815 (1986)). So a
# fold stays only below the hyperbola $C_y = 2.396/g$. `jc.sweep` runs all cases in worker processes and
# returns an xarray Dataset. Every fold opens to more than 170 degrees for $C_y > 1.2 \cdot 2.396/g$, and to
# less than 150 degrees for $C_y < 0.5 \cdot 2.396/g$. Run time: about two CPU minutes (2026-11-28, two
# workers, warm).

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxcrumple as jc

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 200
gaps = [0.016, 0.024, 0.032, 0.04]  # m
yields = np.geomspace(15.0, 240.0, 9)  # 1/m
backend = "processes"


# %%
def opening(setup, state):
    return {"angle": np.degrees(jc.fold_angle(setup.mesh, state.x))}


table = jc.sweep(
    "fold",
    over={"gap": gaps, "yield_curvature": yields},
    times=[1.05],  # s; the press opens at 0.75 s
    settings={"nodes": nodes, "press": 0.2, "scheme": "quasistatic"},
    measure=opening,
    backend=backend,
)
angle = table.angle.isel(time=-1).assign_attrs(long_name="angle between the halves", units="degrees")
theory = 2.396 / angle.gap
print(angle.to_pandas().round(1))

assert np.all(table.result == "success")
assert angle.where(angle.yield_curvature > 1.2 * theory).min() > 170
assert angle.where(angle.yield_curvature < 0.5 * theory).max() < 150

# %%
figure, axes = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
shown = angle.assign_coords(gap=1e3 * angle.gap)
shown.plot.contourf(x="gap", y="yield_curvature", levels=np.arange(30, 181, 15), cmap="viridis", ax=axes)
axes.scatter(*np.meshgrid(shown.gap, shown.yield_curvature), color="white", s=8, clip_on=False)
fine = np.linspace(gaps[0], gaps[-1])
axes.plot(1e3 * fine, 2.396 / fine, color="tab:red", linewidth=3)
axes.annotate("$C_y = 2.396/g$", (1e3 * fine[20], 1.1 * 2.396 / fine[20]), color="tab:red", fontsize=13)
axes.text(0.97, 0.94, "springs open", transform=axes.transAxes, ha="right", va="top", fontsize=13)
axes.text(0.03, 0.06, "stays folded", transform=axes.transAxes, color="white", fontsize=13)
axes.set(xlabel="gap $g$ [mm]", ylabel="yield curvature $C_y$ [1/m]", yscale="log", title="")
axes.set_yticks([20, 50, 100, 200], ["20", "50", "100", "200"])
axes.minorticks_off()
figure.savefig("phase_diagram.jpg", dpi=120, pil_kwargs={"quality": 85})
