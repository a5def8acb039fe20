"""What kernels that are written in LLVM's terms have in common."""

from typing import Any

from llvmlite import ir

_INDEX = ir.IntType(32)


def broadcast(builder: Any, value: Any, vector: Any) -> Any:
    """A vector with `value` in every lane."""
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, _INDEX(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INDEX, vector.count), None))
