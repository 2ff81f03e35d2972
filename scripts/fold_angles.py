"""Final fold angle against yield curvature at several resolutions, and their collapse onto a line (Fig. 3b).

A square sheet is folded in half, pressed between plates and let go. With phi the angle that is left and
theta = pi - phi, c_f = 2 sin(theta/2); c0 is the mean dimensionless yield curvature of the mesh's hinges and
lambda = sqrt(n / A). One linear map of lambda c0 with an offset proportional to lambda serves all meshes:
c_f = a - b lambda c0 + d lambda, fitted where the fold yields and the halves do not touch.

    python scripts/fold_angles.py [--nodes N ...] [--resume]
"""

import jax.numpy as jnp
import numpy as np
from benchlib import Log, markdown, options, save
from matplotlib.figure import Figure

import jaxcrumple as jc
from jaxcrumple.scenes.fold import TIMES

# Gap in m, the same for all meshes, and yield curvatures in 1/m.
GAP, YIELDS = 0.01, np.geomspace(25.0, 150.0, 12)
RTOL = 1e-2
# Range of c_f in which a fold has yielded and stays open.
FITTED = (0.3, 1.9)


def measured(nodes: int, yields: float) -> dict:
    """One fold."""
    setup = jc.fold(nodes, gap=GAP, material=jc.Material(yield_curvature=yields))
    state = jc.initial_state(setup.scene, setup.x)
    solution = jc.simulate(
        setup.scene, state, [TIMES.release, TIMES.end], solver=jc.integrator(RTOL, scheme="dynamic")
    )
    angle = float(jc.fold_angle(setup.mesh, jnp.asarray(solution.x[-1])))
    return {
        "c0": float(np.mean(setup.scene.plasticity.yield_curvature)),
        "angle": float(np.rad2deg(angle)),
        "lambda": float(np.sqrt(nodes / setup.mesh.area)),
        "result": solution.result,
        "steps": int(np.sum(solution.state.counters.steps)),
        "run_s": solution.run_s,
    }


def c_f(rows: list[dict]) -> np.ndarray:
    """Curvature that is left, 2 sin(theta/2)."""
    return 2.0 * np.cos(0.5 * np.deg2rad([row["angle"] for row in rows]))


def collapse(rows: list[dict]) -> tuple[np.ndarray, float, float]:
    """Coefficients a, b, d of the map, and the root mean square of what it leaves, with and without d."""
    left = c_f(rows)
    used = (left > FITTED[0]) & (left < FITTED[1])
    density, c0 = np.array([(row["lambda"], row["c0"]) for row in rows])[used].T
    columns = np.stack([np.ones(used.sum()), -density * c0, density], axis=1)
    found = np.linalg.lstsq(columns, left[used], rcond=None)[0]
    plain = np.linalg.lstsq(columns[:, :2], left[used], rcond=None)[0]
    rms = [
        np.sqrt(np.mean((m @ a - left[used]) ** 2)) for m, a in ((columns, found), (columns[:, :2], plain))
    ]
    return found, float(rms[0]), float(rms[1])


def figure_of(rows: list[dict], found: np.ndarray) -> Figure:
    """c_f against c0, and collapsed."""
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    raw, line = figure.subplots(1, 2, sharey=True)
    for nodes in sorted({row["nodes"] for row in rows}):
        own = [row for row in rows if row["nodes"] == nodes]
        c0 = np.array([row["c0"] for row in own])
        raw.plot(c0, c_f(own), "o-", label=f"n = {nodes}")
        density = own[0]["lambda"]
        line.plot(density * (found[1] * c0 - found[2]), c_f(own), "o", label=f"n = {nodes}")
    ends = np.array(line.get_xlim())
    line.plot(ends, found[0] - ends, "k:", lw=1.0)
    raw.set(xlabel="$c_0$", ylabel="$c_f = 2 \\sin(\\theta_f / 2)$")
    line.set(xlabel="$\\lambda (b\\, c_0 - d)$", ylim=(0.0, 2.0))
    raw.legend()
    return figure


def main() -> None:
    """Run, and write table and figure."""
    opts = options(__doc__, (500, 1000, 3000), resumable=True).parse_args()
    log = Log("fold_angles", opts.resume)
    rows = []
    for nodes in opts.nodes:
        for yields in YIELDS:
            key = {"nodes": nodes, "yield": float(yields)}
            rows.append(log.result(key, lambda key=key: measured(key["nodes"], key["yield"])))
            print(rows[-1], flush=True)
    found, rms, plain = collapse(rows)
    header = ["n", "yield curvature 1/m", "c0", "angle", "c_f", "result", "steps", "s"]
    lines = [
        [
            row["nodes"], f"{row['yield']:.1f}", f"{row['c0']:.4f}", f"{row['angle']:.1f}", f"{left:.3f}",
            row["result"], row["steps"], f"{row['run_s']:.1f}",
        ]
        for row, left in zip(rows, c_f(rows), strict=True)
    ]  # fmt: skip
    a, b, d = found
    text = markdown(header, lines) + (
        f"\n\nc_f = {a:.3f} - {b:.4g} m lambda c0 {d:+.3g} m lambda for {FITTED[0]} < c_f < {FITTED[1]}, "
        f"rms residual {rms:.3f}; without the offset {plain:.3f}. rtol = {RTOL:g}, gap {1e3 * GAP:g} mm."
    )
    save(
        opts, "fold_angles", text, figure_of(rows, found), {}, {"rows": rows, "map": list(found), "rms": rms}
    )


if __name__ == "__main__":
    main()
