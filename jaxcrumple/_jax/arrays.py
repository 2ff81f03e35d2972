"""Names of the arrays that many functions share: their kinds and shapes, which the tests check at each call.

Other arrays are annotated in place, as `Int[Array, "edges 2"]`. Names of axes: `nodes`, `edges`, `hinges`,
`faces`, `elements`, `pairs`; a name has one size within a call, and within one object. Names that end in
`Like` are for what users pass: numbers of Python, NumPy or JAX.
"""

from jaxtyping import Array, ArrayLike, Bool, Float, Int, Real

Scalar = Float[Array, ""]
Count = Int[Array, ""]
Flag = Bool[Array, ""]
NodeVectors = Float[Array, "nodes 3"]
NodeValues = Float[Array, " nodes"]
EdgeValues = Float[Array, " edges"]
HingeValues = Float[Array, " hinges"]

ScalarLike = Real[ArrayLike, ""]
NodeVectorsLike = Real[ArrayLike, "nodes 3"]
HingeValuesLike = Real[ArrayLike, " hinges"]
