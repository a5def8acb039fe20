"""Sets of units as the bits of an integer: who is alive and who is near, for many units at once.

A loop over such a set visits only its members, and needs no branch that the processor could guess wrongly for
all the others. Bit k of a set stands for unit first + k, where `first` goes with the set. How vectors become
bits is as on little-endian machines.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from liir_common.battle.tables import SET_SIZE, inlined
from liir_common.llvm import broadcast

_LANES = 4
_SET = ir.IntType(SET_SIZE)
_DOUBLES, _BYTES = ir.VectorType(ir.DoubleType(), _LANES), ir.VectorType(ir.IntType(8), SET_SIZE)
NOBODY, _ONE = np.uint64(0), np.uint64(1)


@inlined
def near(battle, i, radii2, first, last):
    """The units from `first` to before `last` that are nearer to i than a radius: i itself, and the dead too.

    They are SET_SIZE at most. `radii2` is the square of that radius, or the squares [room] for every unit. Of
    the few places from `last` on that share its last comparison, the set may hold some as well.
    """
    found = NOBODY
    for j in range(first, last, _LANES):
        found |= _closer(battle.x, battle.y, radii2, j, battle.x[i], battle.y[i]) << np.uint64(j - first)
    return found


@inlined
def holds(numbers, k):
    """Whether bit k, below SET_SIZE, is in the set."""
    return (numbers >> np.uint64(k)) & _ONE != NOBODY


@inlined
def only(k):
    """The set of bit k alone; from SET_SIZE on k begins again at 0."""
    # A shift by so much is undefined, and larger battles ask for it, though for a set that nobody looks at.
    return _ONE << (np.uint64(k) & np.uint64(SET_SIZE - 1))


@inlined
def above(k):
    """The set of all bits above k, itself not among them; k is below SET_SIZE."""
    return ~((only(k) << _ONE) - _ONE)


def _lowest(typing_context, numbers):
    """The lowest bit of a set that is not empty."""

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        return b.trunc(b.cttz(arguments[0], ir.Constant(ir.IntType(1), 1)), ir.IntType(32))

    # 32 bits, unsigned: so no index made of it needs a test for being negative.
    return types.uint32(types.uint64), generate


def _members(typing_context, truths, first):
    """The set of those that are true of SET_SIZE values of `truths` [room], from `first` on."""
    if not (truths.ndim == 1 and truths.dtype == types.bool_ and truths.layout == "C"):
        raise TypingError("members wants a contiguous vector of truth values")

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        values = _load(context, b, signature.args[0], arguments[0], arguments[1], _BYTES)
        return b.bitcast(b.icmp_unsigned("!=", values, ir.Constant(_BYTES, None)), _SET)

    return types.uint64(truths, types.intp), generate


def _places_closer(typing_context, x, y, radii2, first, at_x, at_y):
    """The set of those of _LANES places from `first` on that are `near` (at_x, at_y)."""
    one_radius = isinstance(radii2, types.Float)
    arrays = (x, y) if one_radius else (x, y, radii2)
    if not all(a.ndim == 1 and a.dtype == types.float64 and a.layout == "C" for a in arrays):
        raise TypingError("near wants contiguous vectors of float64")

    def generate(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        def load(k: int) -> Any:
            return _load(context, b, signature.args[k], arguments[k], arguments[3], _DOUBLES)

        dx = b.fsub(load(0), broadcast(b, arguments[4], _DOUBLES))
        dy = b.fsub(load(1), broadcast(b, arguments[5], _DOUBLES))
        limits2 = broadcast(b, arguments[2], _DOUBLES) if one_radius else load(2)
        is_closer = b.fcmp_ordered("<", b.fadd(b.fmul(dx, dx), b.fmul(dy, dy)), limits2)
        return b.zext(b.bitcast(is_closer, ir.IntType(_LANES)), _SET)

    return types.uint64(x, y, radii2, types.intp, types.float64, types.float64), generate


lowest: Any = intrinsic(_lowest)
members: Any = intrinsic(_members)
_closer: Any = intrinsic(_places_closer)


def _load(context: Any, b: Any, kind: Any, array: Any, first: Any, vector: Any) -> Any:
    start = b.gep(context.make_array(kind)(context, b, array).data, [first])
    return b.load(b.bitcast(start, vector.as_pointer()), align=1)
