"""Units of options, and materials by name."""

import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.material.presets import PRESETS
from jaxcrumple.options.units import (
    ACCELERATION,
    ANGLE,
    CURVATURE,
    DENSITY,
    FORCE,
    LENGTH,
    PRESSURE,
    SPEED,
    TIME,
)
from jaxcrumple.run.config import MaterialOptions, RunConfig, configure


@pytest.mark.parametrize(
    ("unit", "text", "value"),
    [
        (LENGTH, "7.1 cm", 0.071),
        (LENGTH, "0.25mm", 0.25e-3),
        (LENGTH, " 25 um ", 25e-6),
        (LENGTH, "1 inch", 0.0254),
        (TIME, "2.6 s", 2.6),
        (TIME, "1.5 min", 90.0),
        (SPEED, "1 cm/s", 0.01),
        (SPEED, "36 km/hour", 10.0),
        (ACCELERATION, "-981 cm s^-2", -9.81),
        (PRESSURE, "4.9 GPa", 4.9e9),
        (DENSITY, "1.39 g/cm^3", 1390.0),
        (CURVATURE, "200/m", 200.0),
        (CURVATURE, "2 1/cm", 200.0),
        (FORCE, "0.2 N", 0.2),
        (ANGLE, "180 deg", np.pi),
    ],
)
def test_strings_with_units_are_the_number_to_the_last_digit(unit, text, value):
    assert unit.si(text) == value


@pytest.mark.parametrize("value", [0.1, 3, "0.1", "1e-4", "nan", None, "thin", [1]])
def test_what_has_no_unit_is_left_alone(value):
    assert LENGTH.si(value) is value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("3 s", "is a time; give a length, such as '0.25 mm'"),
        ("3 N", "is a force; give a length"),
        ("3 K", r"is of dimension \[temperature\]; give a length"),
        ("3 rad", "is a number without a unit of length, time or mass; give a length"),
        ("3 mn", "has an unknown unit, 'mn'; did you mean 'm'"),
        ("3 m^9^9^9", "has an unknown unit"),
        ("3 m**999999", "has an unknown unit"),
        ("3 __import__('os')", "has an unknown unit"),
        ("3 m + 2 m", "has an unknown unit"),
        ("1e999999999 km", "is too large or too small a number"),
        (True, "is not a number; give a length"),
    ],
)
def test_other_units_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        LENGTH.si(text)


def test_settings_carry_units():
    settings = ["thickness=0.2mm", "radius=8 cm", "max_step=1 ms", "young_modulus=2 GPa", "hold=0.5 s"]
    config = configure("radial", t_end="500 ms", settings=settings)
    assert (config.material.thickness, config.options["radius"]) == (0.2e-3, 0.08)
    assert (config.solver.max_step, config.t_end, config.options["hold"]) == (1e-3, 0.5, 0.5)
    with pytest.raises(jc.ConfigError, match=r"material\.thickness = '3 s' is a time; give a length"):
        configure("radial", settings=["thickness=3 s"])


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_materials_and_options(name):
    made = jc.preset(name)
    options = configure("radial", settings=[f"preset={name.upper()}"]).material
    assert options.preset == name
    for field in ("young_modulus", "thickness", "density", "yield_curvature"):
        assert getattr(made, field) == getattr(options, field) == getattr(options.build(), field)
    # Thickness is that of a sheet, and the surface yields at the strain that is listed.
    assert made.yield_curvature * made.thickness / 2 == pytest.approx(PRESETS[name].yield_strain)
    twice = jc.preset(name, thickness=2 * made.thickness)
    assert twice.yield_curvature == pytest.approx(made.yield_curvature / 2)
    assert MaterialOptions(preset=name, thickness=twice.thickness).build() == twice or (
        MaterialOptions(preset=name, thickness=twice.thickness).yield_curvature == twice.yield_curvature
    )


def test_single_values_replace_those_of_a_preset():
    assert jc.preset("paper", yield_c0=0.3).yield_curvature is None
    assert jc.preset("paper", yield_curvature=None).is_elastic
    config = configure("radial", settings=["preset=paper", "density=1 g/cm^3", "yield_c0=0.3"])
    assert (config.material.density, config.material.build().yield_c0) == (1000.0, 0.3)
    with pytest.raises(ValueError, match="preset 'papr' is unknown; did you mean 'paper'"):
        jc.preset("papr")
    for thickness in (0.0, -1e-4, "thick"):
        with pytest.raises(ValueError, match=r"thickness = .* is not usable"):
            jc.preset("Mylar", thickness=thickness)


@pytest.mark.parametrize("settings", [["yield_c0=0.3"], ["preset=Mylar", "thickness=1 mm"]])
def test_a_stored_material_is_the_same(settings):
    config = configure("radial", settings=settings)
    again = RunConfig(**config.model_dump(mode="json"))
    assert again == config
    assert again.material.build().yield_c0 == config.material.build().yield_c0
