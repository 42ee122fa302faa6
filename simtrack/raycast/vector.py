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


def _uniformity(typing_context: Any, lanes: Any, first: Any, second: Any) -> Any:
    """Intrinsic ``uniformity(lanes, first, second)``: what the lanes of two rows of integers have in common.

    3: `first` is equal in all of them and `second` nowhere negative; 1: `second` is negative in all; 0: neither.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        width = lanes.count
        bits, none = ir.IntType(width), ir.Constant(ir.IntType(width), 0)
        a, b = (builder.load(_vector_at(builder, at, _INT, width), align=4) for at in arguments[1:])
        start = _splat(builder, builder.extract_element(a, ir.Constant(_INT, 0)), width)
        unequal = builder.bitcast(builder.icmp_signed("!=", a, start), bits)
        zeros = ir.Constant(ir.VectorType(_INT, width), None)
        negative = builder.bitcast(builder.icmp_signed("<", b, zeros), bits)
        alike = builder.icmp_unsigned("==", builder.or_(unequal, negative), none)
        absent = builder.icmp_unsigned("==", builder.not_(negative), none)
        three, one, zero = (ir.Constant(_LONG, value) for value in (3, 1, 0))
        return builder.select(alike, three, builder.select(absent, one, zero))

    return types.int64(lanes, types.intp, types.intp), generate


def _scatter(rows: int) -> Any:
    """Intrinsic ``scatter(lanes, source, order, target)``: `rows` rows of the packet to the rays' places in an array.

    Lane k goes to words ``rows * order[k]`` and following. Four lanes whose rays are neighbours are written at once.
    """

    def scatter(typing_context: Any, lanes: Any, source: Any, order: Any, target: Any) -> Any:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            index, out = (builder.inttoptr(argument, _INT.as_pointer()) for argument in arguments[2:])
            four = ir.VectorType(_INT, 4)
            for lane in range(0, lanes.count, 4):
                rays = builder.load(builder.bitcast(_word(builder, index, lane), four.as_pointer()), align=4)
                first = builder.extract_element(rays, ir.Constant(_INT, 0))
                row = builder.add(_splat(builder, first, 4), ir.Constant(four, [0, 1, 2, 3]))
                apart = builder.bitcast(builder.icmp_signed("!=", rays, row), ir.IntType(4))
                at = [_offset(builder, arguments[1], lane + k * lanes.count) for k in range(rows)]
                values = [builder.load(_vector_at(builder, address, _INT, 4), align=4) for address in at]
                with builder.if_else(builder.icmp_unsigned("==", apart, ir.Constant(ir.IntType(4), 0))) as (near, far):
                    with near:
                        place = builder.gep(out, [_times(builder, first, rows)])
                        mixed = _interleaved(builder, values)
                        builder.store(mixed, builder.bitcast(place, mixed.type.as_pointer()), align=4)
                    with far:
                        for k in range(4):
                            ray = builder.extract_element(rays, ir.Constant(_INT, k))
                            place = builder.gep(out, [_times(builder, ray, rows)])
                            for number, value in enumerate(values):
                                word = builder.extract_element(value, ir.Constant(_INT, k))
                                builder.store(word, _word(builder, place, number), align=4)
            return context.get_dummy_value()

        return types.void(lanes, types.intp, types.intp, types.intp), generate

    return scatter


def _gather(rows: int) -> Any:
    """Intrinsic ``gather(lanes, source, order, target)``: the rays' places in an array to `rows` rows of the packet.

    The reverse of `_scatter`: four lanes whose rays are neighbours are read at once.
    """

    def gather(typing_context: Any, lanes: Any, source: Any, order: Any, target: Any) -> Any:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            array, index = (builder.inttoptr(argument, _INT.as_pointer()) for argument in arguments[1:3])
            four, many = ir.VectorType(_INT, 4), ir.VectorType(_INT, 4 * rows)
            for lane in range(0, lanes.count, 4):
                rays = builder.load(builder.bitcast(_word(builder, index, lane), four.as_pointer()), align=4)
                first = builder.extract_element(rays, ir.Constant(_INT, 0))
                row = builder.add(_splat(builder, first, 4), ir.Constant(four, [0, 1, 2, 3]))
                apart = builder.bitcast(builder.icmp_signed("!=", rays, row), ir.IntType(4))
                to = [_offset(builder, arguments[3], lane + k * lanes.count) for k in range(rows)]
                with builder.if_else(builder.icmp_unsigned("==", apart, ir.Constant(ir.IntType(4), 0))) as (near, far):
                    with near:
                        place = builder.bitcast(builder.gep(array, [_times(builder, first, rows)]), many.as_pointer())
                        mixed, none = builder.load(place, align=4), ir.Constant(many, ir.Undefined)
                        for k, address in enumerate(to):
                            lanes_of = ir.Constant(four, [rows * j + k for j in range(4)])
                            value = builder.shuffle_vector(mixed, none, lanes_of)
                            builder.store(value, _vector_at(builder, address, _INT, 4), align=4)
                    with far:
                        for j in range(4):
                            ray = builder.extract_element(rays, ir.Constant(_INT, j))
                            place = builder.gep(array, [_times(builder, ray, rows)])
                            for k, address in enumerate(to):
                                into = builder.inttoptr(_offset(builder, address, j), _INT.as_pointer())
                                builder.store(builder.load(_word(builder, place, k), align=4), into, align=4)
            return context.get_dummy_value()

        return types.void(lanes, types.intp, types.intp, types.intp), generate

    return gather


def _allow(typing_context: Any, lanes: Any, packet: Any, valid: Any) -> Any:
    """Intrinsic ``allow(lanes, packet, valid)``: -1 in lanes whose ray is finite and has a direction, 0 in others."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        width = lanes.count
        zeros = ir.Constant(ir.VectorType(_FLOAT, width), [0.0] * width)
        poison, moves = zeros, ir.Constant(ir.VectorType(ir.IntType(1), width), None)
        for row in (0, 1, 2, 4, 5, 6, 7):  # origin, direction, time
            at = _vector_at(builder, _offset(builder, arguments[1], row * width), _FLOAT, width)
            value = builder.load(at, align=4)
            poison = builder.fadd(poison, builder.fmul(zeros, value))
            if 4 <= row <= 6:
                moves = builder.or_(moves, builder.fcmp_unordered("!=", value, zeros))
        fine = builder.and_(moves, builder.fcmp_ordered("==", poison, zeros))
        out = builder.sext(fine, ir.VectorType(_INT, width))
        builder.store(out, _vector_at(builder, arguments[2], _INT, width), align=4)
        return context.get_dummy_value()

    return types.void(lanes, types.intp, types.intp), generate


