"""Linear solvers as parameters of tests; the direct one where its extra is installed."""

import pytest

from jaxcrumple.solvers.linear.block_jacobi import BlockCG
from jaxcrumple.solvers.linear.direct import Direct
from jaxcrumple.solvers.linear.registry import direct_available
from jaxcrumple.solvers.linear.two_level import TwoLevel

needs_direct = pytest.mark.skipif(not direct_available(), reason="needs the extra `direct`")
ITERATIVE = [pytest.param(BlockCG(), id="block-cg"), pytest.param(TwoLevel(), id="two-level")]
SOLVERS = [pytest.param(Direct(), marks=needs_direct, id="direct"), *ITERATIVE]
