"""Sizes that follow from input: estimated before anything is allocated, refused or warned of with a cure."""

import re
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import jaxcrumple as jc
from jaxcrumple._jax import memory
from jaxcrumple._jax.memory import group_limits, memory_limit, require, require_indices
from jaxcrumple.assembly.sparsity import build_pattern
from jaxcrumple.cli import cli
from jaxcrumple.contact.adjacency import build_fans
from jaxcrumple.contact.sites import build_sites, require_candidates
from jaxcrumple.geometry.intersections import close_pairs
from jaxcrumple.io import RunDirectory
from jaxcrumple.measure import curvature_distribution, volume_fraction
from jaxcrumple.measure.raster import Raster
from jaxcrumple.replays.record import StepRecorder
from jaxcrumple.run.check import check_built
from jaxcrumple.run.config import configure
from jaxcrumple.run.estimate import estimate, require_config
from jaxcrumple.simulation import frame_times
from jaxcrumple.solvers.log import Trail
from jaxcrumple.sweeps.cases import checked_grid

MESH = jc.hexagonal(5, 4, 0.01)


@pytest.fixture
def memory_of(monkeypatch):
    """A function that sets the memory of this machine in bytes."""

    def set_to(size):
        monkeypatch.setattr(memory, "memory_limit", lambda: int(size))

    return set_to


def wheel(spokes):
    """A disc of triangles around one node."""
    angle = 2.0 * np.pi * np.arange(spokes) / spokes
    rim = np.column_stack([np.cos(angle), np.sin(angle)])
    around = np.arange(spokes)
    faces = np.column_stack([np.zeros(spokes, int), 1 + around, 1 + (around + 1) % spokes])
    return jc.Mesh.from_arrays(np.vstack([[0.0, 0.0], rim]), faces, reorder=False)


# Limits


def test_limits_of_control_groups_are_those_of_the_group_and_of_all_around_it(tmp_path):
    new, old = tmp_path / "v2", tmp_path / "v1"
    (new / "job" / "step").mkdir(parents=True)
    (old / "memory" / "box").mkdir(parents=True)
    (new / "memory.max").write_text("max\n")
    (new / "job" / "memory.max").write_text("3000\n")
    (new / "job" / "step" / "memory.max").write_text("5000\n")
    (old / "memory" / "memory.limit_in_bytes").write_text("9223372036854771712\n")
    (old / "memory" / "box" / "memory.limit_in_bytes").write_text("7000\n")
    own = tmp_path / "cgroup"
    own.write_text("0::/job/step\n")
    assert sorted(group_limits(new, own)) == [3000, 5000]
    own.write_text("5:cpu,cpuacct:/box\n4:memory:/box\n")
    assert sorted(group_limits(old, own)) == [7000, 9223372036854771712]
    assert list(group_limits(old, tmp_path / "none")) == []


