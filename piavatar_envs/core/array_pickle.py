"""Pickles of arrays, read without running them: an interpreter of the opcodes that arrays need, and of no others.

A pickle is a program that may call any function. Here nothing is imported and nothing is called: a name of
:data:`ADMITTED` becomes a :class:`Stub` that stores what it was given, every other name is refused, and :func:`plain`
turns the stubs of NumPy arrays, SciPy's sparse matrices and chumpy's arrays into arrays. Sizes are checked against the
bytes that the file has. The opcodes are those of Python's ``pickletools``.
"""

from __future__ import annotations

import codecs
import io
import pickletools
import re
from typing import Any

import numpy as np
from scipy import sparse

#: Most opcodes that are read; a real body model has several hundred.
MAX_OPCODES = 100_000
#: Deepest nesting of arrays in arrays that is followed.
MAX_DEPTH = 16
_NUMPY = r"numpy\.(_?core\.(multiarray\.(_reconstruct|scalar)|numeric\._frombuffer)|ndarray|dtype)"
_SPARSE = r"scipy\.sparse\.(_?(csc|csr|coo)\.)?(csc|csr|coo)_(matrix|array)"
_CHUMPY = r"chumpy(\.\w+)+"
_PYTHON = r"copy_?reg\._reconstructor|(builtins|__builtin__)\.(object|set)|collections\.OrderedDict|_codecs\.encode"
#: Names that a pickle may mention.
ADMITTED = re.compile(f"{_NUMPY}|{_SPARSE}|{_CHUMPY}|{_PYTHON}")
_VALUES = {
    "INT", "LONG", "LONG1", "LONG4", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT", "BINSTRING", "UNICODE",
    "SHORT_BINSTRING", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
    "BYTEARRAY8",
}  # fmt: skip
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_MARK = object()


class Stub:
    """Stand-in for an object that a pickle would create: its class name, arguments and state."""

    __slots__ = ("arguments", "name", "state")

    def __init__(self, name: str, arguments: Any = None):
        self.name, self.arguments, self.state = name, arguments, None


def read_pickle(data: bytes) -> Any:
    """Return what a pickle stores, with :class:`Stub` for every object of a class.

    Args:
        data: the pickle, of any protocol.

    Raises:
        ValueError: it mentions another name than the admitted ones, has another opcode, or is damaged.
    """
    stream, stack, memo = io.BytesIO(data), [], {}
    for _ in range(MAX_OPCODES):
        code = stream.read(1)
        operation = pickletools.code2op.get(code.decode("latin-1"))
        if operation is None:
            raise ValueError("the pickle ends early" if not code else f"{code!r} is not an opcode of a pickle")
        if operation.name == "STOP":
            return _pop(stack)
        _execute(operation.name, _argument(operation, stream), stack, memo)
    raise ValueError(f"the pickle has more than {MAX_OPCODES} opcodes")


def _argument(operation: pickletools.OpcodeInfo, stream: io.BytesIO) -> Any:
    if operation.name == "STRING":  # of Python 2: bytes, which pickletools takes for ASCII
        return codecs.escape_decode(stream.readline().strip()[1:-1])[0].decode("latin-1")
    return None if operation.arg is None else operation.arg.reader(stream)


