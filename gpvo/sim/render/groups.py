"""What is done to eight neighbouring pixels at once: covering, testing, and texturing them."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gpvo.sim.render.lanes import FLOATS, LANES, Lanes, gather, lane, load, spread, store, transpose

# Columns of a triangle's table: what is linear over it, against the ray; then constants.
U, V, LIGHT, U0, V0, TAP_U, TAP_V, START, SIZE, TAPS = 0, 3, 6, 9, 10, 11, 12, 13, 14, 15
COLUMNS = 16
# Rows of the scratch memory that a group's taps share.
S_U, S_V, S_LIGHT, S_DISTANCE, S_SUM, S_TAP_U, S_TAP_V, S_START, S_SIZE, S_STEP, S_BLEND = range(11)
SCRATCH = 11 * LANES


def _data(context: Any, builder: Any, sig: Any, args: Any, k: int) -> Any:
    return context.make_array(sig.args[k])(context, builder, args[k]).data


def _dot(a: list[Lanes], b: list[Lanes]) -> Lanes:
    return a[0] * b[0] + (a[1] * b[1] + a[2] * b[2])


@intrinsic
def cover_group(typingctx, pixels, offset, row, owner):  # type: ignore[no-untyped-def]
    """Let a triangle take those of eight pixels that it covers nearer than what is there.

    ``pixels`` (N,) float32 holds five groups of eight from ``offset`` on: ray x, y, z, inverse distance, owner.
    ``row``: ten floats, the triangle's rows for the sum, the second and the third corner, and minus the tolerance.
    """
    signature = types.void(pixels, types.int64, row, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data, at, new = _data(context, builder, sig, args, 0), args[1], spread(builder, args[3])
        row = [spread(builder, number) for number in cgutils.unpack_tuple(builder, args[2], 10)]
        ray = [load(builder, data, at, k * LANES) for k in range(3)]
        old, was = load(builder, data, at, 3 * LANES), load(builder, data, at, 4 * LANES)
        inverse, second, third = (_dot(row[k : k + 3], ray) for k in (0, 3, 6))
        edge = row[9] * inverse
        inside = inverse.compare(">", old)
        for value in (second, third, inverse - second - third):
            inside = builder.and_(inside, value.compare(">=", edge))
        store(builder, inverse.choose(inside, old), data, at, 3 * LANES)
        store(builder, new.choose(inside, was), data, at, 4 * LANES)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def any_below(typingctx, pixels, offset, limit):  # type: ignore[no-untyped-def]
    """Whether one of the eight floats of ``pixels`` (N,) from ``offset`` on is less than ``limit``."""
    signature = types.boolean(pixels, types.int64, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = _data(context, builder, sig, args, 0)
        below = load(builder, data, args[1]).compare("<", spread(builder, args[2]))
        bits = builder.bitcast(below, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return signature, generate


@intrinsic
def begin_group(typingctx, pixels, offset, table, scratch):  # type: ignore[no-untyped-def]
    """Texture coordinates, light and distance of eight pixels, from the tables of the triangles they see.

    ``table`` (T * 16,) float32; ``scratch`` (88,) float32 receives what the taps need.
    """
    signature = types.void(pixels, types.int64, table, scratch)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data, at = _data(context, builder, sig, args, 0), args[1]
        tables, memory = _data(context, builder, sig, args, 2), _data(context, builder, sig, args, 3)
        ray = [load(builder, data, at, k * LANES) for k in range(3)]
        inverse = load(builder, data, at, 3 * LANES)
        owner = (load(builder, data, at, 4 * LANES) * COLUMNS).truncated()
        starts = [builder.sext(lane(builder, owner, k), ir.IntType(64)) for k in range(LANES)]
        columns = []
        for half in (0, LANES):
            columns += transpose(builder, [load(builder, tables, start, half) for start in starts])
        # Where there is nothing the inverse distance is zero; the blank triangle's light is zero too.
        one = Lanes(builder, ir.Constant(FLOATS, [1.0] * LANES))
        distance = one / inverse.choose(inverse.compare(">", 1e-9), 1e-9)
        taps = columns[TAPS].truncated().as_float()
        zero = ir.Constant(ir.IntType(64), 0)
        for row, values in (
            (S_U, columns[U0] + _dot(columns[U : U + 3], ray) * distance),
            (S_V, columns[V0] + _dot(columns[V : V + 3], ray) * distance),
            (S_LIGHT, _dot(columns[LIGHT : LIGHT + 3], ray) * distance),
            (S_DISTANCE, distance),
            (S_SUM, one - one),
            (S_TAP_U, columns[TAP_U]),
            (S_TAP_V, columns[TAP_V]),
            (S_START, columns[START]),
            (S_SIZE, columns[SIZE]),
            (S_STEP, one / taps),
            (S_BLEND, (columns[TAPS] - taps) * 2.0),
        ):
            store(builder, values, memory, zero, row * LANES)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def tap_group(typingctx, scratch, texels, number, next_level):  # type: ignore[no-untyped-def]
    """Add one texture tap of eight pixels to their sums.

    ``number``: which tap along the longer axis of the footprint; lanes with fewer taps add nothing. ``next_level``: 0
    for the pixel's own level of the pyramid, 1 for the coarser one, weighted by the blend between the two.
    """
    if not isinstance(next_level, types.IntegerLiteral):
        return None
    coarse = next_level.literal_value
    signature = types.void(scratch, texels, types.float32, next_level)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        memory, texture = _data(context, builder, sig, args, 0), _data(context, builder, sig, args, 1)
        zero = ir.Constant(ir.IntType(64), 0)

        def get(row: int) -> Lanes:
            return load(builder, memory, zero, row * LANES)

        step, blend, size, start = get(S_STEP), get(S_BLEND), get(S_SIZE), get(S_START).bits()
        along = (spread(builder, args[2]) + 0.5) * step - 0.5
        if coarse:
            whole = size.truncated()
            start = start + whole * whole
            size = size * 0.5
        value = _bilinear(
            builder, texture, start, size, get(S_U) + along * get(S_TAP_U), get(S_V) + along * get(S_TAP_V)
        )
        weight = step * blend if coarse else step * (blend * -1.0 + 1.0)
        weight = weight.choose(along.compare("<", 0.5), 0.0)
        store(builder, get(S_SUM) + value * weight, memory, zero, S_SUM * LANES)
        return context.get_dummy_value()

    return signature, generate


def _bilinear(builder: Any, texture: Any, start: Lanes, size: Lanes, u: Lanes, v: Lanes) -> Lanes:
    """Texture values 0..255 at eight points, repeated; each texel also holds its right and lower neighbours."""
    x, y = u * size - 0.5, v * size - 0.5
    i, j = x.truncated(), y.truncated()
    across, down = x - i.as_float(), y - j.as_float()
    whole = size.truncated()
    last = whole - 1
    four = gather(builder, texture, start + (j & last) * whole + (i & last))
    upper = (four & 255).as_float().mix(((four >> 8) & 255).as_float(), across)
    lower = ((four >> 16) & 255).as_float().mix((four >> 24).as_float(), across)
    return upper.mix(lower, down)


@intrinsic
def end_group(typingctx, scratch, pixels, offset, radiance, depth, place):  # type: ignore[no-untyped-def]
    """Write radiance and depth of eight pixels to ``place`` of two flat arrays."""
    signature = types.void(scratch, pixels, types.int64, radiance, depth, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        memory, data = _data(context, builder, sig, args, 0), _data(context, builder, sig, args, 1)
        zero = ir.Constant(ir.IntType(64), 0)
        albedo = load(builder, memory, zero, S_SUM * LANES) * (1 / 255.0)
        light = load(builder, memory, zero, S_LIGHT * LANES)
        store(builder, albedo * albedo * light, _data(context, builder, sig, args, 3), args[5])
        ray_z, owner = load(builder, data, args[2], 2 * LANES), load(builder, data, args[2], 4 * LANES)
        seen = owner.compare(">", 0.5)
        z = ray_z * load(builder, memory, zero, S_DISTANCE * LANES)
        store(builder, z.choose(seen, float("nan")), _data(context, builder, sig, args, 4), args[5])
        return context.get_dummy_value()

    return signature, generate
