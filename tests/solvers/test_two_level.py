"""The coarse space and the two-level solver against dense matrices, on several kinds of mesh."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folded import folded_sheet

from jaxcrumple import (
    Material,
    SelfContact,
    disc,
    initial_state,
    integrate,
    integrator,
    radial,
    rectangle,
    sheet,
)
from jaxcrumple.assembly import contact_blocks
from jaxcrumple.assembly.coarse_space import build_coarse_space
from jaxcrumple.geometry.hinge import curvature
from jaxcrumple.solvers.linear import two_level
from jaxcrumple.solvers.linear.block_jacobi import BlockCG
from jaxcrumple.solvers.linear.two_level import TwoLevel, coarse_matrix
from jaxcrumple.system import elastic_tangent

# Shift of the stiffness in 1/s2: that of quasistatic steps of some milliseconds.
SIGMA = 1e5


def shell(n):
    """A quarter of a cylinder."""
    flat = rectangle(0.06, 0.04, n, seed=2, sweeps=20)
    angle = flat.vertices[:, 0] / 0.04
    bent = np.stack([0.04 * np.sin(angle), flat.vertices[:, 1], 0.04 * np.cos(angle)], axis=1)
    return flat.with_rest_shape(bent)


MESHES = {
    "sheet": lambda n: rectangle(0.1, 0.1, n, seed=1, sweeps=20),
    "strip": lambda n: rectangle(0.2, 0.03, n, seed=1, sweeps=20),
    "disc": lambda n: disc(0.05, n, seed=1),
    "shell": shell,
}


@functools.cache
def system(kind, n):
    """Pattern, positive definite values of a dented, stretched sheet, and a random right-hand side."""
    mesh = MESHES[kind](n)
    scene = sheet(mesh, Material(yield_curvature=None))
    x = 1.02 * mesh.vertices + 5e-5 * np.sin(300 * mesh.vertices[:, [1, 2, 0]])
    values = eqx.filter_jit(elastic_tangent)(scene, jnp.asarray(x), None, jnp.asarray(0.0), 50 * SIGMA)
    rhs = jnp.asarray(np.random.default_rng(0).normal(size=3 * mesh.n_nodes))
    return scene.sparsity, values, rhs


@eqx.filter_jit
def solve(solver, pattern, values, rhs, rtol):
    """Factor and solve."""
    factor = solver.factor(pattern, values, solver.start(pattern))
    return factor.negative, solver.solve(pattern, factor, values, rhs, rtol)


def splines(space, n):
    """The coarse space as a dense matrix (n, size) from the definition of its members."""
    dense = np.zeros((n, space.size + 1))
    weights = np.asarray(space.weights)
    for cell, nodes in enumerate(np.asarray(space.members)):
        for node in nodes[nodes < n]:
            product = np.outer(weights[node, 0], weights[node, 1]).reshape(-1)
            np.add.at(dense[node], np.asarray(space.functions)[cell], product)
    assert np.all(dense[:, -1] == 0)
    return dense[:, :-1]


@pytest.mark.parametrize("kind", MESHES)
def test_splines_hold_every_linear_displacement(kind):
    mesh = MESHES[kind](200)
    space = build_coarse_space(mesh.vertices, mesh.edges)
    z = splines(space, mesh.n_nodes)
    np.testing.assert_allclose(z.sum(axis=1), 1.0, atol=1e-12)
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    _, directions = np.linalg.eigh(centred.T @ centred)
    for along in (centred @ directions[:, 2], centred @ directions[:, 1]):
        fit = z @ np.linalg.lstsq(z, along, rcond=None)[0]
        np.testing.assert_allclose(fit, along, atol=1e-9)


@pytest.mark.parametrize("kind", MESHES)
def test_coarse_matrix_is_the_galerkin_product(kind):
    pattern, values, _ = system(kind, 200)
    n = pattern.neighbors.shape[0]
    z = np.kron(splines(pattern.coarse, n), np.eye(3))
    upper = np.zeros((3 * n, 3 * n))
    upper[np.asarray(pattern.rows), np.asarray(pattern.indices)] = values
    dense = upper + np.triu(upper, 1).T
    expected = z.T @ dense @ z
    got = np.asarray(jax.jit(coarse_matrix)(pattern, values))
    np.testing.assert_allclose(got, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("kind", MESHES)
def test_few_iterations_on_every_mesh(kind):
    pattern, values, rhs = system(kind, 400)
    negative, two = solve(TwoLevel(), pattern, values, rhs, 1e-6)
    _, one = solve(BlockCG(), pattern, values, rhs, 1e-6)
    assert (int(negative), bool(two.indefinite)) == (-1, False)
    residual = np.linalg.norm(pattern.product(values, two.x) - rhs) / np.linalg.norm(rhs)
    assert residual < 1.1e-6
    assert int(two.iterations) < int(one.iterations)
    assert int(two.iterations) < 120


@pytest.mark.parametrize("kind", MESHES)
def test_restriction_and_prolongation_are_the_splines(kind):
    space = system(kind, 200)[0].coarse
    n = len(space.place)
    z = np.kron(splines(space, n), np.eye(3))
    weights = two_level._cell_weights(space)
    rng = np.random.default_rng(0)
    fine, coarse = rng.normal(size=3 * n), rng.normal(size=3 * space.size)
    padded = space.padded(len(space.members) + 2, space.members.shape[1] + 1, space.size + 3)
    wide = two_level._restrict(padded, two_level._cell_weights(padded), jnp.asarray(fine))
    np.testing.assert_allclose(two_level._restrict(space, weights, jnp.asarray(fine)), z.T @ fine, atol=1e-13)
    np.testing.assert_allclose(wide, np.append(z.T @ fine, np.zeros(9)), atol=1e-13)
    np.testing.assert_allclose(
        two_level._prolong(space, weights, jnp.asarray(coarse)), z @ coarse, atol=1e-13
    )


def test_an_accelerator_computes_the_same(monkeypatch):
    pattern, values, rhs = system("sheet", 400)
    expected, solution = coarse_matrix(pattern, values), solve(TwoLevel(), pattern, values, rhs, 1e-8)[1]
    monkeypatch.setattr(two_level, "on_accelerator", lambda: True)
    matrix = coarse_matrix(pattern, values)
    np.testing.assert_allclose(matrix, expected, atol=1e-13 * np.abs(expected).max())
    # Another limit, lest the program compiled for the processor serve again.
    found = solve(TwoLevel(max_iterations=5001), pattern, values, rhs, 1e-8)[1]
    assert int(found.iterations) == int(solution.iterations) > 20
    np.testing.assert_allclose(found.x, solution.x, atol=1e-6 * np.abs(solution.x).max())


@pytest.mark.slow
def test_iterations_hardly_grow_with_the_mesh_and_are_far_fewer():
    counts = []
    for n in (500, 2000):
        setup = radial(n, sweeps=20, contact=None)
        scene = setup.scene
        values = eqx.filter_jit(elastic_tangent)(
            scene, setup.x, scene.bending.rest_curvature, jnp.asarray(0.0), SIGMA
        )
        rhs = jnp.asarray(np.random.default_rng(0).normal(size=3 * n))
        two, one = (
            int(solve(s, scene.sparsity, values, rhs, 1e-2)[1].iterations) for s in (TwoLevel(), BlockCG())
        )
        assert 5 * two < one
        counts.append(two)
    assert counts[1] < 2 * counts[0]


def test_a_preconditioner_serves_the_next_matrix():
    pattern, values, rhs = system("sheet", 400)
    solver = TwoLevel()
    factor = eqx.filter_jit(lambda p, v: solver.factor(p, v, solver.start(p)))(pattern, values)
    near = values.at[pattern.diagonal].multiply(1.0 + 1e-4)
    own = int(solve(solver, pattern, near, rhs, 1e-6)[1].iterations)
    lagged = eqx.filter_jit(solver.solve)(pattern, factor, near, rhs, 1e-6)
    assert int(lagged.iterations) < 1.3 * own + 3
    residual = np.linalg.norm(pattern.product(near, lagged.x) - rhs) / np.linalg.norm(rhs)
    assert residual < 1.1e-6


def test_rounding_is_not_taken_for_negative_curvature():
    # Blocks as large as the sheet hold its rigid motions: their inverses are beyond float32.
    setup = radial(12, sweeps=5, contact=None)
    scene = setup.scene
    values = eqx.filter_jit(elastic_tangent)(
        scene, setup.x, scene.bending.rest_curvature, jnp.asarray(0.0), 1e-2
    )
    rhs = jnp.asarray(np.random.default_rng(0).normal(size=36))
    negative, solution = solve(TwoLevel(), scene.sparsity, values, rhs, 1e-6)
    assert (int(negative), bool(solution.indefinite)) == (-1, False)
    assert int(solution.iterations) < 20


def test_new_numbers_do_not_compile_again():
    pattern, values, rhs = system("sheet", 200)
    traces = []

    @eqx.filter_jit
    def run(pattern, values, rhs):
        traces.append(1)
        solver = TwoLevel()
        factor = solver.factor(pattern, values, solver.start(pattern))
        return solver.solve(pattern, factor, values, rhs, 1e-3).x

    run(pattern, values, rhs)
    run(pattern, 2.0 * values, rhs + 1.0)
    assert len(traces) == 1


def test_factorisations_wait_for_each_other():
    # Two batches of LAPACK calls at once hang a machine of two threads: the coarse one needs the blocks'.
    setup = radial(60, sweeps=5, contact=None)
    pattern = setup.scene.sparsity
    solver = TwoLevel()
    factor = solver.start(pattern)
    jaxpr = jax.make_jaxpr(lambda values: solver.factor(pattern, values, factor))(factor.values)

    behind, found = set(), []
    for equation in jaxpr.jaxpr.eqns:
        text = str(equation)
        inputs = {variable for variable in equation.invars if not hasattr(variable, "val")}
        if "cholesky" in text:
            found.append(bool(inputs & behind))
        if inputs & behind or (not behind and "triangular_solve" in text):
            behind.update(equation.outvars)
    assert found == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("solver", [TwoLevel(), BlockCG()], ids=["two-level", "block-cg"])
def test_layers_that_press_one_another_are_not_taken_for_unstable(solver):
    # By this law the sheet's own part is indefinite at this gap, and the whole matrix is not.
    scene, x = folded_sheet(0.95e-3, SelfContact(range=1e-3, level=4, potential="penalty"))
    creased = curvature(scene.bending.hinges(x).theta)
    scene = eqx.tree_at(lambda s: s.bending.rest_curvature, scene, creased)
    pattern = scene.sparsity

    def matrices(shift):
        values = eqx.filter_jit(elastic_tangent)(scene, x, None, jnp.asarray(0.0), shift)
        own = jax.vmap(eqx.tree_at(lambda p: p.contact, pattern, None).product, (None, 0))
        unit = jnp.eye(3 * scene.n_nodes)
        parts = own(values[: pattern.nnz], unit), own(pattern.separate(values), unit)
        return values, jax.vmap(pattern.product, (None, 0))(values, unit), *parts

    mass = float(jnp.min(scene.mass))
    lowest = float(jnp.linalg.eigvalsh(matrices(0.0)[1])[0])
    values, whole, alone, separate = matrices(-3.0 * lowest / mass)
    low = [float(jnp.linalg.eigvalsh(matrix)[0]) for matrix in (whole, alone, separate)]
    assert low[0] > 0 > low[1] and low[2] > 0
    rhs = jnp.asarray(np.random.default_rng(0).normal(size=3 * scene.n_nodes))
    negative, solution = solve(solver, pattern, values, rhs, 1e-6)
    assert int(negative) <= 0 and not bool(solution.indefinite)
    left = rhs - whole @ solution.x
    assert jnp.linalg.norm(left) < 1.1e-6 * jnp.linalg.norm(rhs)


def test_products_with_contact_on_any_device(monkeypatch):
    scene, _ = folded_sheet(0.95e-3, SelfContact(range=1e-3, level=4))
    blocks = scene.sparsity.contact
    assert 0 < int(blocks.count) < len(blocks.triangles)
    rng, size = np.random.default_rng(0), 3 * scene.n_nodes
    # Values of pairs that are not in the list must not count.
    appended, u = rng.normal(size=blocks.size + scene.n_nodes), rng.normal(size=size)
    held = np.where(np.arange(blocks.size) < 81 * int(blocks.count), appended[: blocks.size], 0.0)
    upper = blocks.upper(np.append(held, appended[blocks.size :]), size).toarray()
    expected = (upper + np.triu(upper, 1).T) @ u
    for accelerated in (False, True):
        monkeypatch.setattr(contact_blocks, "on_accelerator", lambda answer=accelerated: answer)
        found = blocks.product(jnp.asarray(appended), jnp.asarray(u))
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("nodes", [64, 65])
def test_lanes_of_any_size_can_be_traced(nodes):
    """The blocks of 48 unknowns hold 64 nodes without padding."""
    setup = radial(nodes, sweeps=3, contact=None)
    start = initial_state(setup.scene, setup.x)

    def lane(radius):
        scene = eqx.tree_at(lambda s: s.walls[0].shape.radius.start, setup.scene, radius)
        return integrate(scene, start, 0.01, integrator(rtol=1e-2, linear="two-level"))[0].x

    traced = eqx.filter_eval_shape(eqx.filter_vmap(lane), jnp.array([0.071, 0.0712]))
    assert traced.shape == (2, nodes, 3)
