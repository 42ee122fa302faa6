"""Work on the lanes of a ray packet at its address: vector instructions, which numba leaves as scalar code.

numba's optimiser unrolls a loop over 8 or 16 lanes before it could become one vector operation. A packet's lanes need
the same few operations a million times a second, so these are written as LLVM vectors. Rounding is that of the scalar
code: products and sums are not fused. Arrays as arguments would be reference-counted with each call, addresses are not.

`lanes` is a tuple as long as the packet is wide, because a type fixes its length; the other arguments are addresses of
float32 or int32 values that stay alive and are large enough, which nobody checks.
"""

from typing import Any

import numba as nb
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_FLOAT, _INT, _LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)


def _vector_at(builder: ir.IRBuilder, address: Any, element: ir.Type, width: int) -> Any:
    return builder.inttoptr(address, ir.VectorType(element, width).as_pointer())


def _splat(builder: ir.IRBuilder, value: Any, width: int) -> Any:
    kind = ir.VectorType(value.type, width)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), ir.Constant(ir.VectorType(_INT, width), None))


def _offset(builder: ir.IRBuilder, address: Any, count: int) -> Any:
    return builder.add(address, ir.Constant(address.type, 4 * count))


def _fill(element: ir.Type, kind: Any) -> Any:
    """Intrinsic ``fill(lanes, target, value)``: every lane of one row of the packet is set to `value`."""

    def fill(typing_context: Any, lanes: Any, target: Any, value: Any) -> Any:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            row = _vector_at(builder, arguments[1], element, lanes.count)
            builder.store(_splat(builder, arguments[2], lanes.count), row, align=4)
            return context.get_dummy_value()

        return types.void(lanes, types.intp, kind), generate

    return fill


def _product(columns: int, *, offset: bool = False, unit: bool = False) -> Any:
    """Intrinsic ``product(lanes, matrix, source, target)``: three rows of the packet times a row-major matrix.

    Args:
        columns: numbers in a row of the matrix.
        offset: whether the fourth column is added.
        unit: whether the products are scaled to length one.
    """

    def product(typing_context: Any, lanes: Any, matrix: Any, source: Any, target: Any) -> Any:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            width = lanes.count
            vector = ir.VectorType(_FLOAT, width)
            entry = builder.inttoptr(arguments[1], _FLOAT.as_pointer())
            rows = [
                builder.load(_vector_at(builder, _offset(builder, arguments[2], axis * width), _FLOAT, width), align=4)
                for axis in range(3)
            ]
            out = []
            for axis in range(3):
                total = None
                for column in range(3):
                    at = builder.gep(entry, [ir.Constant(_INT, axis * columns + column)])
                    term = builder.fmul(_splat(builder, builder.load(at, align=4), width), rows[column])
                    total = term if total is None else builder.fadd(total, term)
                if offset:
                    at = builder.gep(entry, [ir.Constant(_INT, axis * columns + 3)])
                    total = builder.fadd(total, _splat(builder, builder.load(at, align=4), width))
                out.append(total)
            if unit:
                square = builder.fadd(
                    builder.fadd(builder.fmul(out[0], out[0]), builder.fmul(out[1], out[1])),
                    builder.fmul(out[2], out[2]),
                )
                name = f"llvm.sqrt.v{width}f32"
                root = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector]), name)
                one = _splat(builder, ir.Constant(_FLOAT, 1.0), width)
                scale = builder.fdiv(one, builder.call(root, [square]))
                out = [builder.fmul(value, scale) for value in out]
            for axis in range(3):
                row = _vector_at(builder, _offset(builder, arguments[3], axis * width), _FLOAT, width)
                builder.store(out[axis], row, align=4)
            return context.get_dummy_value()

        return types.void(lanes, types.intp, types.intp, types.intp), generate

    return product


