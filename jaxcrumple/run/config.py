"""Configure a run: options of scene, material and solver, validated before any work."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import jax.numpy as jnp
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from jaxcrumple.material import presets
from jaxcrumple.material.material import Material
from jaxcrumple.options.suggest import nearest
from jaxcrumple.options.units import (
    LENGTH,
    TIME,
    KilogramPerCubicMetre,
    Metre,
    Pascal,
    PerMetre,
    PerSecond,
    Second,
    Unit,
    unit_of,
)
from jaxcrumple.options.validation import ConfigError, Place, shortened, validated
from jaxcrumple.scenes.catalogue import SCENES, SceneEntry
from jaxcrumple.scenes.functions import absolute, scene_entry
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.solvers.linear.registry import LinearSolverName
from jaxcrumple.solvers.scheme import Integrator, Scheme, integrator, switch_of
from jaxcrumple.solvers.switch import Switch

# Scene of a run that was started from a `Setup`.
PYTHON = "python"


class Options(BaseModel):
    """Base of all option groups; unknown names are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MaterialOptions(Options):
    """The material of the sheet in SI units; see `Material`. A `preset` supplies values that are not
    given."""

    preset: str | None = Field(None, examples=list(presets.PRESETS))
    young_modulus: Pascal = 1e9
    thickness: Metre = 0.25e-3
    density: KilogramPerCubicMetre = 1000.0
    yield_curvature: PerMetre | None = 200.0
    yield_c0: float | None = None
    gamma: float = 0.0
    plastic_time: Second = 1e-3
    drag_rate: PerSecond = 1e3
    internal_damping_time: Second = 2e-7
    mass_lumping: Literal["uniform", "area"] = "uniform"

    @field_validator("preset")
    @classmethod
    def _known(cls, name: str | None) -> str | None:
        return None if name is None else presets.find(name)

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, values: Any) -> Any:
        """Fill in the values of the named preset; `yield_c0` replaces the default yield curvature."""
        if not isinstance(values, Mapping):
            return values
        named, thickness = _preset_of(values.get("preset")), _positive(values.get("thickness"))
        if named is not None and ("thickness" not in values or thickness is not None):
            sized = {} if thickness is None else {"thickness": thickness}
            return presets.with_preset(named, {**values, **sized})
        if values.get("yield_c0") is not None and "yield_curvature" not in values:
            return {**values, "yield_curvature": None}
        return values

    def build(self) -> Material:
        """Build the material."""
        return Material(**self.model_dump(exclude={"preset"}))


def _preset_of(name: Any) -> presets.Preset | None:
    try:
        return presets.PRESETS[presets.find(name)] if isinstance(name, str) else None
    except ValueError:
        return None


def _positive(value: Any) -> float | None:
    """Convert the value of an option to a positive length in m; None if it is not one."""
    try:
        length = float(LENGTH.si(value))
    except (TypeError, ValueError, OverflowError):
        return None
    return length if length > 0 else None


# Options of which one replaces the other.
YIELD = {"yield_curvature", "yield_c0"}


class SolverOptions(Options):
    """The integrator; None selects the default of the scheme, see `integrator` and `Switch`. `ledger`:
    whether to keep the work ledger, see `Work`."""

    rtol: float = Field(1e-2, gt=0, lt=1.0, allow_inf_nan=False)
    scheme: Scheme = "hybrid"
    linear: LinearSolverName | None = None
    max_order: int = Field(5, ge=1, le=5)
    rho_infinity: float = Field(0.0, ge=0, le=1)
    max_step: Annotated[float | None, TIME] = Field(None, gt=0, allow_inf_nan=False)
    switch_up: float | None = Field(None, gt=0)
    switch_down: float | None = Field(None, gt=0)
    dwell: float | None = Field(None, ge=0)
    ignore: int | None = Field(None, ge=0)
    minimum_steps: int | None = Field(None, ge=1)
    ledger: bool = False

    def switch(self) -> Switch:
        """Build the stage switch; None selects the default of the scheme."""
        given: dict[str, Any] = {"up": self.switch_up, "down": self.switch_down, "dwell": self.dwell}
        given |= {"ignore": self.ignore, "minimum_steps": self.minimum_steps}
        given = {key: value for key, value in given.items() if value is not None}
        return switch_of(self.scheme, self.rtol, **given)

    def build(self) -> Integrator:
        """Build the integrator."""
        return integrator(
            self.rtol,
            scheme=self.scheme,
            linear=self.linear,
            switch=self.switch(),
            max_order=self.max_order,
            rho_infinity=self.rho_infinity,
            max_step=jnp.asarray(jnp.inf if self.max_step is None else self.max_step),
        )


