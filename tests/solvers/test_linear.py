"""Linear solvers against SciPy and NumPy on tangents of crumpled and of compressed sheets."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sparse
from folded import folded_sheet
from lattice import elastic
from linear_solvers import ITERATIVE, SOLVERS, needs_direct
from scipy.sparse.linalg import spsolve

from jaxcrumple import SelfContact
from jaxcrumple.assembly.sparsity import build_pattern
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.model.elements import upper_pairs
from jaxcrumple.model.walls import Ramp, Sphere
from jaxcrumple.scene import sheet
from jaxcrumple.solvers.contact.schedule import without_matrix
from jaxcrumple.solvers.linear import registry
from jaxcrumple.solvers.linear.block_jacobi import BlockCG
from jaxcrumple.solvers.linear.direct import Direct
from jaxcrumple.solvers.linear.registry import choose_linear_solver
from jaxcrumple.solvers.linear.solve import linear_solve
from jaxcrumple.solvers.linear.two_level import TwoLevel
from jaxcrumple.system import elastic_tangent


@eqx.filter_jit
def solve(solver, pattern, values, rhs, rtol=1e-8):
    """Factor `values` and solve."""
    factor = solver.factor(pattern, values, solver.start(pattern))
    return factor, solver.solve(pattern, factor, values, rhs, rtol)


def matrix(pattern, values):
    """The symmetric matrix as SciPy's."""
    size = pattern.diagonal.shape[0]
    upper = sparse.csr_array(tuple(map(np.asarray, (values, pattern.indices, pattern.indptr))), (size, size))
    return sparse.csc_array(upper + sparse.triu(upper, k=1).T)


@functools.cache
def crumpled():
    """Pattern, positive definite values and a right-hand side of a rough, stretched sheet in a sphere."""
    mesh = rectangle(0.05, 0.04, 150, seed=1, sweeps=10)
    rng = np.random.default_rng(2)
    x = 1.02 * mesh.vertices + 1e-4 * rng.normal(size=mesh.vertices.shape)
    x[:, 2] += 2e-3 * np.sin(400 * x[:, 0] + 200 * x[:, 1])
    wall = Sphere(jnp.zeros(3), Ramp(jnp.asarray(0.031), jnp.asarray(0.0)))
    scene = sheet(mesh, Material(), walls=[wall])
    p = jnp.asarray(0.1 * rng.normal(size=len(mesh.hinges)))
    values = eqx.filter_jit(elastic_tangent)(scene, jnp.asarray(x), p, jnp.asarray(0.0))
    eigenvalues = np.linalg.eigvalsh(matrix(scene.sparsity, values).toarray())
    assert 0 < eigenvalues[0] < 1e-3 * eigenvalues[-1]
    return scene.sparsity, values, jnp.asarray(rng.normal(size=3 * mesh.n_nodes))


@functools.cache
def compressed():
    """Pattern, indefinite values, their eigenvalues, and a right-hand side of a flat, squeezed sheet."""
    mesh = rectangle(0.05, 0.04, 60, seed=1, sweeps=10)
    scene = sheet(mesh, elastic())
    # The shift moves the rigid translations away from zero, where their sign would be rounding.
    shift = 1e-4 * float(jnp.max(scene.membrane.stiffness) / jnp.min(scene.mass))
    x = jnp.asarray(mesh.vertices * [0.97, 0.97, 1.0])
    values = eqx.filter_jit(elastic_tangent)(scene, x, None, jnp.asarray(0.0), shift)
    eigenvalues = np.linalg.eigvalsh(matrix(scene.sparsity, values).toarray())
    assert np.min(np.abs(eigenvalues)) > 1e-9 * np.max(eigenvalues)
    rhs = jnp.asarray(np.random.default_rng(0).normal(size=3 * mesh.n_nodes))
    return scene.sparsity, values, eigenvalues, rhs


# --- Assembly ------------------------------------------------------------------------------------


@functools.cache
def random_blocks():
    """A pattern over springs and hinges, blocks at random, and the matrix they add up to, by loops."""
    mesh = rectangle(1.0, 0.8, 30, seed=4, sweeps=5)
    stencils = [mesh.edges, mesh.hinges]
    rng = np.random.default_rng(5)
    size = 3 * mesh.n_nodes
    dense = np.zeros((size, size))
    elements = []
    for stencil in stencils:
        pairs = upper_pairs(stencil.shape[1])
        blocks = rng.normal(size=(len(pairs), 3, 3, len(stencil)))
        for k, (a, b) in enumerate(pairs):
            if a == b:
                blocks[k] += np.swapaxes(blocks[k], 0, 1).copy()
            for m, nodes in enumerate(stencil):
                i, j = (slice(3 * nodes[c], 3 * nodes[c] + 3) for c in (a, b))
                dense[i, j] += blocks[k, ..., m]
                if a != b:
                    dense[j, i] += blocks[k, ..., m].T
        elements.append(jnp.asarray(blocks))
    nodes = rng.normal(size=(mesh.n_nodes, 3, 3))
    nodes += np.swapaxes(nodes, 1, 2)
    for i, block in enumerate(nodes):
        dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += block
    return build_pattern(mesh.vertices, stencils), elements, jnp.asarray(nodes), dense