def _execute(name: str, argument: Any, stack: list, memo: dict) -> None:
    """Apply one opcode to the stack."""
    if name in _VALUES or name == "STRING":
        stack.append(argument)
    elif name in _CONSTANTS:
        stack.append(_CONSTANTS[name])
    elif name in ("PROTO", "FRAME"):
        pass
    elif name == "MARK":
        stack.append(_MARK)
    elif name == "POP":
        stack.pop()
    elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
        memo[len(memo) if argument is None else argument] = stack[-1]
    elif name in ("GET", "BINGET", "LONG_BINGET"):
        stack.append(memo[argument])
    elif name in ("EMPTY_LIST", "EMPTY_DICT", "EMPTY_TUPLE"):
        stack.append({"EMPTY_LIST": [], "EMPTY_DICT": {}, "EMPTY_TUPLE": ()}[name])
    elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
        stack.append(tuple(reversed([_pop(stack) for _ in range(int(name[-1]))])))
    elif name in ("TUPLE", "LIST", "DICT"):
        items = _to_mark(stack)
        stack.append({"TUPLE": tuple, "LIST": list, "DICT": _pairs}[name](items))
    elif name == "EMPTY_SET":
        stack.append(Stub("builtins.set"))
    elif name == "ADDITEMS":  # of sets, which no array is made of
        _to_mark(stack)
    elif name in ("APPEND", "APPENDS"):
        items = [_pop(stack)] if name == "APPEND" else _to_mark(stack)
        _top(stack, list).extend(items)
    elif name in ("SETITEM", "SETITEMS"):
        items = [_pop(stack), _pop(stack)][::-1] if name == "SETITEM" else _to_mark(stack)
        _top(stack, dict).update(_pairs(items))
    elif name in ("GLOBAL", "STACK_GLOBAL"):
        attribute, module = (_pop(stack), _pop(stack)) if argument is None else argument.split(" ", 1)[::-1]
        stack.append(_named(f"{module}.{attribute}"))
    elif name in ("REDUCE", "NEWOBJ"):
        arguments, called = _pop(stack), _pop(stack)
        stack.append(_made(called, arguments))
    elif name == "BUILD":
        state = _pop(stack)
        _top(stack, Stub).state = state
    else:
        raise ValueError(f"the pickle has the opcode {name}, which no array needs")


def _named(name: str) -> type[Stub] | Stub:
    if not ADMITTED.fullmatch(name):
        raise ValueError(f"the pickle asks for {name[:80]!r}, which is not an array; nothing of it was run")
    return Stub(name)


def _made(called: Any, arguments: Any) -> Any:
    """Return the stub of a call in the pickle; bytes of text are returned at once."""
    if not isinstance(called, Stub) or called.arguments is not None or not isinstance(arguments, tuple):
        raise ValueError("the pickle calls something that has no name")
    if called.name == "_codecs.encode":
        return arguments[0].encode("latin-1")
    if called.name.endswith("._reconstructor"):
        called = arguments[0]
        arguments = ()
    return Stub(called.name, arguments)


def _pop(stack: list) -> Any:
    value = stack.pop()
    if value is _MARK:
        raise ValueError("the pickle takes a value where there is none")
    return value


def _top(stack: list, kind: type) -> Any:
    if not isinstance(stack[-1], kind):
        raise ValueError(f"the pickle fills a {type(stack[-1]).__name__} as if it were a {kind.__name__}")
    return stack[-1]


def _to_mark(stack: list) -> list:
    items: list = []
    while (value := stack.pop()) is not _MARK:
        items.append(value)
    return items[::-1]


def _pairs(items: list) -> dict:
    keys = items[::2]
    if not all(isinstance(key, str | bytes | int) for key in keys):  # hashing nested tuples can take forever
        raise ValueError("the pickle has a dictionary whose keys are neither texts nor numbers")
    return dict(zip(keys, items[1::2], strict=True))


def plain(value: Any, depth: int = 0) -> Any:
    """Return a value of :func:`read_pickle` as a NumPy array or a sparse matrix, or unchanged.

    Raises:
        ValueError: a stub whose state has another layout, or sizes that differ from the file's bytes.
    """
    if depth > MAX_DEPTH:
        raise ValueError("the pickle nests arrays too deeply")
    if not isinstance(value, Stub):
        return value
    if value.name.startswith("numpy."):
        return _numpy_value(value, depth)
    state = value.state
    if not isinstance(state, dict):
        raise ValueError(f"{value.name} has no state")
    state = {key.decode("latin-1") if isinstance(key, bytes) else key: item for key, item in state.items()}
    if value.name.startswith("chumpy."):
        return _chumpy_array(state, depth)
    return _sparse_matrix(value.name.rsplit(".", 1)[1][:3], state, depth)


