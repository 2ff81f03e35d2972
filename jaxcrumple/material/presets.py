"""Materials of common sheets, with where their numbers come from.

They are starting points: sheets of one name differ by tens of percent, paper with direction and humidity as
well. A model's yield curvature is not what a data sheet tells. Here it follows from a strain at which the
surface of the sheet yields, curvature = strain / (thickness / 2), so that it changes with the thickness;
`calibrate_fold` finds it from a fold.
"""

import contextlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxcrumple.material.material import Material
from jaxcrumple.options.suggest import nearest


class Preset(NamedTuple):
    """A material by Young's modulus in Pa, density in kg/m3, the usual thickness in m, and the strain at
    which it yields."""

    young_modulus: float
    density: float
    thickness: float
    yield_strain: float

    def yield_curvature(self, thickness: float) -> float:
        """Curvature in 1/m at which the surface of a sheet of a `thickness` in m reaches the yield strain."""
        return 2.0 * self.yield_strain / thickness


PAPER = Preset(young_modulus=3e9, density=800.0, thickness=0.1e-3, yield_strain=0.7e-2)
"""Copy paper, by its own label 80 g/m2, and 0.1 mm thick, so 800 kg/m3. Young's modulus: textbooks (e.g.
Niskanen, Paper Physics, 2008) have about 2 GPa across and 5 GPa along the machine's direction for printing
papers, of which 3 GPa is about the geometric mean. Derived, and the least certain of all: stress leaves its
straight line between some 0.3 and 1 % of strain, and no point there is a sharp yield point."""

MYLAR = Preset(young_modulus=4.9e9, density=1390.0, thickness=50.8e-6, yield_strain=2e-2)
"""Mylar, a film of PET stretched both ways: moduli of 490 and 510 kg/mm2 (4.8 and 5.0 GPa), 1.39 g/cm3 and a
stress of 10 kg/mm2 (98 MPa) at 5 % elongation (DuPont Teijin Films, product information H-37232, "Mylar
polyester film: physical-thermal properties", table 1); 200 gauge, 50.8 um. Derived: its yield strain is that
stress over the modulus, as the film flows at little more stress from there on."""

ALUMINIUM = Preset(young_modulus=69e9, density=2700.0, thickness=16e-6, yield_strain=0.05e-2)
"""Household foil of nearly pure aluminium (1235): 69 GPa and 2.7 g/cm3; its proof stress lies between 23 MPa,
soft, and 57 MPa, hard (makeitfrom.com, "1235 aluminum"); 16 um thick. Derived: a yield stress of 35 MPa over
the modulus. Foil hardens when it is bent, which the model does not."""

PRESETS: Mapping[str, Preset] = MappingProxyType({"paper": PAPER, "Mylar": MYLAR, "aluminium": ALUMINIUM})


def find(name: str) -> str:
    """The name of a preset as it is listed, whatever its capitals.

    **Raises:** ValueError for an unknown one.
    """
    found = {known.lower(): known for known in PRESETS}.get(name.lower())
    if found is None:
        raise ValueError(f"preset {name!r} is unknown{nearest(name, PRESETS)}")
    return found


def preset(name: str, **values: Any) -> Material:
    """A `Material` of a preset, single `values` of it replaced, e.g. `preset("Mylar", thickness=0.1e-3)`.

    The yield curvature in 1/m follows the thickness, unless it or `yield_c0` is given. SI units as in
    `Material`.

    **Raises:** ValueError for an unknown name or an impossible value.
    """
    return Material(**with_preset(PRESETS[find(name)], values))


def with_preset(found: Preset, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a material in SI units, those that are missing as a preset has them."""
    own: dict[str, Any] = {"young_modulus": found.young_modulus, "density": found.density}
    own["thickness"] = found.thickness
    if values.get("yield_c0") is None:
        thickness = values.get("thickness", found.thickness)
        # One that cannot be is refused where it is used.
        with contextlib.suppress(TypeError, ZeroDivisionError):
            own["yield_curvature"] = found.yield_curvature(thickness)
    else:
        own["yield_curvature"] = None
    return own | dict(values)
