"""Materials of common sheets, with the sources of their numbers.

They are starting points: sheets of the same name differ by tens of per cent, and paper also varies with
direction and humidity. Data sheets do not give the yield curvature of the model. Here it follows from the
strain at which the surface of the sheet yields: curvature = strain / (thickness / 2). So it changes with the
thickness. `calibrate_fold` determines it from a fold.
"""

import contextlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from jaxcrumple.material.material import Material
from jaxcrumple.options.suggest import nearest


class Preset(NamedTuple):
    """A material: Young's modulus in Pa, density in kg/m3, usual thickness in m, and yield strain."""

    young_modulus: float
    density: float
    thickness: float
    yield_strain: float

    def yield_curvature(self, thickness: float) -> float:
        """Return the curvature in 1/m at which the surface of a sheet, `thickness` in m, yields."""
        return 2.0 * self.yield_strain / thickness


PAPER = Preset(young_modulus=3e9, density=800.0, thickness=0.1e-3, yield_strain=0.7e-2)
"""Copy paper of 80 g/m2 (its label) and 0.1 mm thickness, so 800 kg/m3. Young's modulus: textbooks (e.g.
Niskanen, Paper Physics, 2008) give about 2 GPa across and 5 GPa along the machine direction for printing
papers; 3 GPa is about the geometric mean. The yield strain is derived, and is the least certain of all: the
stress-strain curve leaves its straight line between about 0.3 and 1 % strain, without a sharp yield point."""

MYLAR = Preset(young_modulus=4.9e9, density=1390.0, thickness=50.8e-6, yield_strain=2e-2)
"""Mylar, a biaxially stretched PET film: moduli of 490 and 510 kg/mm2 (4.8 and 5.0 GPa), 1.39 g/cm3 and a
stress of 10 kg/mm2 (98 MPa) at 5 % elongation (DuPont Teijin Films, product information H-37232, "Mylar
polyester film: physical-thermal properties", table 1); 200 gauge, 50.8 um. The yield strain is derived: this
stress divided by the modulus, because beyond it the film flows at little higher stress."""

ALUMINIUM = Preset(young_modulus=69e9, density=2700.0, thickness=16e-6, yield_strain=0.05e-2)
"""Household foil of nearly pure aluminium (1235): 69 GPa and 2.7 g/cm3; its proof stress lies between 23 MPa
(soft) and 57 MPa (hard) (makeitfrom.com, "1235 aluminum"); 16 um thick. The yield strain is derived: a yield
stress of 35 MPa divided by the modulus. Foil hardens when it bends; the model does not include this."""

PRESETS: Mapping[str, Preset] = MappingProxyType({"paper": PAPER, "Mylar": MYLAR, "aluminium": ALUMINIUM})


def find(name: str) -> str:
    """Return the listed name of a preset, whatever the case of its letters.

    **Raises:** ValueError for an unknown one.
    """
    found = {known.lower(): known for known in PRESETS}.get(name.lower())
    if found is None:
        raise ValueError(f"preset {name!r} is unknown{nearest(name, PRESETS)}")
    return found


def preset(name: str, **values: Any) -> Material:
    """Make the `Material` of a preset; `values` replace its own, e.g. `preset("Mylar", thickness=0.1e-3)`.

    The yield curvature in 1/m follows the thickness, unless it or `yield_c0` is given. SI units as in
    `Material`. `PRESETS` lists the names; the sources of the numbers are in `jaxcrumple.material.presets`.

    **Raises:** ValueError for an unknown name or an impossible value.

    >>> film = jc.preset("Mylar", thickness=0.1e-3)
    >>> film.young_modulus, film.yield_curvature  # Pa, 1/m: 2 % strain at the surface
    (4900000000.0, 400.0)
    >>> jc.preset("milar")
    Traceback (most recent call last):
    ValueError: preset 'milar' is unknown; did you mean 'Mylar'?
    """
    return Material(**with_preset(PRESETS[find(name)], values))


def with_preset(found: Preset, values: Mapping[str, Any]) -> dict[str, Any]:
    """Complete `values` of a material in SI units with those of a preset."""
    own: dict[str, Any] = {"young_modulus": found.young_modulus, "density": found.density}
    own["thickness"] = found.thickness
    if values.get("yield_c0") is None:
        thickness = values.get("thickness", found.thickness)
        # `Material` refuses an invalid thickness with its own message.
        with contextlib.suppress(TypeError, ZeroDivisionError):
            own["yield_curvature"] = found.yield_curvature(thickness)
    else:
        own["yield_curvature"] = None
    return own | dict(values)