def _numpy_value(stub: Stub, depth: int) -> Any:
    kind = stub.name.rsplit(".", 1)[1]
    if kind == "_reconstruct":
        _, shape, dtype, fortran, raw = stub.state
        if isinstance(raw, list):
            if len(raw) == 1:
                return plain(raw[0], depth + 1)
            if not all(isinstance(item, int | float) for item in raw):
                raise ValueError("an array of objects holds more than one object; numbers are read")
            return np.array(raw, dtype=np.float64).reshape(_shape(shape))
        return array_of(raw, _dtype(dtype), shape, bool(fortran))
    if kind == "_frombuffer":
        raw, dtype, shape, order = stub.arguments
        return array_of(raw, _dtype(dtype), shape, order == "F")
    if kind == "scalar":
        return array_of(stub.arguments[1], _dtype(stub.arguments[0]), (), False)[()]
    raise ValueError(f"{stub.name} is not a value")


def array_of(raw: bytes | str, dtype: np.dtype, shape: Any, fortran: bool) -> np.ndarray:
    """Return the array of a number type that ``raw`` stores, read-only.

    Raises:
        ValueError: another type, or another number of bytes than the shape needs.
    """
    raw = raw.encode("latin-1") if isinstance(raw, str) else raw
    sizes = _shape(shape)
    if dtype.kind not in "biuf":
        raise ValueError(f"an array has the type {dtype}; numbers are read")
    needed = dtype.itemsize
    for size in sizes:
        needed *= size
    if needed != len(raw):
        raise ValueError(f"an array of shape {sizes} needs {needed} bytes, the file has {len(raw)}")
    return np.frombuffer(raw, dtype).reshape(sizes, order="F" if fortran else "C")


def _shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or len(shape) > 4 or not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError("an array has a shape that is none")
    return shape


def _dtype(stub: Any) -> np.dtype:
    """Return the number type that a pickled one names."""
    name = stub.arguments[0] if isinstance(stub, Stub) and stub.name == "numpy.dtype" and stub.arguments else None
    if not isinstance(name, str) or not re.fullmatch(r"b1|[iu][1248]|f[248]", name):
        raise ValueError(f"an array has the type {str(name)[:20]!r}; numbers are read")
    order = stub.state[1] if isinstance(stub.state, tuple) and len(stub.state) > 1 else "="
    return np.dtype((">" if order in (">", b">") else "<") + name)


def _chumpy_array(state: dict, depth: int) -> np.ndarray:
    """Return the value of a chumpy array, or of one that selects elements of another."""
    if "x" in state:
        return np.asarray(plain(state["x"], depth + 1))
    if not {"a", "idxs"} <= set(state):
        raise ValueError("a chumpy array stores a computation; its values are read, not its formula")
    chosen = np.asarray(plain(state["a"], depth + 1)).ravel()[np.asarray(plain(state["idxs"], depth + 1)).ravel()]
    shape = state.get("preferred_shape")
    return chosen if shape is None else chosen.reshape(_shape(tuple(int(plain(size)) for size in shape)))


def _sparse_matrix(kind: str, state: dict, depth: int) -> sparse.coo_matrix:
    """Return a matrix of any of SciPy's layouts by its entries; its size is not trusted with memory."""
    rows, columns = _shape(tuple(int(plain(size)) for size in state.get("_shape", state.get("shape", ()))))
    data = np.asarray(plain(state["data"], depth + 1))
    if kind == "coo":
        pair = state["coords"] if "coords" in state else (state["row"], state["col"])
        row, column = (np.asarray(plain(index, depth + 1)) for index in pair)
    else:
        inner, starts = (np.asarray(plain(state[key], depth + 1)) for key in ("indices", "indptr"))
        counts = np.diff(starts)
        if counts.min(initial=0) < 0 or counts.sum() != len(data):
            raise ValueError("a sparse matrix has other counts than entries")
        outer = np.repeat(np.arange(len(counts)), counts)
        row, column = (outer, inner) if kind == "csr" else (inner, outer)
    return sparse.coo_matrix((data, (row, column)), shape=(rows, columns))