class RunConfig(Options):
    """The complete configuration of one run: running it again gives the same answer.

    `scene`: a name, "module:function" or "file.py:function"; or "python" for a run of a `Setup`, whose scene
    and `material` (None) the options do not tell.
    """

    scene: Annotated[str, AfterValidator(absolute)]
    nodes: int = Field(1000, ge=16, le=1_000_000)
    seed: int = Field(0, ge=0)
    t_end: Second = Field(gt=0, lt=1e6, allow_inf_nan=False)
    frames: int = Field(26, ge=1, le=100_000)
    options: dict[str, Any] = Field(default_factory=dict)
    material: MaterialOptions | None = MaterialOptions()
    solver: SolverOptions = SolverOptions()

    def build(self) -> Setup:
        """Build mesh, scene and initial positions of the run."""
        if self.scene == PYTHON:
            raise ConfigError(
                "the run was started from a Setup that Python built; build it again and pass it: "
                "jaxcrumple.resume_run(folder, setup=setup)."
            )
        material = None if self.material is None else self.material.build()
        return scene_entry(self.scene).build(self.nodes, self.seed, material=material, **self.options)


def config_of(setup: Setup, solver: SolverOptions | Mapping[str, Any] | None = None) -> RunConfig:
    """Return the configuration of a run of a `Setup` that Python built.

    **Raises:** `ConfigError` for a setup without `t_end`, or unknown or impossible options of the solver.
    """
    if setup.t_end is None:
        raise ConfigError("the setup has no end time; give setup._replace(t_end=...) in s.", ("t_end",))
    if not isinstance(solver, SolverOptions):
        solver = validated(SolverOptions, solver or {}, ("solver",))
    frames = {} if setup.frames is None else {"frames": setup.frames}
    given = {"scene": PYTHON, "nodes": setup.mesh.n_nodes, "t_end": setup.t_end, "material": None}
    contact = None if setup.contact is None else setup.contact.potential
    return validated(RunConfig, {**given, **frames, "options": {"contact": contact}, "solver": solver})


def configure(
    scene: str,
    *,
    nodes: int = 1000,
    seed: int = 0,
    t_end: float | str | None = None,
    settings: Sequence[str] | Mapping[str, Any] = (),
) -> RunConfig:
    """Configure a run of a named scene.

    **Arguments:** `scene`: its name, or "file.py:function"; `nodes`, `seed` of the random mesh; `settings`:
    options of scene, material or solver, as "key=value" strings or as a mapping; `t_end`: end time, by
    default that of the scene. Numbers are in SI units; strings may carry a unit, e.g. "0.25 mm".

    **Returns:** a `RunConfig` for `start_run`.

    **Raises:** `ConfigError` for an unknown scene, key or value.

    >>> run = jc.configure("radial", nodes=300, settings={"thickness": "0.1 mm", "rtol": 1e-3})
    >>> run.material.thickness, run.solver.rtol, run.options["radius"], run.t_end  # m, -, m, s
    (0.0001, 0.001, 0.071, 2.6)
    >>> jc.configure("radial", settings={"thicknes": 1e-4})
    Traceback (most recent call last):
    jaxcrumple.options.validation.ConfigError: ...
    """
    top = {"scene": scene, "nodes": nodes, "seed": seed}
    return complete(with_settings(top | ({} if t_end is None else {"t_end": t_end}), settings))


def with_settings(values: Mapping[str, Any], settings: Sequence[str] | Mapping[str, Any]) -> dict[str, Any]:
    """Replace single options, given by name, in values that are grouped as in a scene file.

    **Raises:** `ConfigError` for an unknown scene or name.
    """
    groups = _groups(_entry(values.get("scene")))
    changed = dict(values)
    for key, value in pairs(settings):
        if key == "frames":
            changed[key] = value
        else:
            name = _group(key, groups)
            _check_table(name, changed.get(name, {}))
            changed[name] = {**changed.get(name, {}), key: value}
    return changed


