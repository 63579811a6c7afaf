"""Numbers that remember how they were computed: a Python function called with them tells its equations.

A `Traced` number stands for a state, a parameter, the time or an operation on such numbers; a `TracedArray` is an
array of them. numpy's functions and Python's operators work on both. What the text of a model cannot say raises
`UntraceableError`, with what to write instead.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from functools import reduce
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from magpend_core.models.text.numeric import CALLS

MOST_SOLVED = 4
"""Most unknowns of a linear system whose solution is written out, by determinants."""

CONDITIONS = ("compare", "and", "or", "not")

MOST_PATHS = 64
"""Most ways through a function, by its decisions, that are followed."""

TOO_MANY_PATHS = (
    f"the decisions of Python (if, and, or, while, sorting) on states, time and parameters give more than {MOST_PATHS} "
    "ways through the function; write np.where(condition, a, b), and join conditions with & and |"
)
_PLAIN = (
    "a plain number is needed here, and this value changes with the state, the time or a parameter; use numpy's "
    "functions, such as np.sin, and np.zeros_like(y) for an array of rates"
)
_REAL = (
    "states, parameters and rates are real; write the real and the imaginary part on their own, z = x + i*y as two "
    "states x and y, and cos(a) and sin(a) in place of exp(1j*a)"
)
_COUNTS = (
    "a whole number is needed here, as an index or a count; give it as a constant of the program and not as a parameter"
)


class UntraceableError(Exception):
    """Error: a function does something that the text of a model cannot say. The message has the remedy."""


class Path:
    """One way through a function: the decisions that it takes on traced conditions.

    Attributes
    ----------
    planned : list of bool
        The first decisions. Later ones are true.
    decisions : list of (Traced, bool)
        Decisions so far, each with its condition.
    """

    def __init__(self, planned: Sequence[bool], sheet: Sheet) -> None:
        self.planned, self.sheet = list(planned), sheet
        self.decisions: list[tuple[Traced, bool]] = []
        self._known: dict[int, bool] = {}

    def decide(self, condition: Traced) -> bool:
        """Return what the path takes a condition for; the same for equal conditions."""
        key = self.sheet.number(condition)
        if key not in self._known:
            k = len(self.decisions)
            if k >= MOST_PATHS:
                raise UntraceableError(TOO_MANY_PATHS)
            self._known[key] = self.planned[k] if k < len(self.planned) else True
            self.decisions.append((condition, self._known[key]))
        return self._known[key]

    def next_plan(self) -> list[bool] | None:
        """Return the decisions of the next way: the last one that was true is false. None after the last way."""
        taken = [decision for _, decision in self.decisions]
        while taken and not taken[-1]:
            taken.pop()
        return [*taken[:-1], False] if taken else None


current_path: ContextVar[Path | None] = ContextVar("current_path", default=None)
"""The path that a function is on."""


class Sheet:
    """Expressions by number: equal ones have one number, and arguments have lower ones."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, float | str, tuple[int, ...]]] = []
        self._known: dict[tuple[str, float | str, tuple[int, ...]], int] = {}
        self._numbers: dict[int, tuple[int, Traced]] = {}  # a number keeps its object, or another could have its id

    def number(self, root: Traced) -> int:
        """Return the number of an expression, after numbers for all that it consists of."""
        pending = [root]
        while pending:
            node = pending[-1]
            missing = [a for a in node.args if id(a) not in self._numbers]
            if missing:
                pending += missing
                continue
            pending.pop()
            key = node.op, node.value, tuple(self._numbers[id(a)][0] for a in node.args)
            if key not in self._known:
                self._known[key] = len(self.nodes)
                self.nodes.append(key)
            self._numbers[id(node)] = self._known[key], node
        return self._numbers[id(root)][0]


