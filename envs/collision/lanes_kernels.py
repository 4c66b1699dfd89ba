"""Sixteen float32 numbers at once, in compiled functions: a type of Numba's for vector registers.

`Lanes` are added, subtracted and multiplied with each other and with float32 numbers. Comparisons
give masks: an int whose bit i is the answer for lane i. Every operation rounds as IEEE 754 says, so
the numbers are the same on every machine.

(Numba's plain loops over arrays of 16 take nine times as long: LLVM does not vectorise them, as it
can't see that the arrays don't overlap.)
"""

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

WIDTH = 16


class _LanesType(types.Type):
    def __init__(self):
        super().__init__(name="Lanes16")


_lanes = _LanesType()
_FLOAT, _INDEX = ir.FloatType(), ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, WIDTH)


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _VECTOR)


def _intrinsic(result, generate, *kinds) -> Any:
    """A function of compiled code, whose arguments have `kinds` (None: any type).

    `generate(context, builder, types, values)` builds it.
    """

    def typed(*given):
        fits = all(kind is None or kind == of for kind, of in zip(kinds, given, strict=True))
        return (result(*given), _generate) if fits else None

    def _generate(context, builder, signature, values):
        return generate(context, builder, signature.args, values)

    # Numba wants as many named arguments as there are.
    if len(kinds) == 1:
        return intrinsic(lambda typing, a: typed(a))
    if len(kinds) == 2:
        return intrinsic(lambda typing, a, b: typed(a, b))
    return intrinsic(lambda typing, a, b, c: typed(a, b, c))


def _call(name):
    """LLVM's intrinsic function for vectors."""

    def generate(context, builder, kinds, values):
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(values))
        function = builder.module.declare_intrinsic(f"{name}.v{WIDTH}f32", (), kind)
        return builder.call(function, values)

    return generate


def _spread(builder, number):
    """A vector of one number."""
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    vector = builder.insert_element(undefined, number, ir.Constant(_INDEX, 0))
    zeros = ir.Constant(ir.VectorType(_INDEX, WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(vector, undefined, zeros)


def _pointer(context, builder, kinds, values):
    """The address of an array's element, as that of a vector."""
    array = context.make_array(kinds[0])(context, builder, values[0])
    return builder.bitcast(builder.gep(array.data, [values[1]]), _VECTOR.as_pointer())


def _load(context, builder, kinds, values):
    vector = builder.load(_pointer(context, builder, kinds, values))
    vector.align = 4
    return vector


def _gathered(context, builder, kinds, values):
    data = context.make_array(kinds[0])(context, builder, values[0]).data
    places = builder.fptosi(values[1], ir.VectorType(_INDEX, WIDTH))
    vector = ir.Constant(_VECTOR, ir.Undefined)
    for i in range(WIDTH):
        lane = ir.Constant(_INDEX, i)
        number = builder.load(builder.gep(data, [builder.extract_element(places, lane)]))
        vector = builder.insert_element(vector, number, lane)
    return vector


def _store(context, builder, kinds, values):
    written = builder.store(values[2], _pointer(context, builder, kinds, values))
    written.align = 4
    return context.get_dummy_value()


def _select(comparison):
    def generate(context, builder, kinds, values):
        return builder.select(builder.fcmp_ordered(comparison, *values), *values)

    return generate


def _less(context, builder, kinds, values):
    mask = builder.bitcast(builder.fcmp_ordered("<", *values), ir.IntType(WIDTH))
    return builder.zext(mask, ir.IntType(64))


def _lane(context, builder, kinds, values):
    return builder.extract_element(values[0], builder.trunc(values[1], _INDEX))


def _largest(context, builder, kinds, values):
    (vector,) = values
    width = WIDTH
    while width > 1:
        width //= 2
        halves = []
        for first in (0, width):
            places = ir.Constant(ir.VectorType(_INDEX, width), list(range(first, first + width)))
            undefined = ir.Constant(vector.type, ir.Undefined)
            halves.append(builder.shuffle_vector(vector, undefined, places))
        vector = builder.select(builder.fcmp_ordered(">", *halves), *halves)
    return builder.extract_element(vector, ir.Constant(_INDEX, 0))


def _lowest(context, builder, kinds, values):
    kind = ir.FunctionType(ir.IntType(64), [ir.IntType(64), ir.IntType(1)])
    function = builder.module.declare_intrinsic("llvm.cttz.i64", (), kind)
    return builder.call(function, [values[0], ir.Constant(ir.IntType(1), 1)])


def _as_lanes(*kinds):
    return _lanes(*kinds)


_two, _three = (_lanes, _lanes), (_lanes, _lanes, _lanes)
load = _intrinsic(_as_lanes, _load, None, types.intp)
"""`load(array, i)`: the elements i to i + 15 of a contiguous float32 array (n,)."""
store = _intrinsic(lambda *kinds: types.void(*kinds), _store, None, types.intp, _lanes)
"""`store(array, i, lanes)`: write them there."""
gathered = _intrinsic(_as_lanes, _gathered, None, _lanes)
"""`gathered(array, places)`: the elements at places, which are whole numbers."""
spread = _intrinsic(_as_lanes, lambda c, builder, k, v: _spread(builder, v[0]), types.float32)
"""`spread(x)`: a float32 number in all lanes."""
fused = _intrinsic(_as_lanes, _call("llvm.fma"), *_three)
"""`fused(a, b, c)`: a b + c, rounded once."""
root = _intrinsic(_as_lanes, _call("llvm.sqrt"), _lanes)
magnitude = _intrinsic(_as_lanes, _call("llvm.fabs"), _lanes)
floor = _intrinsic(_as_lanes, _call("llvm.floor"), _lanes)
nearest_int = _intrinsic(_as_lanes, _call("llvm.rint"), _lanes)
larger = _intrinsic(_as_lanes, _select(">"), *_two)
smaller = _intrinsic(_as_lanes, _select("<"), *_two)
less = _intrinsic(lambda *kinds: types.int64(*kinds), _less, *_two)
"""`less(a, b)`: the mask of the lanes in which a < b."""
lane = _intrinsic(lambda *kinds: types.float32(*kinds), _lane, _lanes, types.int64)
"""`lane(a, i)`: the number in a lane."""
largest = _intrinsic(lambda *kinds: types.float32(*kinds), _largest, _lanes)
lowest = _intrinsic(lambda *kinds: types.int64(*kinds), _lowest, types.int64)
"""`lowest(mask)`: the lowest bit that is set in a mask that is not 0."""


def _overload(symbol, name):
    apply = _intrinsic(_as_lanes, lambda c, builder, k, v: getattr(builder, name)(*v), *_two)

    @overload(symbol)
    def _(a, b):
        if a == _lanes and b == _lanes:
            return lambda a, b: apply(a, b)
        if a == _lanes and b == types.float32:
            return lambda a, b: apply(a, spread(b))
        if a == types.float32 and b == _lanes:
            return lambda a, b: apply(spread(a), b)
        return None


for _symbol, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _overload(_symbol, _name)
