# %% [markdown]
# # When does a fold stay?
#
# ![Angle of a fold over yield curvature and gap](phase_diagram.jpg)
#
# A sheet is folded in half and pressed between two plates a gap $g$ apart, then let go. It keeps an angle only where its
# curvature exceeded the yield curvature $C_y$. The loop of an elastic sheet between two plates has the largest curvature
# $2.396/g$ (Matthewson, Kurkjian & Gulati, J. Am. Ceram. Soc. 69, 815 (1986)), so that the folds that stay lie below the
# hyperbola $C_y = 2.396/g$. `jc.sweep` runs all cases and returns an xarray Dataset. TODO

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxcrumple as jc

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

nodes = 200
gaps = np.linspace(0.016, 0.04, 7)  # m
yields = np.geomspace(15.0, 240.0, 9)  # 1/m
close, press, hold, relax = 0.5, 0.2, 0.05, 0.3  # s

# %%

def opening(setup, state):
    return {"angle": np.degrees(jc.fold_angle(setup.mesh, state.x))}


times = [close + press + hold, close + press + hold + relax]
table = jc.sweep(
    "fold",
    over={"gap": gaps, "yield_curvature": yields},
    times=times,
    settings={"nodes": nodes, "close": close, "press": press, "hold": hold, "relax": relax, "scheme": "quasistatic"},
    measure=opening,
    backend="processes",
)
print(table, np.unique(table.result))
import sys
np.set_printoptions(linewidth=200, precision=1, suppress=True)
print(table.angle.values[...,0]); print(table.angle.values[...,1]); print(table.attrs)
table.to_netcdf("phase.nc")
