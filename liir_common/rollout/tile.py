"""A block of a matrix product that stays in registers, written in LLVM's terms.

numba vectorises a loop that writes one row, which loads a weight for every multiplication. A block of four
rows loads it once for all four, and its sums never leave the registers.
"""

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import RequireLiteralValue, TypingError
from numba.extending import intrinsic

from liir_common.llvm import broadcast

_FLOAT, _BYTE = ir.FloatType(), ir.IntType(8)
_CONTRACT = ("contract",)


def _write_tile(typing_context, rows, vectors, lanes, x, weight, start, out, row, column):  # type: ignore[no-untyped-def]
    """out = start + x @ weight in `rows` rows and vectors·lanes columns, from `row` and `column` on.

    `rows`, `vectors` and `lanes` are literals. All arrays are float32 matrices; rows of all but `x` are
    contiguous, those of `start` may be one and the same, and `start` may be `out`. Every element adds its
    products one after another, so its bytes do not depend on the tile.
    """
    shape = (rows, vectors, lanes)
    matrices = (x, weight, start, out)
    if not all(isinstance(size, types.IntegerLiteral) for size in shape):
        raise RequireLiteralValue("write_tile wants literal rows, vectors and lanes")
    if not all(a.ndim == 2 and a.dtype == types.float32 for a in matrices):
        raise TypingError("write_tile wants float32 matrices")
    if weight.layout != "C" or out.layout != "C":
        raise TypingError("write_tile wants weight and out to be C-contiguous")

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        given = [
            _Matrix(context, b, kind, value)
            for kind, value in zip(signature.args[3:7], arguments[3:7], strict=True)
        ]
        _generate(b, given, [size.literal_value for size in shape], *arguments[7:])
        return context.get_dummy_value()

    return types.void(*shape, *matrices, types.intp, types.intp), generate


write_tile: Any = intrinsic(prefer_literal=True)(_write_tile)


class _Matrix:
    def __init__(self, context: Any, builder: Any, kind: Any, value: Any) -> None:
        array = context.make_array(kind)(context, builder, value)
        self._builder = builder
        self._start = builder.bitcast(array.data, _BYTE.as_pointer())
        self._strides = cgutils.unpack_tuple(builder, array.strides)
        self.columns = cgutils.unpack_tuple(builder, array.shape)[1]

    def pointer(self, row: Any, column: Any, kind: Any) -> Any:
        b = self._builder
        offset = b.add(b.mul(row, self._strides[0]), b.mul(column, self._strides[1]))
        return b.bitcast(b.gep(self._start, [offset]), kind.as_pointer())


def _generate(b: Any, matrices: Any, shape: list[int], row: Any, column: Any) -> None:
    x, weight, start, out = matrices
    rows, vectors, lanes = shape
    vector = ir.VectorType(_FLOAT, lanes)
    rows_ = [b.add(row, row.type(r)) for r in range(rows)]
    columns = [b.add(column, column.type(v * lanes)) for v in range(vectors)]

    def load(matrix: _Matrix, r: Any, c: Any) -> Any:
        return b.load(matrix.pointer(r, c, vector), align=4)

    # LLVM keeps what is on the stack of a function in registers where they suffice.
    sums = [[cgutils.alloca_once_value(b, load(start, r, c)) for c in columns] for r in rows_]
    with cgutils.for_range(b, x.columns) as loop:
        weights = [load(weight, loop.index, c) for c in columns]
        for r, line in zip(rows_, sums, strict=True):
            factor = broadcast(b, b.load(x.pointer(r, loop.index, _FLOAT)), vector)
            for total, w in zip(line, weights, strict=True):
                product = b.fmul(factor, w, flags=_CONTRACT)
                b.store(b.fadd(b.load(total), product, flags=_CONTRACT), total)
    for r, line in zip(rows_, sums, strict=True):
        for c, total in zip(columns, line, strict=True):
            b.store(b.load(total), out.pointer(r, c, vector), align=4)
