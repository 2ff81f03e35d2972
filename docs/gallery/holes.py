# %% [markdown]
# # Slits make a sheet soft
#
# ![A sheet with slits under tension, and its force against strain](holes.jpg)
#
# Slits turn stretching into bending. Under a small strain a sheet with staggered slits (kirigami) resists in
# its plane, with a force in proportion to its thickness $h$. Then its strips buckle and turn out of the
# plane, and the force becomes that of bending, in proportion to $h^3$ (Isobe & Okumura, Sci. Rep. 6, 24758
# (2016)). Two thicknesses tell the exponent: 0.9 to 1.2 at a strain of $2\cdot10^{-5}$, 2.4 to 3.2 from 2 %
# on. At 4 % the thinner sheet carries less than 1/100 of the force of a whole sheet. Run time: 18 CPU s
# (2026-11-28, one core, warm).

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxcrumple as jc

jax.config.update("jax_enable_x64", True)
jc.enable_compilation_cache()

columns = 30
rows = 32
pixels = 700
period, slit = 12, 8  # length of the pattern and of its slits, in node distances
spacing = 2.5e-3  # m
thicknesses = [0.1e-3, 0.2e-3]  # m
strains = np.array([2e-5, 0.005, 0.01, 0.02, 0.04, 0.06, 0.08, 0.1])

# %% [markdown]
# **Mesh.** Every fourth row of triangles loses the triangles of its slits, which are staggered.
# `Mesh.from_arrays` checks what is left and drops unused nodes. A stress-free waviness of 10 µm selects the
# side to which the strips bend.

# %%
whole = jc.hexagonal(columns, rows, spacing, reorder=False)
middle = whole.vertices[whole.faces].mean(axis=1) / spacing
row = np.floor(middle[:, 1] / np.sqrt(0.75) + rows / 2).astype(int)
phase = (middle[:, 0] + 0.5 * period * (row // 4 % 2)) % period
cut = (row % 4 == 2) & (np.abs(phase - 0.5 * period) < 0.5 * slit)
wavy = whole.vertices.copy()
wavy[:, 2] = 1e-5 * np.random.default_rng(0).normal(size=len(wavy))
mesh = jc.Mesh.from_arrays(wavy, whole.faces[~cut])


# %%
def pulled(mesh, thickness):
    """Return forces in N at the strains, and the last positions."""
    y = mesh.vertices[:, 1]
    ends = np.isclose(np.abs(y), y.max())
    velocity = np.outer(np.where(ends, y, 0.0), [0.0, 1.0, 0.0])  # m per unit of strain
    motion = jc.LinearMotion(jnp.asarray(mesh.vertices), jnp.asarray(velocity))
    grips = jc.Prescribed(jnp.asarray(np.repeat(ends[:, None], 3, axis=1)), motion)
    scene = jc.sheet(mesh, jc.Material(thickness=thickness, yield_curvature=None), prescribed=grips)
    state, force = jc.initial_state(scene, mesh.vertices), []
    for t in strains:
        rest = jc.relax(scene, state, t=t)
        assert rest.converged, rest.reason
        state = rest.state
        force.append(jc.reaction(scene, state.x, state.v, state.p, t)[ends & (y > 0), 1].sum())
    return np.array(force), np.asarray(state.x)


forces, shapes = zip(*[pulled(mesh, thickness) for thickness in thicknesses], strict=True)
whole_force = 1e9 * np.outer(thicknesses, strains) * columns * spacing  # N: Young's modulus, section, strain
power = np.log2(forces[1] / forces[0])
print("exponents", power.round(2), "share of a whole sheet", (forces / whole_force).round(4)[:, [0, -1]])

assert 0.9 < power[0] < 1.2
assert np.all(np.abs(power[strains >= 0.02] - 2.8) < 0.4)
assert forces[0][strains == 0.04] < 0.01 * whole_force[0][strains == 0.04]

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.5, 4.2), layout="constrained")
view = {"view": (0.35, -0.5, 1.0), "up": (0.0, 1.0, 0.0)}
jc.draw_sheet(mesh, shapes[0], "#e8a25c", axes=left, pixels=pixels, **view)
left.set_title(f"{thicknesses[0] * 1e3:.1f} mm thick, strain {strains[-1]:.0%}")
for thickness, force, color in zip(thicknesses, forces, ["tab:orange", "tab:blue"], strict=True):
    right.loglog(strains, force, "o-", color=color, label=f"slits, {1e3 * thickness:.1f} mm")
right.loglog(strains, whole_force[0], "--", color="gray", label=f"whole, {1e3 * thicknesses[0]:.1f} mm")
right.set(xlabel="strain", ylabel="force [N]")
right.legend(fontsize=9)
figure.savefig("holes.jpg", dpi=120, pil_kwargs={"quality": 85})
