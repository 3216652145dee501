"""Eight floats or integers at once, for numba: vector instructions spelled out.

Loops over eight pixels are not vectorised reliably, so the innermost operations are written in LLVM's own portable
vector instructions; a processor without wide registers runs them in pieces. ``Lanes`` makes them read as formulas.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir

from gpvo.sim.render.scene import LANES

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
FLOATS, INTS = ir.VectorType(_FLOAT, LANES), ir.VectorType(_INT, LANES)
# Fused multiply-adds, no NaNs: the same result in every thread, unlike a change of the order of sums.
_FLAGS = ("contract", "nsz", "nnan")


class Lanes:
    """Eight values while code is being generated; the usual operators act on all of them."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    @property
    def _is_float(self) -> bool:
        return self.value.type.element == _FLOAT

    def _other(self, other: Lanes | float | int) -> Any:
        if isinstance(other, Lanes):
            return other.value
        element, number = (_FLOAT, float(other)) if self._is_float else (_INT, int(other))
        return ir.Constant(ir.VectorType(element, LANES), [number] * LANES)

    def _apply(self, float_name: str, int_name: str, other: Lanes | float | int) -> Lanes:
        right = self._other(other)
        if self._is_float:
            return Lanes(self.builder, getattr(self.builder, float_name)(self.value, right, flags=_FLAGS))
        return Lanes(self.builder, getattr(self.builder, int_name)(self.value, right))

    def __add__(self, other: Lanes | float | int) -> Lanes:
        return self._apply("fadd", "add", other)

    def __sub__(self, other: Lanes | float | int) -> Lanes:
        return self._apply("fsub", "sub", other)

    def __mul__(self, other: Lanes | float | int) -> Lanes:
        return self._apply("fmul", "mul", other)

    def __truediv__(self, other: Lanes | float) -> Lanes:
        return self._apply("fdiv", "sdiv", other)

    def __and__(self, other: Lanes | int) -> Lanes:
        return self._apply("", "and_", other)

    def __rshift__(self, other: Lanes | int) -> Lanes:
        return self._apply("", "lshr", other)

    def compare(self, how: str, other: Lanes | float) -> Any:
        """Eight truth values, for ``choose``."""
        return self.builder.fcmp_ordered(how, self.value, self._other(other))

    def choose(self, condition: Any, other: Lanes | float) -> Lanes:
        """These lanes where ``condition`` holds, ``other`` elsewhere."""
        return Lanes(self.builder, self.builder.select(condition, self.value, self._other(other)))

    def truncated(self) -> Lanes:
        """Floats to integers, towards zero."""
        return Lanes(self.builder, self.builder.fptosi(self.value, INTS))

    def as_float(self) -> Lanes:
        """Integers to floats."""
        return Lanes(self.builder, self.builder.sitofp(self.value, FLOATS))

    def bits(self) -> Lanes:
        """The integers whose bit patterns the floats hold."""
        return Lanes(self.builder, self.builder.bitcast(self.value, INTS))

    def mix(self, other: Lanes, share: Lanes) -> Lanes:
        """``self`` at share 0, ``other`` at share 1."""
        return self + (other - self) * share


def spread(builder: Any, scalar: Any) -> Lanes:
    """A scalar in every lane."""
    kind = ir.VectorType(scalar.type, LANES)
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_INT, 0))
    zeros = ir.Constant(INTS, [0] * LANES)
    return Lanes(builder, builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), zeros))


def _address(builder: Any, data: Any, offset: Any) -> Any:
    return builder.bitcast(builder.gep(data, [offset]), ir.PointerType(FLOATS))


def load(builder: Any, data: Any, offset: Any, skip: int = 0) -> Lanes:
    """Eight floats from ``offset + skip`` of a float array."""
    at = builder.add(offset, ir.Constant(offset.type, skip)) if skip else offset
    return Lanes(builder, builder.load(_address(builder, data, at), align=4))


def store(builder: Any, values: Lanes, data: Any, offset: Any, skip: int = 0) -> None:
    """Eight floats to ``offset + skip`` of a float array."""
    at = builder.add(offset, ir.Constant(offset.type, skip)) if skip else offset
    builder.store(values.value, _address(builder, data, at), align=4)


def lane(builder: Any, values: Lanes, k: int) -> Any:
    """One of the eight values."""
    return builder.extract_element(values.value, ir.Constant(_INT, k))


def gather(builder: Any, data: Any, index: Lanes) -> Lanes:
    """Eight integers of an integer array, at eight places."""
    result: Any = ir.Constant(INTS, ir.Undefined)
    for k in range(LANES):
        at = builder.sext(lane(builder, index, k), ir.IntType(64))
        result = builder.insert_element(result, builder.load(builder.gep(data, [at])), ir.Constant(_INT, k))
    return Lanes(builder, result)


def transpose(builder: Any, rows: Sequence[Lanes]) -> list[Lanes]:
    """Eight rows of eight floats turned into eight columns."""
    values = [row.value for row in rows]
    # Three rounds of swapping blocks of 4, 2 and 1 between rows that are as far apart.
    for block in (4, 2, 1):
        low = [k if not k & block else k - block + LANES for k in range(LANES)]
        high = [k + block if not k & block else k + LANES for k in range(LANES)]
        for k in [k for k in range(LANES) if not k & block]:
            a, b = values[k], values[k + block]
            values[k] = builder.shuffle_vector(a, b, ir.Constant(INTS, low))
            values[k + block] = builder.shuffle_vector(a, b, ir.Constant(INTS, high))
    return [Lanes(builder, value) for value in values]