def _word(builder: ir.IRBuilder, pointer_: Any, number: int) -> Any:
    return builder.gep(pointer_, [ir.Constant(_INT, number)])


def _times(builder: ir.IRBuilder, ray: Any, rows: int) -> Any:
    return builder.mul(builder.zext(ray, _LONG), ir.Constant(_LONG, rows))


def _interleaved(builder: ir.IRBuilder, values: list[Any]) -> Any:
    """Vectors x, y, z of four as one x0 y0 z0 x1 ... of twelve; a single one as it is."""
    if len(values) == 1:
        return values[0]
    x, y, z = values
    pairs = builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(_INT, 8), list(range(8))))
    padded = builder.shuffle_vector(z, z, ir.Constant(ir.VectorType(_INT, 8), [0, 1, 2, 3, 0, 1, 2, 3]))
    places = [k + 4 * axis for k in range(4) for axis in range(3)]
    return builder.shuffle_vector(pairs, padded, ir.Constant(ir.VectorType(_INT, 12), places))


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
scatter: Any = intrinsic(_scatter(1))
"""``scatter(lanes, source, order, target)``: lane k of a row goes to word ``order[k]`` after `target`."""
scatter_vectors: Any = intrinsic(_scatter(3))
"""``scatter_vectors(lanes, source, order, target)``: rows x, y, z; lane k goes to ``3 * order[k]`` and the next two."""
gather: Any = intrinsic(_gather(1))
"""``gather(lanes, source, order, target)``: word ``order[k]`` after `source` to lane k of a row."""
gather_vectors: Any = intrinsic(_gather(3))
"""``gather_vectors(lanes, source, order, target)``: words ``3 * order[k]`` and following to lane k of rows x, y, z."""
allow: Any = intrinsic(_allow)
"""``allow(lanes, packet, valid)``: -1 in lanes whose ray is finite and has a direction, 0 in the others."""
uniformity: Any = intrinsic(_uniformity)
"""``uniformity(lanes, first, second)``: 3 if `first` is the same in all lanes and `second` nowhere negative, 1 if that
is negative in all lanes, else 0."""
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
