"""Messages to bytes in CDR, little-endian: for each type a function made once from its definition.

Numbers that follow each other are packed in one go, and a list of messages of fixed size may be
given as a structured array instead (see ``record_type``). The bytes are those of ``rosbags``, which
sets them field by field.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import count
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

Encoder: TypeAlias = Callable[[Any, bytearray], None]
"""Appends a value's bytes to those before it, aligned as their number demands."""

# Format of struct by name; byte, as rosbags has it, is signed.
_FORMATS = {
    "bool": "?", "byte": "b", "char": "B",
    "int8": "b", "int16": "h", "int32": "i", "int64": "q",
    "uint8": "B", "uint16": "H", "uint32": "I", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip
_ARRAYS = {"bool": "bool", "byte": "uint8", "char": "uint8"}
_MOST_ALIGNED = 8


class _Number(NamedTuple):
    """One number, or an array of a fixed length: code that gives its value, name, length."""

    code: str
    base: str
    length: int | None = None


class _Text(NamedTuple):
    """A string."""

    code: str


class _Sequence(NamedTuple):
    """As many elements as there are."""

    code: str
    element: Any


class _Length(NamedTuple):
    """A fixed number of elements that has to be checked."""

    code: str
    length: int


_Field: TypeAlias = _Number | _Text | _Sequence | _Length


@cache
def encoder(store: Typestore, type_name: str) -> Encoder:
    """The function that appends messages of a type.

    It raises whatever a value provokes that does not fit: ``struct.error``, AttributeError,
    TypeError or ValueError.

    Raises:
        KeyError: the type, or one in it, is unknown.
        NotImplementedError: it has a field that no message of ROS 2 can be made with here.
    """
    return _Code(store).compile(_fields(store, type_name, "m"))


@cache
def record_type(store: Typestore, type_name: str) -> np.dtype[np.void]:
    """Structured type of numpy that holds messages of a type of fixed size, gaps included.

    Raises:
        ValueError: the type has no fixed size.
    """
    return _record_type(store, type_name, 0)[0]


class _Code:
    """The text of an encoder in the making, and the names that it uses."""

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._lines: list[str] = []
        self._names: dict[str, Any] = {"block": _block}
        self._run: list[tuple[str, int, str]] = []  # format, alignment, value
        self._number = count()

    def compile(self, fields: Iterator[_Field]) -> Encoder:
        for field in fields:
            self._add(field)
        self._end_run()
        text = "\n".join(f"    {line}" for line in self._lines)
        exec(f"def encode(m, out):\n{text}", self._names)
        made: Encoder = self._names["encode"]
        return made

    def _add(self, field: _Field) -> None:
        name = f"v{next(self._number)}"
        if isinstance(field, _Number):
            self._add_number(field)
        elif isinstance(field, _Length):
            self._lines.append(f"if len({field.code}) != {field.length}: raise ValueError(")
            self._lines.append(f"    '{field.code} must have {field.length} elements')")
        elif isinstance(field, _Text):
            self._lines.append(f"{name} = {field.code}.encode() + b'\\0'")
            self._run.append(("I", 4, f"len({name})"))
            self._end_run()
            self._lines.append(f"out += {name}")
        else:
            self._lines.append(f"{name} = {field.code}")
            self._run.append(("I", 4, f"len({name})"))
            self._end_run()
            self._names[f"put_{name}"] = _elements(self._store, field.element)
            self._lines.append(f"if len({name}): put_{name}({name}, out)")

    def _add_number(self, field: _Number) -> None:
        size = Struct(_FORMATS[field.base]).size
        if field.length is None:
            self._run.append((_FORMATS[field.base], size, field.code))
            return
        kind = f"dtype_{field.base}"
        self._names[kind] = _dtype(field.base)
        value = f"block({field.code}, {kind}, {field.length})"
        self._run.append((f"{size * field.length}s", size, value))

    def _end_run(self) -> None:
        """Pack what was gathered, as it lies for each position modulo the largest alignment."""
        if not self._run:
            return
        name = f"run{next(self._number)}"
        layouts = [_layout(self._run, start) for start in range(_MOST_ALIGNED)]
        self._names[name] = [layout.pack for layout in layouts]
        values = ", ".join(value for _, _, value in self._run)
        self._lines.append(f"out += {name}[len(out) & {_MOST_ALIGNED - 1}]({values})")
        self._run.clear()


def _layout(run: Sequence[tuple[str, int, str]], start: int) -> Struct:
    text, position = "<", start
    for form, alignment, _ in run:
        gap = -position % alignment
        text += f"{gap}x" * (gap > 0) + form
        position += gap + Struct(f"<{form}").size
    return Struct(text)


def _fields(store: Typestore, type_name: str, code: str) -> Iterator[_Field]:
    """The fields of a type, those of the types in it among them, in the order of the stream."""
    names = [field.name for field in dataclasses.fields(store.types[type_name])]  # type: ignore[arg-type]
    # What rosbags keeps in a class beside the fields comes behind them.
    for name, (_, description) in zip(names, store.fielddefs[type_name][1], strict=False):
        yield from _parts_of(store, description, f"{code}.{name}")


def _parts_of(store: Typestore, description: Any, code: str) -> Iterator[_Field]:
    kind, content = description
    if kind == Nodetype.NAME:
        yield from _fields(store, content, code)
    elif kind == Nodetype.BASE:
        yield _Text(code) if content[0] == "string" else _Number(code, _known(content[0]))
    elif kind == Nodetype.SEQUENCE:
        yield _Sequence(code, content[0])
    else:
        element, length = content
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            yield _Number(code, _known(element[1][0]), length)
            return
        yield _Length(code, length)
        for number in range(length):
            yield from _parts_of(store, element, f"{code}[{number}]")


def _known(base: str) -> str:
    if base not in _FORMATS:
        raise NotImplementedError(f"fields of type {base}")
    return base


def _elements(store: Typestore, description: Any) -> Encoder:
    """The function that appends the elements of a sequence that has some."""
    kind, content = description
    if kind == Nodetype.NAME:
        return _messages(store, content)
    if content[0] == "string":
        return _texts
    kind = _dtype(_known(content[0]))

    def numbers(values: Any, out: bytearray) -> None:
        out += bytes(-len(out) % kind.itemsize) + _block(values, kind, len(values))

    return numbers


def _texts(values: Any, out: bytearray) -> None:
    for value in values:
        data = value.encode() + b"\0"
        out += bytes(-len(out) % 4) + len(data).to_bytes(4, "little") + data


def _messages(store: Typestore, type_name: str) -> Encoder:
    encode = encoder(store, type_name)

    def messages(values: Any, out: bytearray) -> None:
        if isinstance(values, np.ndarray):
            _records(store, type_name, values, out)
            return
        for value in values:
            encode(value, out)

    return messages


def _records(store: Typestore, type_name: str, values: npt.NDArray[Any], out: bytearray) -> None:
    """Appends a structured array: in one go from where all further elements lie alike."""
    if values.dtype != record_type(store, type_name):
        raise ValueError(f"an array of {values.dtype} in the place of {type_name}")
    first = 0
    while first < len(values):
        start = len(out) % _MOST_ALIGNED
        kind, end = _record_type(store, type_name, start)
        steady = (start + end) % _MOST_ALIGNED == start
        some = values[first:] if steady else values[first : first + 1]
        data = some
        if kind != values.dtype:
            data = np.zeros(len(some), kind)
            for name in kind.names or ():
                data[name] = some[name]
        out += data.tobytes()
        first += len(some)


@cache
def _record_type(store: Typestore, type_name: str, start: int) -> tuple[np.dtype[np.void], int]:
    """Layout of a message of fixed size that starts at a position, and its size."""
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    position = start
    for name, description in _descriptions(store, type_name):
        alignment, form = _record_field(store, type_name, name, description)
        position += -position % alignment
        if isinstance(form, str):  # a message, which lies as its place demands
            form, size = _record_type(store, form, position % _MOST_ALIGNED)
        else:
            size = np.dtype(form).itemsize
        names.append(name)
        formats.append(form)
        offsets.append(position - start)
        position += size
    size = position - start
    made = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})
    return made, size


