"""Numbers with a physical dimension: plain numbers in SI units, or strings with a unit.

An option field of one of the types below accepts both `0.25e-3` and `"0.25 mm"`. Pint converts in decimal
arithmetic, so both give the same number to the last digit.
"""

import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, Annotated, Any, get_args

from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from jaxcrumple.options.suggest import nearest

if TYPE_CHECKING:
    import pint

# A number and the text that follows it.
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*?)\s*")
# Products and quotients of unit names with powers of one digit, which Pint evaluates fast.
_NAME = r"[^\W\d_]+(?:(?:\^|\*\*)[+-]?\d)?"
_PRODUCT = re.compile(rf"(?:1|{_NAME})?(?:\s*[*/]\s*{_NAME}|\s+{_NAME})*")
# Most characters of a unit.
_LONGEST = 40


@dataclass(frozen=True)
class Unit:
    """The unit of a field: the `symbol` of the SI unit, the `name` of the dimension and an `example`.

    For a misspelt unit the message proposes the closest of the `usual` units.
    """

    symbol: str
    name: str
    example: str
    usual: tuple[str, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """Return the Pydantic schema that converts the value, then checks it as without this annotation."""
        return core_schema.no_info_before_validator_function(self.si, handler(source))

    def si(self, value: Any) -> Any:
        """Convert a string with a unit to a number in SI units; return any other value unchanged.

        **Raises:** `PydanticCustomError`, a ValueError, for an unknown unit or one of another dimension.
        """
        if isinstance(value, bool):
            raise _refused(f"is not a number; give {self.name}, such as {self.example!r}")
        found = _quantity(value)
        if found is None:
            return value
        number, text = found
        unit = self._parsed(text)
        if not unit.is_compatible_with(self.symbol):
            raise _refused(f"is {_dimension(unit)}; give {self.name}, such as {self.example!r}")
        try:
            return float((Decimal(number) * unit).to(self.symbol).magnitude)
        except ArithmeticError as error:
            raise _refused("is too large or too small a number; give another one") from error

    def _parsed(self, text: str) -> "pint.Unit":
        import pint

        try:
            if len(text) > _LONGEST or not _PRODUCT.fullmatch(text):
                raise ValueError("not a product of units")
            return _registry().parse_units("1" + text if text.startswith("/") else text)
        except (ValueError, pint.PintError) as error:
            hint = nearest(text[:_LONGEST], self.usual)
            raise _refused(f"has an unknown unit, {text[:_LONGEST]!r}{hint}") from error


def si_of_any(value: Any) -> Any:
    """Convert a string with any unit to a number in SI units; return any other value unchanged."""
    found = _quantity(value)
    if found is None:
        return value
    number, text = found
    # The parser needs the dimension only for its messages.
    return float((Decimal(number) * LENGTH._parsed(text)).to_base_units().magnitude)


def unit_of(field: Any) -> Unit | None:
    """Return the unit of a Pydantic field or of the items of its lists, or None."""
    return next((found for found in _metadata(field) if isinstance(found, Unit)), None)


def _metadata(annotation: Any) -> Iterator[Any]:
    """Yield all annotations of a type or a field, including inner types."""
    for name in ("metadata", "__metadata__"):
        yield from getattr(annotation, name, ())
    inner = getattr(annotation, "annotation", None)
    for part in (*get_args(annotation), *([] if inner is None else [inner])):
        yield from _metadata(part)


@functools.cache
def _registry() -> "pint.UnitRegistry":
    """Return Pint's units. The import takes 0.25 s, so it happens only when a unit needs it."""
    import pint

    return pint.UnitRegistry(non_int_type=Decimal)


def _quantity(value: Any) -> tuple[str, str] | None:
    """Split a string into its number and its unit; None for any other value."""
    found = _QUANTITY.fullmatch(value) if isinstance(value, str) and not _is_plain(value) else None
    return None if found is None else (found[1], found[2])


def _is_plain(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _refused(said: str) -> PydanticCustomError:
    return PydanticCustomError("unit", "{said}", {"said": said})


def _dimension(unit: "pint.Unit") -> str:
    """Describe the dimension of a unit in words."""
    if unit.dimensionless:
        return "a number without a unit of length, time or mass"
    for known in UNITS:
        if unit.is_compatible_with(known.symbol):
            return known.name
    return f"of dimension {unit.dimensionality}"


LENGTH = Unit("m", "a length", "0.25 mm", ("m", "dm", "cm", "mm", "um", "µm", "nm", "km", "inch", "micron"))
TIME = Unit("s", "a time", "2.6 s", ("s", "ms", "us", "min", "hour"))
SPEED = Unit("m/s", "a speed", "1 cm/s", ("m/s", "cm/s", "mm/s", "um/s", "km/h", "mm/min"))
ACCELERATION = Unit("m/s^2", "an acceleration", "-9.81 m/s^2", ("m/s^2", "cm/s^2", "mm/s^2"))
PRESSURE = Unit("Pa", "a pressure", "1 GPa", ("Pa", "kPa", "MPa", "GPa", "N/m^2", "N/mm^2", "bar", "psi"))
DENSITY = Unit("kg/m^3", "a density", "1.39 g/cm^3", ("kg/m^3", "g/cm^3", "kg/l", "g/ml"))
CURVATURE = Unit("1/m", "an inverse length", "200 1/m", ("1/m", "1/cm", "1/mm"))
RATE = Unit("1/s", "an inverse time", "1000 1/s", ("1/s", "1/ms", "Hz", "kHz"))
FORCE = Unit("N", "a force", "0.2 N", ("N", "mN", "kN", "uN"))
ANGLE = Unit("rad", "an angle", "30 deg", ("rad", "deg", "mrad"))
MASS = Unit("kg", "a mass", "1 g", ("kg", "g", "mg"))

UNITS = (LENGTH, TIME, SPEED, ACCELERATION, PRESSURE, DENSITY, CURVATURE, RATE, FORCE, MASS)

Metre = Annotated[float, LENGTH]
Second = Annotated[float, TIME]
MetrePerSecond = Annotated[float, SPEED]
MetrePerSecondSquared = Annotated[float, ACCELERATION]
Pascal = Annotated[float, PRESSURE]
KilogramPerCubicMetre = Annotated[float, DENSITY]
PerMetre = Annotated[float, CURVATURE]
PerSecond = Annotated[float, RATE]
Newton = Annotated[float, FORCE]
Radian = Annotated[float, ANGLE]