def test_the_least_limit_counts(monkeypatch):
    monkeypatch.setattr(memory.resource, "getrlimit", lambda kind: (memory.resource.RLIM_INFINITY,) * 2)
    monkeypatch.setattr(memory, "group_limits", lambda: iter(()))
    whole = memory_limit()
    assert whole == memory.psutil.virtual_memory().total
    monkeypatch.setattr(memory, "group_limits", lambda: iter([whole // 2, 2 * whole]))
    assert memory_limit() == whole // 2
    monkeypatch.setattr(memory.resource, "getrlimit", lambda kind: (whole // 4, whole))
    assert memory_limit() == whole // 4


def test_what_surely_exceeds_is_refused_and_what_may_exceed_is_warned_of(memory_of):
    memory_of(8e9)
    with pytest.raises(ValueError, match=r"^it takes at least 8\.1 GB of memory, and the limit here is 8 GB"):
        require(8.1e9, "it", "shrink it")
    with pytest.warns(UserWarning, match=r"^it may take up to 9 GB of .* here is 8 GB; shrink it\.$"):
        require(1e9, "it", "shrink it", most=9e9)
    with pytest.raises(ValueError, match=r"takes at least nan GB"):
        require(np.nan, "it", "shrink it")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        require(1e9, "it", "shrink it", most=8e9)
    with pytest.raises(ValueError, match=r"it has 3e\+09 entries, more than 32-bit indices reach; shrink it"):
        require_indices(3e9, "it", "shrink it")


# Contact


def test_a_range_far_below_the_size_is_refused(memory_of):
    memory_of(23e9)
    message = r"contact of range 4e-07 m at level \d+, with .*e\+1[01] sites on .*, takes at least \d+ GB"
    for use in (
        lambda: jc.radial(60, sweeps=2, material=jc.Material(thickness=4e-7)),
        lambda: check_built(configure("radial", nodes=60, settings=["thickness=4e-7", "sweeps=2"])),
    ):
        with pytest.raises(ValueError, match=message):
            use()


def test_the_range_that_a_refusal_names_fits(memory_of):
    memory_of(5e7)
    with pytest.raises(ValueError, match=r"choose a contact range, by default the thickness, of") as refused:
        jc.sheet(MESH, jc.Material(), contact=jc.SelfContact(range=1e-6))
    fits = float(re.search(r"of at least (\S+) m, or no contact", str(refused.value)).group(1))
    assert 1e-5 < fits < 1e-3
    jc.sheet(MESH, jc.Material(), contact=jc.SelfContact(range=fits))
    with pytest.warns(UserWarning, match=r"may take up to .*; choose a contact range"):
        jc.sheet(MESH, jc.Material(), contact=jc.SelfContact(range=0.8 * fits))


def test_a_level_that_does_not_fit_is_refused_with_one_that_does(memory_of):
    memory_of(5e7)
    with pytest.raises(ValueError, match=r"choose a contact level of at most (\d+)\.") as no:
        jc.sheet(MESH, jc.Material(), contact=jc.SelfContact(level=5000))
    most = int(re.search(r"at most (\d+)", str(no.value)).group(1))
    assert 100 < most < 500
    jc.sheet(MESH, jc.Material(), contact=jc.SelfContact(level=most))
    with pytest.warns(UserWarning, match=rf"may take up to .*; choose a contact level of at most {most}"):
        jc.sheet(MESH, jc.Material(), contact=jc.SelfContact(level=most + 10))


@pytest.mark.parametrize("level", [0, 1, 4])
def test_sites_are_all_whole_shares_of_a_triangle(level):
    sites = build_sites(level)
    parts = level + 1
    expected = [(i, j, parts - i - j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    np.testing.assert_array_equal(np.rint(sites.weights * parts), expected)
    assert sites.share.sum() == pytest.approx(1.0)


def test_more_pairs_of_triangles_than_fit_are_refused(memory_of):
    memory_of(4e4)
    faces = len(MESH.faces)
    pairs = re.escape(f"{faces * (faces - 1) / 2:.2g}")
    with pytest.raises(ValueError, match=rf"with {pairs} candidate pairs of .*; choose a smaller"):
        require_candidates(MESH, 1.0)
    memory_of(2e3)
    with pytest.raises(ValueError, match=r"give triangles of more equal size"):
        require_candidates(MESH, 1e-4)
    ends, corners = MESH.vertices[MESH.edges], MESH.vertices[MESH.faces]
    with pytest.raises(ValueError, match=r"the search among .* pairs of segments and triangles, up to 0.0"):
        close_pairs(ends, corners)


# Meshes and scenes


def test_too_many_triangles_at_a_node_are_refused_by_node(memory_of):
    mesh = wheel(40)
    memory_of(3e5)
    with pytest.raises(ValueError, match=r"contact at 40 triangles around node 0 takes at least .*; remesh"):
        build_fans(mesh)
    memory_of(2e5)
    with pytest.raises(ValueError, match=r"the tangent of 41 nodes takes .* around node 0, which is"):
        build_pattern(mesh.vertices, [mesh.edges, mesh.hinges])


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda: jc.rectangle(1.0, 1.0, 10**12), r"a mesh of 1000000000000 nodes takes at least 1e\+06 GB"),
        (lambda: jc.disc(1.0, 10**12), r"a mesh of 1000000000000 nodes .*; give a smaller nodes\."),
        (lambda: jc.hexagonal(10**6, 10**6, 1.0), r"a mesh of 1000001000000 nodes .* smaller nx or ny\."),
        (lambda: jc.radial(60, size=1e5, radius=1e5, sweeps=2), r"an imperfection of 1e\+14 modes of 0.02 m"),
        (lambda: jc.axial(60, cycles=10**12), r"a motion of 1000000000000 cycles takes"),
        (lambda: frame_times(1.0, 10**13), r"a list of 10000000000000 frame times takes"),
        (
            lambda: checked_grid({k: range(10**4) for k in "abc"}, {}),
            r"a grid of 1e\+12 cases takes",
        ),
        (lambda: volume_fraction(MESH, MESH.vertices, 1e-4, shells=10**12), r"1000000000000 shells takes"),
        (lambda: curvature_distribution(MESH, MESH.vertices, bins=10**13), r"a distribution of 1e\+13 bins"),
        (
            lambda: Raster.over(MESH, 1e-9),
            r"an image of .* pixels takes at least .* GB of .*; choose a larger width",
        ),
    ],
)
def test_sizes_without_bound_are_refused_at_once(use, message):
    with pytest.raises(ValueError, match=message):
        use()


def test_a_window_and_frames_without_bound_are_refused():
    scene = jc.sheet(MESH, jc.Material())
    with pytest.raises(ValueError, match=r"a monitor of 1000000000000 steps takes at least 8e\+03 GB"):
        jc.initial_state(scene, MESH.vertices, window=10**12)


def test_a_flat_sheet_of_any_size_needs_no_modes():
    mesh = jc.radial(60, size=1e5, radius=1e5, sweeps=2, imperfection=0.0, contact=None).mesh
    assert np.all(mesh.vertices[:, 2] == 0.0)


# Runs


def test_a_run_of_a_million_nodes_is_refused_before_it_is_built(memory_of, tmp_path, monkeypatch):
    memory_of(23e9)
    monkeypatch.setattr("jaxcrumple.run.config.RunConfig.build", lambda config: pytest.fail("built"))
    config = configure("radial", nodes=1_000_000, settings=["contact=none"])
    message = r"a run of 1000000 nodes with 26 frames takes at least 3\d\.\d GB of memory, and the limit here"
    for use in (
        lambda: jc.start_run(config, tmp_path / "run"),
        lambda: check_built(config),
        lambda: require_config(config),
    ):
        with pytest.raises(ValueError, match=message):
            use()
    assert not (tmp_path / "run").exists()
    result = CliRunner().invoke(cli.app, ["check", "radial", "--nodes", "1000000", "--set", "contact=none"])
    assert result.exit_code == 1 and re.search(message, str(result.exception))


def test_frames_count_towards_the_memory_of_a_run(memory_of):
    memory_of(5e9)
    scene = jc.sheet(MESH, jc.Material())
    state = jc.initial_state(scene, MESH.vertices)
    with pytest.raises(ValueError, match=r"a run of \d+ nodes with 10000000 frames takes at least"):
        jc.simulate(scene, state, np.linspace(0.0, 1.0, 10**7 + 1)[1:])
    with pytest.raises(ValueError, match=r"4 runs at a time, each of 1000 nodes .*, or a cluster of"):
        require_config(configure("radial", settings={"frames": 5000}), runs=4)


def test_a_record_that_grows_too_large_is_warned_of_once(memory_of):
    recorder = StepRecorder(jc.initial_state(jc.sheet(MESH, jc.Material()), MESH.vertices), jc.integrator())
    steps = 16
    x = jnp.zeros((steps, *MESH.vertices.shape))
    trail = Trail(x, *(jnp.zeros(steps) for _ in range(4)), length=jnp.asarray(steps))
    memory_of(4 * (x.nbytes + 4 * 8 * steps))
    recorder.extend(trail)
    with pytest.warns(UserWarning, match=r"the record of 32 steps takes .* GB, and 4 times that at the end"):
        recorder.extend(trail)
    recorder.extend(trail)


def test_a_run_with_more_frames_than_fit_is_not_read(memory_of, tmp_path):
    config = configure("radial", nodes=60, settings=["contact=none", "sweeps=2"])
    stiffness = np.ones(len(MESH.edges)), np.ones(len(MESH.hinges))
    folder = RunDirectory.create(tmp_path / "run", config.model_dump(mode="json"), MESH, stiffness)
    for index in range(3):
        folder.save_frame(float(index), MESH.vertices, MESH.vertices, None)
    folder.commit({}, {"t": 2.0})
    memory_of(3 * 144 * MESH.n_nodes - 1)
    with pytest.raises(
        ValueError, match=r"a run of \d+ nodes with 3 frames .*; read frames one by one with Run"
    ):
        jc.load(tmp_path / "run")
    memory_of(6 * 144 * MESH.n_nodes)
    assert len(jc.load(tmp_path / "run").t) == 3


def test_estimates_span_what_was_measured():
    """`peak_memory_mb` of runs, of docs/numbers.md and `scripts/results/estimates.md`."""
    for contact, nodes, measured in (
        ("none", 1000, 1.27e9),
        ("none", 10000, 1.46e9),
        ("none", 30000, 1.98e9),
        ("penalty", 1000, 4.2e9),
    ):
        least, most = estimate(configure("radial", settings=[f"contact={contact}"]), nodes).memory
        assert least < measured < most
        assert jnp.sqrt(least * most) / measured == pytest.approx(1.0, abs=0.6)