def _any_within(typing_context: Any, lanes: Any, directions: Any, axis: Any, cosine: Any) -> Any:
    """Intrinsic ``any_within(lanes, directions, axis, cosine)``: whether a lane's direction lies in a cone.

    Args:
        typing_context: of numba.
        lanes: see the module.
        directions: address of rows x, y, z of any length.
        axis: address of the unit axis, three floats.
        cosine: of the half opening angle, which is below 90 degrees.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        width = lanes.count
        entry = builder.inttoptr(arguments[2], _FLOAT.as_pointer())
        along, square = None, None
        for k in range(3):
            row = _vector_at(builder, _offset(builder, arguments[1], k * width), _FLOAT, width)
            value = builder.load(row, align=4)
            part = builder.load(builder.gep(entry, [ir.Constant(_INT, k)]), align=4)
            term = builder.fmul(_splat(builder, part, width), value)
            along = term if along is None else builder.fadd(along, term)
            term = builder.fmul(value, value)
            square = term if square is None else builder.fadd(square, term)
        limit = builder.fmul(_splat(builder, builder.fmul(arguments[3], arguments[3]), width), square)
        ahead = builder.fcmp_ordered(">", along, ir.Constant(ir.VectorType(_FLOAT, width), [0.0] * width))
        inside = builder.and_(ahead, builder.fcmp_ordered(">=", builder.fmul(along, along), limit))
        bits = builder.bitcast(inside, ir.IntType(width))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(width), 0))

    return types.boolean(lanes, types.intp, types.intp, types.float32), generate


def _scatter(typing_context: Any, lanes: Any, source: Any, order: Any, target: Any, stride: Any) -> Any:
    """Intrinsic ``scatter(lanes, source, order, target, stride)``: copy a row of the packet to elements of an array.

    Lane k goes to word ``stride * order[k]`` after `target`; `stride` is a literal number of words.
    """
    if not isinstance(stride, types.IntegerLiteral):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        row, index, out = (builder.inttoptr(argument, _INT.as_pointer()) for argument in arguments[1:4])
        for lane in range(lanes.count):
            value = builder.load(builder.gep(row, [ir.Constant(_INT, lane)]), align=4)
            element = builder.zext(builder.load(builder.gep(index, [ir.Constant(_INT, lane)]), align=4), _LONG)
            at = builder.gep(out, [builder.mul(element, ir.Constant(_LONG, stride.literal_value))])
            builder.store(value, at, align=4)
        return context.get_dummy_value()

    return types.void(lanes, types.intp, types.intp, types.intp, stride), generate


def _prefetch(typing_context: Any, address: Any) -> Any:
    """Intrinsic ``prefetch(address)``: begin to fetch a cache line that will be written to."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, _INT, _INT, _INT])
        instruction = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        to_write, near, data = (ir.Constant(_INT, value) for value in (1, 3, 1))
        builder.call(instruction, [builder.inttoptr(arguments[0], byte), to_write, near, data])
        return context.get_dummy_value()

    return types.void(types.intp), generate


def _pointer_at(typing_context: Any, address: Any) -> Any:
    """Address as a pointer that `numba.carray` takes."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(types.intp), generate


pointer: Any = intrinsic(_pointer_at)
"""``pointer(address)`` is what `carray` takes."""
carray: Any = nb.carray  # pyright: ignore[reportPrivateImportUsage]
"""``carray(pointer(address), count, dtype)``: array of what stands at an address, without ownership."""
scatter: Any = intrinsic(prefer_literal=True)(_scatter)
"""``scatter(lanes, source, order, target, stride)``: lane k of a row goes to word ``stride * order[k]`` of `target`."""
any_within: Any = intrinsic(_any_within)
"""``any_within(lanes, directions, axis, cosine)``: whether one of W directions lies in a cone of less than 90 deg."""
prefetch: Any = intrinsic(_prefetch)
"""``prefetch(address)`` begins to fetch a cache line that will be written to."""
fill_float: Any = intrinsic(_fill(_FLOAT, types.float32))
"""``fill_float(lanes, target, value)`` sets a row of W floats to one value."""
fill_int: Any = intrinsic(_fill(_INT, types.int32))
"""``fill_int(lanes, target, value)`` sets a row of W integers to one value."""
move: Any = intrinsic(_product(4, offset=True))
"""``move(lanes, matrix, source, target)``: rows x, y, z of W points times a (3, 4) matrix."""
rotate: Any = intrinsic(_product(4))
"""``rotate(lanes, matrix, source, target)``: rows x, y, z of W vectors times the left part of a (3, 4) matrix."""
unit_normals: Any = intrinsic(_product(3, unit=True))
"""``unit_normals(lanes, matrix, source, target)``: rows x, y, z of W normals times a (3, 3) matrix, as unit vectors."""