class Traced(NDArrayOperatorsMixin):
    """A number that remembers how it was computed.

    Attributes
    ----------
    op : str
        ``number``, ``name``, ``sum`` (of two), ``negative``, ``product``, ``quotient``, ``power``, ``call``,
        ``remainder``, ``compare``, ``and``, ``or`` or ``not``.
    value : float or str
        Of a number; the name of a name or a function of the text; the sign of a comparison.
    """

    __slots__ = ("args", "op", "value")

    def __init__(self, op: str, args: tuple[Traced, ...] = (), value: float | str = "") -> None:
        self.op, self.args, self.value = op, args, value

    def __repr__(self) -> str:
        return str(self.value) if self.op in ("name", "number") else f"<{self.value or self.op}>"

    @property
    def is_condition(self) -> bool:
        """Whether it is true or false and not a number."""
        return self.op in CONDITIONS

    def is_number(self, value: float | None = None) -> bool:
        """Return whether it is a plain number, or this one."""
        return self.op == "number" and (value is None or self.value == value)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        return _applied(ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _called(function, args, kwargs)

    def __bool__(self) -> bool:
        if self.is_number():
            return self.value != 0.0
        if not self.is_condition:
            return bool(_equal(self, 0.0))
        path = current_path.get()
        if path is None:
            raise UntraceableError(TOO_MANY_PATHS)
        return path.decide(self)

    def __float__(self) -> float:
        raise UntraceableError(_PLAIN)

    def __index__(self) -> int:
        raise UntraceableError(_COUNTS)

    def __complex__(self) -> complex:
        raise UntraceableError(f"a complex number is made here; {_REAL}")

    __int__ = __round__ = __trunc__ = __float__


class TracedArray(np.ndarray):
    """An array of `Traced` numbers and plain ones."""

    def astype(self, *args: Any, **kwargs: Any) -> Any:
        """Return a copy: traced numbers are floats already."""
        return self.copy()

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        return _applied(ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return _called(function, args, kwargs)


def traced_array(values: Iterable[Any]) -> TracedArray:
    """Return a vector of numbers, traced or plain."""
    return np.array([*values, None], dtype=object)[:-1].view(TracedArray)


def name(text: str) -> Traced:
    """Return the number that a name of the text stands for."""
    return Traced("name", value=text)


# ---- rules: what operations give ------------------------------------------------------------------


def number(value: Any) -> Traced:
    """Return a value as a traced number; a condition counts 1 where it is true, else 0."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, Traced):
        return where(value, 1.0, 0.0) if value.is_condition else value
    if not isinstance(value, numbers.Real | np.bool):
        raise UntraceableError(f"{value!r} is no real number; {_REAL}")
    plain = float(value)
    if not math.isfinite(plain):
        raise UntraceableError(f"{plain} is no finite number")
    return Traced("number", value=plain)


def _plain(*args: Traced) -> list[float] | None:
    """Return the values of plain numbers, or None if any of them is not."""
    return [float(a.value) for a in args] if all(a.is_number() for a in args) else None


def _add(a: Any, b: Any) -> Traced:
    x, y = number(a), number(b)
    if (plain := _plain(x, y)) is not None:
        return number(sum(plain))
    if x.is_number(0.0) or y.is_number(0.0):
        return y if x.is_number(0.0) else x
    if y.op == "negative" and y.args[0] is x:
        return number(0.0)
    return Traced("sum", (x, y))


def _negative(a: Any) -> Traced:
    x = number(a)
    if x.is_number():
        return number(-float(x.value))
    if x.op == "product" and x.args[0].is_number():
        return _multiply(_negative(x.args[0]), x.args[1])
    return x.args[0] if x.op == "negative" else Traced("negative", (x,))


def _subtract(a: Any, b: Any) -> Traced:
    return _add(a, _negative(b))


def _multiply(a: Any, b: Any) -> Traced:
    x, y = number(a), number(b)
    if (plain := _plain(x, y)) is not None:
        return number(math.prod(plain))
    for one, other in ((x, y), (y, x)):
        if one.is_number(0.0) or one.is_number(1.0):
            return one if one.is_number(0.0) else other
        if one.is_number(-1.0):
            return _negative(other)
    return Traced("product", (x, y))


def _divide(a: Any, b: Any) -> Traced:
    x, y = number(a), number(b)
    if y.is_number(0.0):
        raise UntraceableError("division by 0")
    if (plain := _plain(x, y)) is not None:
        return number(plain[0] / plain[1])
    return x if x.is_number(0.0) or y.is_number(1.0) else Traced("quotient", (x, y))


def _power(a: Any, b: Any) -> Traced:
    x, y = number(a), number(b)
    if (plain := _plain(x, y)) is not None:
        return number(plain[0] ** plain[1])
    if y.is_number(0.0) or y.is_number(1.0):
        return x if y.is_number(1.0) else number(1.0)
    return Traced("power", (x, y))


def _calls(function: str) -> Callable[..., Traced]:
    """Return the rule of a function that the text of a model has, by its name there."""

    def rule(*args: Any) -> Traced:
        given = tuple(number(a) for a in args)
        plain = _plain(*given)
        return Traced("call", given, function) if plain is None else number(CALLS[function](*plain))

    return rule


def where(condition: Any, a: Any, b: Any) -> Traced:
    """Return a number that is `a` where a condition holds, else `b`."""
    if not isinstance(condition, Traced):
        return number(a if condition else b)
    if not condition.is_condition:
        raise UntraceableError("np.where needs a condition first, such as np.where(x < 0, a, b)")
    return Traced("call", (condition, number(a), number(b)), "where")


def _compares(sign: str, function: Callable[[float, float], bool]) -> Callable[[Any, Any], Traced | bool]:
    def rule(a: Any, b: Any) -> Traced | bool:
        a, b = number(a), number(b)
        plain = _plain(a, b)
        return Traced("compare", (a, b), sign) if plain is None else bool(function(*plain))

    return rule


def _joins(word: str) -> Callable[[Any, Any], Traced | bool]:
    def rule(a: Any, b: Any) -> Any:
        for one, other in ((a, b), (b, a)):
            if not isinstance(one, Traced):
                return other if bool(one) is (word == "and") else bool(one)
            if not one.is_condition:
                raise UntraceableError(f"a condition is needed on both sides of {word}, such as (x < 0) & (v > 1)")
        return Traced(word, (a, b))

    return rule


def _not(a: Any) -> Traced | bool:
    if isinstance(a, Traced) and not a.is_condition:
        raise UntraceableError("~ and np.logical_not need a condition, such as x < 0")
    return Traced("not", (a,)) if isinstance(a, Traced) else not a


def _equal(a: Any, b: Any) -> NoReturn:
    raise UntraceableError(
        "== and != ask for a single value, which a motion has at no time that counts; compare with < or >"
    )


def _heaviside(x: Any, at_zero: Any) -> Traced:
    here = number(at_zero)
    if here.is_number(0.5):
        return _add(0.5, _multiply(0.5, _sign(x)))
    return where(_less(0.0, x), 1.0, 0.0) if here.is_number(0.0) else where(_less(x, 0.0), 0.0, 1.0)


def _remainder(a: Any, b: Any) -> Traced:
    found = _calls("mod")(a, b)
    return found if found.is_number() else Traced("remainder", found.args)


_sin, _sqrt, _exp, _log = (_calls(function) for function in ("sin", "sqrt", "exp", "log"))
_sign, _abs, _min, _max = (_calls(function) for function in ("sign", "abs", "min", "max"))
_floor, _ceil = _calls("floor"), _calls("ceil")
_less, _greater = _compares("<", lambda a, b: a < b), _compares(">", lambda a, b: a > b)

_ELEMENTARY = ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")

RULES: dict[str, Callable[..., Any]] = {
    "add": _add,
    "subtract": _subtract,
    "multiply": _multiply,
    "divide": _divide,
    "negative": _negative,
    "positive": number,
    "conjugate": number,
    "power": _power,
    "float_power": _power,
    "square": lambda x: _power(x, 2.0),
    "reciprocal": lambda x: _divide(1.0, x),
    **{f: _calls(f) for f in (*_ELEMENTARY, "sign")},
    **{f"arc{f}": _calls(f"a{f}") for f in ("sin", "cos", "tan", "tan2")},
    "absolute": _abs,
    "fabs": _abs,
    **{f: _max for f in ("maximum", "fmax")},
    **{f: _min for f in ("minimum", "fmin")},
    "clip": lambda x, low, high: _min(_max(x, low), high),
    "hypot": lambda a, b: _sqrt(_add(_power(a, 2.0), _power(b, 2.0))),
    "cbrt": lambda x: _multiply(_sign(x), _power(_abs(x), 1.0 / 3.0)),
    "exp2": lambda x: _power(2.0, x),
    "expm1": lambda x: _subtract(_exp(x), 1.0),
    "log1p": lambda x: _log(_add(1.0, x)),
    "log2": lambda x: _divide(_log(x), math.log(2.0)),
    "log10": lambda x: _divide(_log(x), math.log(10.0)),
    **{f: lambda x: _multiply(x, math.pi / 180.0) for f in ("radians", "deg2rad")},
    **{f: lambda x: _multiply(x, 180.0 / math.pi) for f in ("degrees", "rad2deg")},
    "heaviside": _heaviside,
    "floor": _floor,
    "ceil": _ceil,
    "floor_divide": lambda a, b: _floor(_divide(a, b)),
    "remainder": _remainder,
    "fmod": lambda a, b: where(_less(a, 0.0), _negative(_remainder(_negative(a), _abs(b))), _remainder(a, _abs(b))),
    "less": _less,
    "greater": _greater,
    "less_equal": _compares("<=", lambda a, b: a <= b),
    "greater_equal": _compares(">=", lambda a, b: a >= b),
    **{f: _joins("and") for f in ("logical_and", "bitwise_and")},
    **{f: _joins("or") for f in ("logical_or", "bitwise_or")},
    **{f: _not for f in ("logical_not", "invert")},
    **{f: _equal for f in ("equal", "not_equal")},
}
"""Rule of each of numpy's elementwise functions that has an equivalent in the text of a model."""


def _method(function: str) -> Callable[[Traced], Any]:
    return lambda self: RULES[function](self)


# numpy calls these on the numbers of arrays that are no `TracedArray`
for _name in (*_ELEMENTARY, "arcsin", "arccos", "arctan", "conjugate", "floor", "ceil"):
    setattr(Traced, _name, _method(_name))
Traced.__floor__, Traced.__ceil__ = _method("floor"), _method("ceil")  # type: ignore[attr-defined]


# ---- numpy's functions -----------------------------------------------------------------------------


def _base(value: Any) -> np.ndarray:
    """Return a plain array of objects, on which numpy's functions do not come back here."""
    if isinstance(value, np.ndarray):
        return value.view(np.ndarray).astype(object, copy=False)
    if isinstance(value, list | tuple):
        return np.array(value, dtype=object)
    found = np.empty((), dtype=object)
    found[()] = value
    return found


def _own(value: Any) -> Any:
    """Return a result of numpy as a `TracedArray`, or as a number if it has no dimension."""
    if not isinstance(value, np.ndarray) or value.dtype != object:
        return value
    return value.view(TracedArray) if value.ndim else value[()]


def _applied(ufunc: np.ufunc, method: str, inputs: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Apply one of numpy's elementwise functions, or a method of it such as ``reduce``, to traced numbers."""
    # products of matrices, and functions that numpy calls with one number after the other
    if ufunc.__name__ in ("matmul", "matvec", "vecmat", "vecdot") or ufunc.types == ["O" * ufunc.nin + "->O"]:
        found = ufunc(*(_base(value) for value in inputs))
    elif (rule := RULES.get(ufunc.__name__)) is None:
        raise UntraceableError(_no_equivalent(f"np.{ufunc.__name__}"))
    elif method == "__call__" and not any(isinstance(value, np.ndarray | list | tuple) for value in inputs):
        found = rule(*inputs)
    else:
        identity = {"add": 0.0, "multiply": 1.0}.get(ufunc.__name__)
        known = {key: options[key] for key in ("axis", "keepdims", "initial") if key in options}
        elementwise = np.frompyfunc(rule, ufunc.nin, 1, identity=identity)
        arrays = [_base(inputs[0]), *(map(_base, inputs[1:]) if method in ("__call__", "outer") else inputs[1:])]
        found = getattr(elementwise, method)(*arrays, **known)
    target = (options.get("out") or (None,))[0]
    if target is None or isinstance(target, Traced):  # x += 1 makes a new number
        return _own(found)
    if target.dtype != object:
        raise UntraceableError(_PLAIN)
    target.view(np.ndarray)[...] = found
    return target


def _no_equivalent(what: str) -> str:
    known = "sqrt, exp, log, sin, cos, tan, arcsin, arccos, arctan, arctan2, sinh, cosh, tanh, abs, sign, heaviside"
    return (
        f"{what} has no equivalent in the text of a model; use {known}, floor, ceil, maximum, minimum, clip, where, "
        "interp"
    )


def _called(function: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
    """Call one of numpy's functions of arrays, such as ``np.where`` or ``np.roll``, with traced numbers."""
    if function in _FUNCTIONS:
        return _FUNCTIONS[function](*args, **kwargs)
    args, kwargs = _arrays(args), _arrays(dict(kwargs))
    first: Any = TracedArray(0)
    return _own(np.ndarray.__array_function__(first, function, (TracedArray,), args, kwargs))


def _arrays(value: Any) -> Any:
    """Return arguments with an array for each traced number."""
    if isinstance(value, Traced):
        return _base(value).view(TracedArray)
    if isinstance(value, list | tuple):
        return type(value)(_arrays(v) for v in value)
    return {key: _arrays(v) for key, v in value.items()} if isinstance(value, dict) else value


def _np_where(condition: Any, *branches: Any) -> Any:
    if len(branches) != 2:
        raise UntraceableError("np.where needs a condition and two values: np.where(x < 0, a, b)")
    return _own(np.frompyfunc(where, 3, 1)(*(_base(value) for value in (condition, *branches))))


def _np_select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0.0) -> Any:
    pairs = list(zip(conditions, choices, strict=True))
    return reduce(lambda rest, pair: _np_where(pair[0], pair[1], rest), reversed(pairs), default)


def _np_interp(x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None) -> Any:
    """Interpolate a table of numbers, by a line between each two of them."""
    places, values = np.asarray(xp), np.asarray(fp)
    found = values[-1] if right is None else right
    for k in range(len(places) - 2, -1, -1):
        slope = (values[k + 1] - values[k]) / (places[k + 1] - places[k])
        found = _np_where(np.less(x, places[k + 1]), values[k] + slope * (x - places[k]), found)
    return _np_where(np.less(x, places[0]), values[0] if left is None else left, found)


def _likes(value: float) -> Callable[..., Any]:
    """Return a function that makes an array of the shape of another, filled with a number."""

    def like(given: Any, *args: Any, shape: Any = None, **kwargs: Any) -> Any:
        return _own(_full(np.shape(given) if shape is None else shape, value))

    return like


def _full(shape: Any, value: Any, *args: Any, **kwargs: Any) -> Any:
    found = np.empty(shape, dtype=object)
    found[...] = value
    return found.view(TracedArray)


def _determinant(matrix: np.ndarray) -> Traced:
    """Return a determinant by expansion along rows; equal minors are computed once."""
    known: dict[tuple[int, ...], Traced] = {(): number(1.0)}

    def minor(columns: tuple[int, ...]) -> Traced:
        if columns not in known:
            row, total = matrix[len(matrix) - len(columns)], number(0.0)
            for k, column in enumerate(columns):
                term = _multiply(row[column], minor(columns[:k] + columns[k + 1 :]))
                total = _subtract(total, term) if k % 2 else _add(total, term)
            known[columns] = total
        return known[columns]

    return minor(tuple(range(len(matrix))))


def _solved(a: Any, b: Any) -> Any:
    """Return the solution of a linear system, by Cramer's rule if its matrix changes."""
    matrix, right = _base(a), _base(b)
    if not any(isinstance(value, Traced) for value in matrix.flat):
        return _own(np.linalg.inv(matrix.astype(float)).astype(object) @ right)
    n = len(matrix)
    if matrix.shape != (n, n) or n > MOST_SOLVED:
        raise UntraceableError(
            f"np.linalg.solve and inv with a matrix {' x '.join(map(str, matrix.shape))} that changes: at most "
            f"{MOST_SOLVED} x {MOST_SOLVED} is written out; eliminate unknowns by hand, or keep the matrix constant"
        )
    if right.ndim == 2:
        return _own(np.stack([_base(_solved(matrix, column)) for column in right.T], axis=1))
    whole, found = _determinant(matrix), []
    for k in range(n):
        changed = matrix.copy()
        changed[:, k] = right
        found.append(_divide(_determinant(changed), whole))
    return traced_array(found)


_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.where: _np_where,
    np.select: _np_select,
    np.interp: _np_interp,
    np.zeros_like: _likes(0.0),
    np.empty_like: _likes(0.0),
    np.ones_like: _likes(1.0),
    np.linalg.solve: _solved,
    np.linalg.inv: lambda a: _solved(a, np.eye(len(a))),
    np.linalg.det: lambda a: _determinant(_base(a)),
}

# ---- what a function is called with in place of numpy, math and built-in functions ---------------


def _makes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of numpy that makes an array of given values, such that the values may be traced."""

    def make(values: Any, *args: Any, **kwargs: Any) -> Any:
        found = np.array(values)
        return found.view(TracedArray) if found.dtype == object else function(values, *args, **kwargs)

    return make


def _fills(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of numpy that makes an array of floats, such that it can take traced numbers later."""

    def fill(*args: Any, **kwargs: Any) -> Any:
        found = function(*args, **kwargs)
        return found.astype(object).view(TracedArray) if found.dtype.kind == "f" else found

    return fill


def _extreme(function: Callable[..., Any], over: np.ufunc) -> Callable[..., Any]:
    def extreme(*args: Any, **kwargs: Any) -> Any:
        values = list(args if len(args) > 1 else args[0])
        is_traced = any(isinstance(v, Traced | TracedArray) for v in values)
        return reduce(over, values) if is_traced else function(*args, **kwargs)

    return extreme


def _math_log(x: Any, *base: Any) -> Any:
    return np.log(x) / np.log(base[0]) if base else np.log(x)


_OTHERS = ("hypot", "fabs", "expm1", "log1p", "log2", "log10", "degrees", "radians", "fmod", "exp2", "cbrt")
_MATH = {
    **{f: getattr(np, f) for f in (*_ELEMENTARY, *_OTHERS)},
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "pow": np.power,
    "log": _math_log,
}
_NUMPY = {
    **{f: _makes(getattr(np, f)) for f in ("array", "asarray", "asanyarray", "ascontiguousarray")},
    **{f: _fills(getattr(np, f)) for f in ("zeros", "ones", "empty", "eye", "identity")},
    "full": _full,
}
BUILT_IN: dict[str, Callable[..., Any]] = {"max": _extreme(max, np.maximum), "min": _extreme(min, np.minimum)}
"""Built-in functions by name that also take traced numbers."""

SUBSTITUTES: dict[int, Any] = {
    id(np): SimpleNamespace(**{**vars(np), **_NUMPY}),
    id(math): SimpleNamespace(**{**vars(math), **{f: g for f, g in _MATH.items() if hasattr(math, f)}}),
    **{id(getattr(np, f)): made for f, made in _NUMPY.items()},
    **{id(getattr(math, f)): made for f, made in _MATH.items() if hasattr(math, f)},
}
"""For numpy, math and functions of these, by their identity: the same that also take and make traced numbers."""