def _record_field(store: Typestore, type_name: str, name: str, description: Any) -> tuple[int, Any]:
    """Alignment of a field of fixed size, and its numpy type or the name of its message type."""
    kind, content = description
    if kind == Nodetype.NAME:
        first = _descriptions(store, content)[0]
        return _record_field(store, content, *first)[0], content
    base, length = (content[0], None) if kind == Nodetype.BASE else (content[0][1][0], content[1])
    if kind == Nodetype.SEQUENCE or base not in _FORMATS:
        raise ValueError(f"{type_name} has no fixed size: {name} has none")
    single = _dtype(base)
    return single.itemsize, single if length is None else (single, (length,))


def _descriptions(store: Typestore, type_name: str) -> list[tuple[str, Any]]:
    """Fields of a type as rosbags describes them."""
    return list(store.fielddefs[type_name][1])


def _dtype(base: str) -> np.dtype[Any]:
    return np.dtype(_ARRAYS.get(base, base)).newbyteorder("<")


def _block(values: Any, kind: np.dtype[Any], length: int) -> bytes:
    """The bytes of an array, which must be what it should be."""
    if values.dtype != kind or values.shape != (length,):
        raise ValueError(f"an array {values.shape} of {values.dtype}: needed ({length},) of {kind}")
    return bytes(values.tobytes())