def test_assembly_adds_up_every_block():
    pattern, elements, nodes, dense = random_blocks()
    values = jax.jit(lambda e, n: pattern.values(pattern.assemble(e, n)))(elements, nodes)
    np.testing.assert_allclose(matrix(pattern, values).toarray(), dense, atol=1e-13)
    assert pattern.nnz < 0.5 * dense.size
    np.testing.assert_allclose(values[pattern.diagonal], np.diag(dense), atol=1e-13)


def test_product_is_that_of_the_symmetric_matrix():
    pattern, elements, nodes, dense = random_blocks()
    x = np.random.default_rng(6).normal(size=len(dense))
    product = jax.jit(lambda e, n, x: pattern.product(pattern.values(pattern.assemble(e, n)), x))(
        elements, nodes, x
    )
    np.testing.assert_allclose(product, dense @ x, atol=1e-12)


def test_expanded_product_is_the_same():
    pattern, elements, nodes, dense = random_blocks()
    x = np.random.default_rng(6).normal(size=len(dense))
    rows = jax.jit(lambda e, n: pattern.expand(pattern.values(pattern.assemble(e, n))))(elements, nodes)
    assert rows.shape == (len(dense) // 3, 3, 3 * pattern.neighbors.shape[1])
    np.testing.assert_allclose(pattern.expanded_product(rows, jnp.asarray(x)), dense @ x, atol=1e-12)


# --- Solutions -----------------------------------------------------------------------------------


@needs_direct
def test_direct_solves_to_rounding():
    pattern, values, rhs = crumpled()
    factor, solution = solve(Direct(), pattern, values, rhs)
    exact = spsolve(matrix(pattern, values), np.asarray(rhs))
    assert np.linalg.norm(solution.x - exact) < 1e-8 * np.linalg.norm(exact)
    assert (int(factor.negative), bool(solution.indefinite)) == (0, False)


@needs_direct
def test_direct_counts_negative_eigenvalues():
    pattern, values, eigenvalues, rhs = compressed()
    factor, solution = solve(Direct(), pattern, values, rhs)
    assert np.sum(eigenvalues < 0) > 5
    assert int(factor.negative) == np.sum(eigenvalues < 0)
    assert bool(solution.indefinite)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_every_solver_reaches_its_tolerance(solver, rtol):
    pattern, values, rhs = crumpled()
    _, solution = solve(solver, pattern, values, rhs, rtol)
    a = matrix(pattern, values)
    assert not bool(solution.indefinite)
    # The recursive residual is what CG sees; the true one follows it but for rounding.
    assert np.linalg.norm(a @ np.asarray(solution.x) - rhs) < 1.01 * rtol * np.linalg.norm(rhs)
    exact = spsolve(a, np.asarray(rhs))
    condition = np.linalg.cond(a.toarray())
    assert np.linalg.norm(solution.x - exact) < condition * rtol * np.linalg.norm(exact)


def test_conjugate_gradients_notice_negative_curvature():
    pattern, values, eigenvalues, rhs = compressed()
    assert np.sum(eigenvalues < 0) > 5
    small = BlockCG(block_size=3)
    factor, solution = solve(small, pattern, values, rhs)
    assert bool(solution.indefinite)
    assert int(solution.iterations) < 3 * len(eigenvalues)
    # A block that is not positive definite proves it without an iteration.
    factor, solution = solve(BlockCG(block_size=3 * 60), pattern, values, rhs)
    assert int(factor.negative) > 0
    assert (bool(solution.indefinite), int(solution.iterations)) == (True, 0)


def test_larger_blocks_need_fewer_iterations():
    pattern, values, rhs = crumpled()
    sizes = (1, 6, 24, 96, 450)
    counts = [int(solve(BlockCG(block_size=s), pattern, values, rhs)[1].iterations) for s in sizes]
    assert np.all(np.diff(counts) < 0), counts
    # One block is the inverse.
    assert counts[-1] <= 2


def test_iterations_are_bounded():
    pattern, values, rhs = crumpled()
    _, solution = solve(BlockCG(max_iterations=3), pattern, values, rhs)
    assert int(solution.iterations) == 3
    assert np.all(np.isfinite(solution.x))


def stiffened(values, pattern, share):
    """Values of a matrix near that of `values`: its diagonal grown by `share`."""
    return values.at[pattern.diagonal].multiply(1.0 + share)


@needs_direct
def test_a_factor_of_other_values_is_a_preconditioner():
    pattern, values, rhs = crumpled()
    solver = Direct()
    factor, _ = solve(solver, pattern, values, rhs)
    near = stiffened(values, pattern, 1e-6)
    lagged = eqx.filter_jit(solver.solve)(pattern, factor, near, rhs, 1e-8)
    exact = spsolve(matrix(pattern, near), np.asarray(rhs))
    assert 1 < int(lagged.iterations) < 40
    assert np.linalg.norm(lagged.x - exact) < 1e-5 * np.linalg.norm(exact)


@pytest.mark.parametrize("solver", SOLVERS)
def test_derivatives_follow_from_the_implicit_function_theorem(solver):
    pattern, values, rhs = crumpled()
    rng = np.random.default_rng(3)
    d_values = values * jnp.asarray(rng.normal(size=values.shape))
    d_rhs, cotangent = jnp.asarray(rng.normal(size=(2, rhs.shape[0])))
    a, da = matrix(pattern, values), matrix(pattern, d_values)
    x = spsolve(a, np.asarray(rhs))
    expected = spsolve(a, np.asarray(d_rhs) - da @ x)

    @eqx.filter_jit
    def forward(v, b, dv, db):
        return jax.jvp(lambda v, b: linear_solve(solver, pattern, v, b, 1e-11), (v, b), (dv, db))

    @eqx.filter_jit
    def reverse(v, b, y):
        return jax.vjp(lambda v, b: linear_solve(solver, pattern, v, b, 1e-11), v, b)[1](y)

    primal, tangent_out = forward(values, rhs, d_values, d_rhs)
    assert np.linalg.norm(primal - x) < 1e-6 * np.linalg.norm(x)
    assert np.linalg.norm(tangent_out - expected) < 1e-5 * np.linalg.norm(expected)
    by_values, by_rhs = reverse(values, rhs, cotangent)
    both = float(by_values @ d_values + by_rhs @ d_rhs)
    assert both == pytest.approx(float(cotangent @ expected), rel=1e-5)


@needs_direct
def test_the_direct_solver_solves_indefinite_systems():
    pattern, values, eigenvalues, rhs = compressed()
    assert np.sum(eigenvalues < 0) > 10
    exact = np.linalg.solve(matrix(pattern, values).toarray(), rhs)
    x, vjp = jax.vjp(lambda v: linear_solve("direct", pattern, v, rhs), values)
    assert np.linalg.norm(x - exact) < 1e-7 * np.linalg.norm(exact)
    # d(x.x)/2 along the values themselves is -x.x: twice the matrix is half the solution.
    assert float(vjp(x)[0] @ values) == pytest.approx(-float(exact @ exact), rel=1e-6)


@needs_direct
def test_the_direct_solver_refines_by_sheet_and_contact_together():
    """Its one matrix must have every block: refinement by another would leave what that lacks."""
    scene, x = folded_sheet(0.8e-3, SelfContact(range=1e-3, level=4))
    pattern = scene.sparsity
    with pytest.raises(ValueError, match="the direct solver needs the contact lists"):
        Direct().start(without_matrix(scene).sparsity)
    values = eqx.filter_jit(elastic_tangent)(scene, x, None, jnp.asarray(0.0), 1e7)
    blocks = values[pattern.nnz : pattern.nnz + pattern.contact.size]
    assert jnp.max(jnp.abs(blocks)) > 1e-3 * jnp.max(jnp.abs(values))
    rhs = jnp.asarray(np.random.default_rng(0).normal(size=3 * scene.n_nodes))

    @eqx.filter_jit
    def left(values, rhs):
        factor = Direct().factor(pattern, values, Direct().start(pattern))
        return rhs - pattern.product(values, Direct().solve_factored(pattern, factor, rhs, 0.0))

    assert jnp.linalg.norm(left(values, rhs)) < 1e-10 * jnp.linalg.norm(rhs)


@pytest.mark.parametrize("solver", ITERATIVE)
def test_conjugate_gradients_give_nan_where_they_cannot_solve(solver):
    pattern, values, _, rhs = compressed()
    assert np.all(np.isnan(linear_solve(solver, pattern, values, rhs)))
    pattern, values, rhs = crumpled()
    hasty = eqx.tree_at(lambda s: s.max_iterations, solver, 3, is_leaf=lambda leaf: leaf is None)
    assert np.all(np.isnan(linear_solve(hasty, pattern, values, rhs)))


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_factor_solves_for_its_own_values_without_being_given_them(solver):
    pattern, values, rhs = crumpled()

    @eqx.filter_jit
    def both(values, rhs):
        factor = solver.factor(pattern, values, solver.start(pattern))
        own = solver.solve(pattern, factor, None, rhs, 1e-10)
        # Equal numbers are not the same array: this goes by conjugate gradients.
        return own, solver.solve(pattern, factor, factor.values + 0.0, rhs, 1e-10)

    own, given = both(values, rhs)
    size = float(jnp.linalg.norm(given.x))
    assert size > 0 and float(jnp.linalg.norm(own.x - given.x)) < 1e-6 * size
    assert int(own.iterations) == 1 if solver.exact else own.iterations == given.iterations


@needs_direct
def test_a_factor_is_given_back():
    from pardiso_mkl_jax.primitive import RebuildReason, rebuild_stats

    pattern, values, rhs = crumpled()
    solver = Direct()

    @eqx.filter_jit
    def once(values):
        factor = solver.factor(pattern, values, solver.start(pattern))
        x = solver.solve(pattern, factor, values, rhs, 1e-8).x
        solver.release(factor, x)
        return factor, x

    before = rebuild_stats()[RebuildReason.FREED]
    factor, x = once(values)
    assert rebuild_stats()[RebuildReason.FREED] == before
    # Whoever uses it again gets the same answer, from a factor made anew.
    again = eqx.filter_jit(solver.solve)(pattern, factor, values, rhs, 1e-8).x
    assert rebuild_stats()[RebuildReason.FREED] == before + 1
    np.testing.assert_array_equal(again, x)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_expanded_product_keeps_precision_and_runs_in_batches(dtype):
    pattern, values, rhs = crumpled()
    vectors = np.stack([rhs, rhs[::-1]]).astype(dtype)
    rows = pattern.expand(values.astype(dtype))
    product = jax.jit(jax.vmap(lambda x: pattern.expanded_product(rows, x)))(vectors)
    assert product.dtype == dtype
    exact = vectors @ matrix(pattern, values)
    np.testing.assert_allclose(product, exact, atol=10 * np.finfo(dtype).eps * np.abs(exact).max())


@pytest.mark.parametrize("solver", ITERATIVE)
def test_iterative_solvers_run_in_batches(solver):
    pattern, values, rhs = crumpled()
    shares = jnp.array([0.0, 1e-3, 1e-2])
    batch = jax.vmap(lambda s: stiffened(values, pattern, s))(shares)
    run = jax.vmap(lambda v: linear_solve(solver, pattern, v, rhs, 1e-10))
    _, tangents = jax.jit(lambda b: jax.jvp(run, (b,), (b,)))(batch)
    # Twice the matrix is half the solution: the derivative along the values is minus the solution.
    for lane, x, dx in zip(batch, jax.jit(run)(batch), tangents, strict=True):
        exact = spsolve(matrix(pattern, lane), np.asarray(rhs))
        assert np.linalg.norm(x - exact) < 1e-5 * np.linalg.norm(exact)
        assert np.linalg.norm(dx + exact) < 1e-5 * np.linalg.norm(exact)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_reported(solver, bad):
    pattern, values, rhs = crumpled()
    factor, solution = solve(solver, pattern, values.at[7].set(bad), rhs)
    assert int(factor.negative) > 0
    assert bool(solution.indefinite)
    # The workspace survives: the next, sound matrix is solved as ever.
    renewed = eqx.filter_jit(lambda p, v, f: solver.factor(p, v, f))(pattern, values, factor)
    again = eqx.filter_jit(solver.solve)(pattern, renewed, values, rhs, 1e-6)
    assert not bool(again.indefinite)
    assert np.linalg.norm(matrix(pattern, values) @ np.asarray(again.x) - rhs) < 1e-5 * np.linalg.norm(rhs)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_right_hand_side_that_is_not_finite_gives_no_answer(solver):
    pattern, values, rhs = crumpled()
    _, solution = solve(solver, pattern, values, rhs.at[0].set(np.nan))
    assert not np.all(np.isfinite(solution.x))


# --- Choice --------------------------------------------------------------------------------------


def test_choice_of_solver(monkeypatch):
    with pytest.raises(ValueError, match="'lu' is unknown; choose one of auto, direct, two-level, block-cg"):
        choose_linear_solver("lu")
    assert isinstance(choose_linear_solver("block-cg"), BlockCG)
    monkeypatch.setattr(registry, "direct_available", lambda: True)
    assert isinstance(choose_linear_solver("auto"), Direct)
    assert isinstance(choose_linear_solver("direct"), Direct)
    monkeypatch.setattr(registry, "direct_available", lambda: False)
    assert isinstance(choose_linear_solver("auto"), TwoLevel)
    assert isinstance(choose_linear_solver("two-level"), TwoLevel)
    with pytest.raises(ValueError, match=r"needs the extra, pip install 'jaxcrumple\[direct\]'"):
        choose_linear_solver("direct")
