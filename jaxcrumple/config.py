"""What a run is asked to do: options of scene, material and solver, validated before any work."""

import difflib
from collections.abc import Mapping, Sequence
from types import NoneType
from typing import Any, Literal, get_args

import jax.numpy as jnp
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxcrumple.material import Material
from jaxcrumple.scenes import SCENES, Setup
from jaxcrumple.solvers.scheme import Integrator, Scheme, integrator, switch_of
from jaxcrumple.solvers.switch import Switch


class ConfigError(ValueError):
    """An option that cannot be; the message names it, the cause and the cure."""


class Options(BaseModel):
    """Base of all option groups: unknown names are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class MaterialOptions(Options):
    """The sheet's material, in SI units; see `Material`."""

    young_modulus: float = 1e9
    thickness: float = 0.25e-3
    density: float = 1000.0
    yield_curvature: float | None = 200.0
    yield_c0: float | None = None
    gamma: float = 0.0
    plastic_time: float = 1e-3
    drag_rate: float = 1e3
    internal_damping_time: float = 2e-7
    mass_lumping: Literal["uniform", "area"] = "uniform"

    def build(self) -> Material:
        """The material; `yield_c0` takes the place of the default yield curvature."""
        values = self.model_dump()
        if self.yield_c0 is not None and "yield_curvature" not in self.model_fields_set:
            values["yield_curvature"] = None
        return Material(**values)


class SolverOptions(Options):
    """The integrator, None meaning the scheme's own; see `integrator` and `Switch`. `ledger`: of work,
    see `Work`."""

    rtol: float = Field(1e-2, gt=0, lt=0.1, allow_inf_nan=False)
    scheme: Scheme = "hybrid"
    linear: Literal["auto", "direct", "two-level", "block-cg"] | None = None
    max_order: int = Field(5, ge=1, le=5)
    rho_infinity: float = Field(0.0, ge=0, le=1)
    max_step: float | None = Field(None, gt=0, allow_inf_nan=False)
    switch_up: float | None = Field(None, gt=0)
    switch_down: float | None = Field(None, gt=0)
    dwell: float | None = Field(None, ge=0)
    ignore: int | None = Field(None, ge=0)
    minimum_steps: int | None = Field(None, ge=1)
    ledger: bool = False

    def switch(self) -> Switch:
        """When the scheme changes the stage; what is None is the scheme's own."""
        given: dict[str, Any] = {"up": self.switch_up, "down": self.switch_down, "dwell": self.dwell}
        given |= {"ignore": self.ignore, "minimum_steps": self.minimum_steps}
        given = {key: value for key, value in given.items() if value is not None}
        return switch_of(self.scheme, self.rtol, **given)

    def build(self) -> Integrator:
        """The integrator."""
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
    """One run, complete: enough to start it again and get the same answer."""

    scene: str
    nodes: int = Field(1000, ge=16, le=1_000_000)
    seed: int = Field(0, ge=0)
    t_end: float = Field(gt=0, lt=1e6, allow_inf_nan=False)
    frames: int = Field(26, ge=1, le=100_000)
    options: dict[str, Any] = Field(default_factory=dict)
    material: MaterialOptions = MaterialOptions()
    solver: SolverOptions = SolverOptions()

    def build(self) -> Setup:
        """Mesh, scene and start of the run."""
        entry = SCENES[self.scene]
        return entry.build(self.nodes, self.seed, material=self.material.build(), **self.options)


def configure(
    scene: str,
    *,
    nodes: int = 1000,
    seed: int = 0,
    t_end: float | None = None,
    settings: Sequence[str] | Mapping[str, Any] = (),
) -> RunConfig:
    """Configuration of a run of a named scene.

    **Arguments:** `settings`: "key=value" strings, or a mapping, of any option of the scene, the
    material or the solver; `t_end` in s, by default the scene's own.

    **Raises:** `ConfigError` for an unknown scene, key or value.
    """
    if scene not in SCENES:
        raise ConfigError(f"scene {scene!r} is unknown{_nearest(scene, SCENES)}")
    entry = SCENES[scene]
    groups: dict[str, type[BaseModel]] = {
        "options": entry.options,
        "material": MaterialOptions,
        "solver": SolverOptions,
    }
    values: dict[str, Any] = {name: {} for name in groups}
    top: dict[str, Any] = {
        "scene": scene,
        "nodes": nodes,
        "seed": seed,
        "t_end": t_end,
    }
    for key, value in pairs(settings):
        if key == "frames":
            top[key] = value
        else:
            values[_group(key, groups)][key] = value
    if values["solver"].get("scheme") == "paper" and "damping" in entry.options.model_fields:
        # The paper's scheme has its internal damping (25), unless another is asked for.
        values["options"].setdefault("damping", "paper")
    options = validated(entry.options, values["options"]).model_dump()
    parts = {
        "options": options,
        "material": validated(MaterialOptions, values["material"]),
        "solver": validated(SolverOptions, values["solver"]),
    }
    if t_end is None:
        top["t_end"] = entry.ends(options)
    config = validated(RunConfig, {**top, **parts})
    last = entry.lasts(config.options)
    if config.t_end >= last:
        raise ConfigError(
            f"t_end = {config.t_end:g} s must be less than {last:g} s, {entry.why_it_ends} ({scene})."
        )
    try:
        config.material.build()
        config.solver.build()
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return config


def pairs(settings: Sequence[str] | Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Names and values of settings or "key=value" strings; the word none stands for None."""
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
        raise ConfigError(f"{key!r} is not a setting: give it beside them, on the command line as --{flag}.")
    known = ["frames", "nodes", "seed", *(field for model in groups.values() for field in model.model_fields)]
    raise ConfigError(f"setting {key!r} is unknown{_nearest(key, known)}")


def _nearest(name: str, known) -> str:
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.4)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; choose one of {', '.join(sorted(known))}."


def validated(model: type[BaseModel], values: Mapping[str, Any]) -> Any:
    """A model of values. **Raises:** `ConfigError` that names the first one that cannot be."""
    try:
        return model(**values)
    except ValidationError as error:
        # A misspelt name tells more than the one that is missing for it.
        first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "missing":
            raise ConfigError(f"{where} is missing; give one.") from error
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"{where!r} is unknown{_nearest(where, model.model_fields)}") from error
        place = f"{where} = {first.get('input')!r}: " if where else ""
        optional = where in model.model_fields and NoneType in get_args(model.model_fields[where].annotation)
        said = first["msg"].removeprefix("Value error, ") + (", or none" if optional else "")
        raise ConfigError(f"{place}{said}.") from error
