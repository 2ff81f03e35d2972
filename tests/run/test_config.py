"""Options of a run: what is refused and with which words, and what reaches scene, material and solver."""

import json

import equinox as eqx
import numpy as np
import pytest

from jaxcrumple.io import RunDirectoryError
from jaxcrumple.material.material import Material
from jaxcrumple.run import run
from jaxcrumple.run.check import check_built
from jaxcrumple.run.config import ConfigError, RunConfig, configure
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.solvers.implicit.bdf_pair import BDFPair
from jaxcrumple.solvers.linear.block_jacobi import BlockCG
from jaxcrumple.solvers.scheme import SCHEMES, integrator

# Settings and what the message about them must say.
REFUSED = [
    ({"settings": ["thicknes=1e-4"]}, "'thicknes' is unknown; did you mean 'thickness'\\?$"),
    ({"settings": ["swich_up=1"]}, "did you mean 'switch_up'\\?$"),
    ({"settings": ["frame=3"]}, "did you mean 'frames'\\?$"),
    (
        {"settings": ["zzz=1"]},
        "'zzz' is unknown; choose one of contact, .*damping, density, .*, young_modulus\\.$",
    ),
    ({"settings": {"nodez": 3}}, "'nodez' is unknown"),
    ({"settings": ["thickness"]}, "'thickness' must read key=value, e.g. thickness=1e-4"),
    ({"settings": ["=3"]}, "'=3' must read key=value"),
    ({"settings": [""]}, "'' must read key=value"),
    ({"settings": ["contact=soft"]}, "contact = 'soft': .*'barrier' or 'inverse-power', or none\\.$"),
    ({"settings": ["thickness=thin"]}, "thickness = 'thin': Input should be a valid number"),
    ({"settings": ["thickness=none"]}, "thickness = None: Input should be a valid number"),
    ({"settings": ["thickness=-1e-4"]}, r"thickness = -0.0001 \[m\] is not usable; give a finite number > 0"),
    ({"settings": ["thickness=0"]}, r"thickness = 0.0 \[m\] is not usable"),
    ({"settings": ["density=nan"]}, r"density = nan \[kg/m\^3\] is not usable"),
    ({"settings": ["young_modulus=inf"]}, r"young_modulus = inf \[Pa\] is not usable"),
    ({"settings": ["yield_curvature=-1"]}, r"yield_curvature = -1.0 \[1/m\] is not usable; give a finite"),
    ({"settings": ["yield_c0=-0.1"]}, r"yield_c0 = -0.1 \[dimensionless\] is not usable"),
    ({"settings": ["plastic_time=0"]}, r"plastic_time = 0.0 \[s\] is not usable"),
    ({"settings": ["yield_curvature=200", "yield_c0=0.2"]}, "both set the yield point; give one"),
    ({"settings": ["mass_lumping=full"]}, "mass_lumping = 'full': Input should be 'uniform' or 'area'"),
    ({"settings": ["rtol=0"]}, "rtol = '0': Input should be greater than 0"),
    ({"settings": ["rtol=1"]}, "rtol = '1': Input should be less than 1"),
    ({"settings": ["rtol=nan"]}, "rtol = 'nan': Input should be a finite number"),
    ({"settings": ["max_step=inf"]}, "max_step = 'inf': Input should be a finite number"),
    ({"settings": ["max_step=nan"]}, "max_step = 'nan': Input should be a finite number"),
    ({"settings": ["max_step=0"]}, "max_step = '0': Input should be greater than 0"),
    ({"settings": ["max_order=6"]}, "max_order = '6': Input should be less than or equal to 5"),
    (
        {"settings": ["linear=lu"]},
        "linear = 'lu': Input should be 'auto', 'direct', 'two-level' or 'block-cg'",
    ),
    ({"settings": ["max_order=0"]}, "max_order = '0': Input should be greater than or equal to 1"),
    ({"settings": ["rho_infinity=1.1"]}, "rho_infinity = '1.1': Input should be less than or equal to 1"),
    ({"settings": ["scheme=both"]}, "scheme = 'both': Input should be 'hybrid', 'dynamic', 'alternat"),
    ({"settings": ["switch_down=0"]}, "switch_down = '0': Input should be greater than 0"),
    ({"settings": ["stages=hybrid"]}, "'stages' is unknown"),
    ({"settings": ["damping=none"]}, "damping = None: Input should be 'central' or 'paper'"),
    ({"settings": ["sweeps=1.5"]}, "sweeps = '1.5': Input should be a valid integer"),
    ({"settings": ["frames=0"]}, "frames = '0': Input should be greater than or equal to 1"),
    ({"settings": ["speed=-1"]}, "speed = '-1': Input should be greater than 0"),
    ({"settings": ["size=inf"]}, "size = 'inf': Input should be a finite number"),
    ({"settings": ["imperfection=inf"]}, "imperfection = 'inf': Input should be a finite number"),
    ({"t_end": 0.0}, "t_end = 0.0: Input should be greater than 0"),
    ({"t_end": -1.0}, "t_end = -1.0: Input should be greater than 0"),
    ({"t_end": np.nan}, "t_end = nan: Input should be a finite number"),
    ({"t_end": np.inf}, "t_end = inf: Input should be a finite number"),
    ({"t_end": 7.1}, "t_end = 7.1 s must be less than 7.1 s, when its sphere has zero radius"),
    ({"settings": ["speed=1"]}, "t_end = 2.6 s must be less than 0.071 s"),
    ({"nodes": 15}, "nodes = 15: Input should be greater than or equal to 16"),
    ({"nodes": 10**7}, "nodes = 10000000: Input should be less than or equal to 1000000"),
    ({"seed": -1}, "seed = -1: Input should be greater than or equal to 0"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=lambda v: str(v)[:40])
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        configure("radial", **options)


def test_unknown_scenes_are_refused():
    with pytest.raises(ConfigError, match=r"scene 'radal' is unknown; did you mean 'radial'\?$"):
        configure("radal")
    with pytest.raises(ConfigError, match=r"scene '12' is unknown; choose one of .*radial.*\.$"):
        configure("12")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["radius=0.05"], "radius = 0.05 m leaves the corners of a sheet of size 0.1 m outside; choose at"),
        (["hold=7.1"], "hold = 7.1 s must be a time between 0 and 7.1 s, when the sphere has zero radius"),
    ],
)
def test_impossible_scenes_leave_nothing_on_the_disk(tmp_path, settings, message):
    config = configure("radial", nodes=60, settings=[*settings, "sweeps=2"])
    for use in (lambda: run.start_run(config, tmp_path / "a" / "run"), lambda: check_built(config)):
        with pytest.raises(ValueError, match=message):
            use()
    assert list(tmp_path.iterdir()) == []