def complete(values: Mapping[str, Any], context: Any = None) -> RunConfig:
    """Validate grouped values and fill in the defaults of the scene.

    **Arguments:** `values`: `scene`, `nodes`, `seed`, `t_end`, `frames`, and mappings `options`, `material`
    and `solver`; `context`: origin of the values, for validators of the scene's options.

    **Raises:** `ConfigError` for unknown names and impossible values.
    """
    entry = _entry(values.get("scene"))
    groups = _groups(entry)
    _check_names(values, groups)
    parts = {name: values.get(name, {}) for name in groups}
    for name, part in parts.items():
        _check_table(name, part)
    if entry.material is not None:
        parts["material"] = _of_scene(entry.material, parts["material"])
    if parts["solver"].get("scheme") == "paper" and "damping" in entry.options.model_fields:
        # The paper's scheme uses the internal damping (25) by default.
        parts["options"] = {"damping": "paper", **parts["options"]}
    checked = {name: validated(model, parts[name], (name,), context) for name, model in groups.items()}
    checked["options"] = checked["options"].model_dump()
    config = validated(RunConfig, {**_length(entry, values, checked), **values, **checked})
    last = entry.lasts(config.options)
    if config.t_end >= last:
        raise ConfigError(
            f"t_end = {config.t_end:g} s must be less than {last:g} s, {entry.why_it_ends} ({config.scene}).",
            ("t_end",),
        )
    for name in ("material", "solver"):
        try:
            getattr(config, name).build()
        except ValueError as error:
            raise ConfigError(str(error), _place(name, groups[name], str(error))) from error
    return config


def _of_scene(material: Material, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `given` options of the material, completed by those of a scene's own default material."""
    if given.get("preset") is not None:
        return dict(given)
    names = set(MaterialOptions.model_fields) - {"preset"}
    if YIELD & set(given):
        names -= YIELD
    return {**{name: getattr(material, name) for name in names}, **given}


def _length(entry: SceneEntry, values: Mapping[str, Any], checked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the default end time in s, and the frames if the scene has its own default.

    A function of the user is called for them, unless they are given.
    """
    if not entry.own:
        return {"t_end": entry.end(checked["options"])}
    if "t_end" in values and "frames" in values:
        return {}
    # The end time is not known yet, but nodes and seed must be valid.
    draft = validated(RunConfig, {"t_end": 1.0, **values, **checked})
    setup = draft.build()
    found = {"t_end": setup.t_end, "frames": setup.frames}
    if setup.t_end is None and "t_end" not in values:
        entry.end(draft.options)
    return {name: value for name, value in found.items() if value is not None}


def _entry(scene: Any) -> SceneEntry:
    if scene is None:
        raise ConfigError(f"scene is missing; give one of {', '.join(SCENES)}.", ("scene",))
    return scene_entry(scene)


def _groups(entry: SceneEntry) -> dict[str, type[BaseModel]]:
    return {"options": entry.options, "material": MaterialOptions, "solver": SolverOptions}


def _check_names(values: Mapping[str, Any], groups: Mapping[str, type[BaseModel]]) -> None:
    """Refuse an unknown name at the top level, or one that belongs into a table."""
    for key in values:
        owners = [name for name, model in groups.items() if key in model.model_fields]
        if key not in RunConfig.model_fields:
            cure = (
                f"; move it to the table [{owners[0]}]." if owners else nearest(key, RunConfig.model_fields)
            )
            raise ConfigError(f"{key!r} is unknown{' here' if owners else ''}{cure}", (key,))


def _check_table(name: str, part: Any) -> None:
    if not isinstance(part, Mapping):
        raise ConfigError(f"{name} = {shortened(part)} must be a table of options, [{name}].", (name,))


def _place(group: str, model: type[BaseModel], message: str) -> Place:
    """Locate the option that a builder's message names in its first word."""
    first = message.split(maxsplit=1)[0]
    return (group, first) if first in model.model_fields else (group,)


def unit_named(scene: str, name: str) -> Unit | None:
    """Return the unit of an option of scene, material or solver; None for an unknown option or no unit."""
    fields = [model.model_fields.get(name) for model in _groups(_entry(scene)).values()]
    return next((unit_of(field) for field in fields if field is not None), None)


def pairs(settings: Sequence[str] | Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return names and values of settings or "key=value" strings; the word none means None."""
    found: list[tuple[str, Any]] = []
    for text in () if isinstance(settings, Mapping) else settings:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise ConfigError(f"setting {text!r} must read key=value, e.g. thickness=1e-4.")
        found.append((key.strip(), value.strip()))
    named = list(settings.items()) if isinstance(settings, Mapping) else found
    return [(key, None if str(value).lower() == "none" else value) for key, value in named]


def _group(key: str, groups: Mapping[str, type[BaseModel]]) -> str:
    for name, model in groups.items():
        if key in model.model_fields:
            return name
    if key in ("nodes", "seed", "t_end"):
        flag = key.replace("_", "-")
        raise ConfigError(f"{key!r} is not a setting: give it as an argument, on the command line --{flag}.")
    known = ["frames", "nodes", "seed", *(field for model in groups.values() for field in model.model_fields)]
    raise ConfigError(f"setting {key!r} is unknown{nearest(key, known)}")
