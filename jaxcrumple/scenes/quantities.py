"""Types of the parameters of scene functions: numbers, with the units and bounds that scene files need."""

import math
from typing import Annotated, Literal

from pydantic import Field

from jaxcrumple.contact.sites import MOST_LEVEL
from jaxcrumple.options.units import Metre, MetrePerSecond, Newton, Radian, Second

Length = Annotated[Metre, Field(gt=0)]
Duration = Annotated[Second, Field(gt=0)]
Speed = Annotated[MetrePerSecond, Field(gt=0)]
Load = Annotated[Newton, Field(gt=0)]
Angle = Annotated[Radian, Field(gt=0, lt=math.pi)]
Slope = Annotated[float, Field(gt=0)]
Cycles = Annotated[int, Field(ge=1, le=1000)]
Sweeps = Annotated[int, Field(ge=0)]
Imperfection = Annotated[Metre, Field(ge=0)]
Damping = Literal["central", "paper"]
ContactLevel = Annotated[int, Field(ge=0, le=MOST_LEVEL)]