def test_a_start_behind_a_wall_leaves_nothing_on_the_disk(tmp_path):
    walls = [{"kind": "plane", "offset": "1 cm"}]
    config = configure("custom", nodes=60, t_end=0.1, settings={"walls": walls})
    for use in (lambda: run.start_run(config, tmp_path / "run"), lambda: check_built(config)):
        with pytest.raises(ValueError, match=r"starts 0.01 m behind wall 0 \(Plane\); move the sheet"):
            use()
    assert list(tmp_path.iterdir()) == []


def test_a_sphere_that_holds_may_be_run_for_long():
    config = configure("radial", nodes=60, t_end=100.0, settings=["hold=1.5", "sweeps=2"])
    radius = config.build().scene.walls[0].shape.radius
    assert [float(radius(t)) for t in (0.0, 1.0, 1.5, 100.0)] == pytest.approx([0.071, 0.061, 0.056, 0.056])


def test_a_speed_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="speed = inf must be a positive number"):
        SCENES["radial"].build(60, speed=np.inf)


def test_taken_places_are_refused_before_the_mesh_is_made(tmp_path, monkeypatch):
    def build(*_, **__):
        raise AssertionError("the mesh was made")

    entry = SCENES["radial"]._replace(build=build)
    monkeypatch.setitem(SCENES, "radial", entry)
    (tmp_path / "file").write_text("precious")
    with pytest.raises(RunDirectoryError, match="is not empty"):
        run.start_run(configure("radial"), tmp_path)
    with pytest.raises(RunDirectoryError, match="is a file"):
        run.start_run(configure("radial"), tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "precious"


def test_settings_reach_scene_material_and_solver():
    config = configure(
        "radial",
        nodes=70,
        seed=3,
        settings=["thickness=1e-4", " rtol = 1e-5", "linear=block-cg", "frames=7", "sweeps=3", "speed=0.02",
                  "switch_up=2e-5", "scheme=paper", "yield_c0=0.25", "max_step=1e-3"],
    )  # fmt: skip
    assert (config.nodes, config.seed, config.frames) == (70, 3, 7)
    assert config.t_end == SCENES["radial"].t_end
    material, solver, setup = config.material.build(), config.solver.build(), config.build()
    assert (material.thickness, material.yield_c0, material.yield_curvature) == (1e-4, 0.25, None)
    assert float(solver.implicit.rtol) == float(solver.explicit.rtol) == 1e-5
    assert isinstance(solver.implicit, BDFPair)
    assert isinstance(solver.implicit.linear, BlockCG)
    # What is not given is the scheme's own.
    switch = solver.switch
    assert (float(switch.up), float(switch.down), float(switch.dwell)) == (2e-5, 1e-6, 0.0)
    assert float(solver.max_step) == 1e-3
    assert setup.mesh.n_nodes == 70
    assert float(setup.scene.walls[0].shape.radius.rate) == -0.02
    np.testing.assert_allclose(setup.scene.plasticity.yield_threshold, 0.25)


def test_a_mapping_says_the_same_as_text():
    text = configure("radial", settings=["thickness=1e-4", "yield_curvature=none", "frames=3"])
    mapping = configure("radial", settings={"thickness": 1e-4, "yield_curvature": None, "frames": 3})
    assert text == mapping
    assert text.material.build().is_elastic
    assert text.frames == 3


@pytest.mark.parametrize("settings", [[], ["max_step=0.01", "yield_c0=0.3", "yield_curvature=none"]])
def test_a_configuration_survives_its_file(settings):
    config = configure("radial", t_end=1.5, settings=settings)
    text = json.dumps(config.model_dump(mode="json"), allow_nan=False)
    assert RunConfig(**json.loads(text)) == config
    assert RunConfig.model_validate_json(config.model_dump_json()) == config
    assert float(RunConfig(**json.loads(text)).solver.build().max_step) == (0.01 if settings else np.inf)


def test_every_scheme_is_an_option():
    for scheme in SCHEMES:
        config = configure("radial", settings=[f"scheme={scheme}", "max_order=3", "rho_infinity=0.5"])
        assert config.options["damping"] == ("paper" if scheme == "paper" else "central")
        solver, expected = config.solver.build(), integrator(scheme=scheme, max_order=3, rho_infinity=0.5)
        assert eqx.tree_equal(solver, expected, typematch=True)
    assert configure("radial", settings=["scheme=paper", "damping=central"]).options["damping"] == "central"


def test_defaults_of_the_options_are_those_of_the_code():
    bare = configure("radial", nodes=60, settings=["sweeps=2"])
    material, default = bare.material.build(), Material()
    for name in ("young_modulus", "thickness", "density", "yield_curvature", "yield_c0", "gamma",
                 "plastic_time", "drag_rate", "internal_damping_time", "mass_lumping"):  # fmt: skip
        assert getattr(material, name) == getattr(default, name), name
