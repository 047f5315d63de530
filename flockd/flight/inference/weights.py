"""The weights inside an ONNX file: each has to be a number, which neither a hash nor ONNX Runtime checks.

Reads just as much of the format (onnx.proto3, a protobuf) as that takes; the flight install has no `onnx`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

_GRAPH, _FUNCTIONS = 7, 25  # of ModelProto
_NODES, _INITIALIZERS = 1, 5  # of GraphProto
_FUNCTION_NODES = 7  # of FunctionProto
_ATTRIBUTES = 5  # of NodeProto
_TENSOR, _SUBGRAPH, _TENSORS, _SUBGRAPHS = 5, 6, 10, 11  # of AttributeProto
_TYPE, _FLOATS, _INT32S, _NAME, _RAW, _DOUBLES, _LOCATION = 2, 4, 5, 8, 9, 10, 14  # of TensorProto
_FLOAT, _FLOAT16, _DOUBLE, _BFLOAT16 = 1, 10, 11, 16
_EXTERNAL = 1
_LITTLE_ENDIAN = {_FLOAT: "<f4", _FLOAT16: "<f2", _DOUBLE: "<f8", _BFLOAT16: "<u2"}

Field = tuple[int, int | memoryview]


def fault_of_weights(model: bytes) -> str | None:
    """What is wrong with the weights of an ONNX model, or None: one is NaN, or they lie in a file of their own.

    Raises ValueError where the bytes are no protobuf.
    """
    for tensor in _tensors_of_model(memoryview(model)):
        fault = _fault_of_tensor(list(_fields(tensor)))
        if fault:
            return fault
    return None


def _tensors_of_model(model: memoryview) -> Iterator[memoryview]:
    for number, value in _fields(model):
        if number == _GRAPH:
            yield from _tensors_of_graph(_bytes(value))
        elif number == _FUNCTIONS:
            for inner, node in _fields(_bytes(value)):
                if inner == _FUNCTION_NODES:
                    yield from _tensors_of_node(_bytes(node))


def _tensors_of_graph(graph: memoryview) -> Iterator[memoryview]:
    for number, value in _fields(graph):
        if number == _INITIALIZERS:
            yield _bytes(value)
        elif number == _NODES:
            yield from _tensors_of_node(_bytes(value))


def _tensors_of_node(node: memoryview) -> Iterator[memoryview]:
    attributes = (_bytes(value) for number, value in _fields(node) if number == _ATTRIBUTES)
    for attribute in attributes:
        for number, value in _fields(attribute):
            if number in {_TENSOR, _TENSORS}:
                yield _bytes(value)
            elif number in {_SUBGRAPH, _SUBGRAPHS}:
                yield from _tensors_of_graph(_bytes(value))


def _fault_of_tensor(fields: list[Field]) -> str | None:
    kinds = [value for number, value in fields if number == _TYPE]
    name = next((bytes(_bytes(value)).decode(errors="replace") for number, value in fields if number == _NAME), "")
    if (_LOCATION, _EXTERNAL) in fields:
        return f"weight {name!r} lies in another file, which no hash guards; export the model as one file"
    if not kinds or kinds[0] not in _LITTLE_ENDIAN:
        return None
    for number, value in fields:
        numbers = _numbers(number, value, int(kinds[0]))
        if numbers is not None and np.isnan(numbers).any():
            return f"weight {name!r} holds NaN; restore the model or train it again"
    return None


def _numbers(number: int, value: int | memoryview, kind: int) -> NDArray[np.floating] | None:
    """The numbers of one field of a tensor, if that field holds any."""
    if number == _RAW:
        raw = np.frombuffer(_bytes(value), _LITTLE_ENDIAN[kind])
        return _from_bfloat16(raw) if kind == _BFLOAT16 else raw
    if isinstance(value, int):  # one number that was not packed with others
        return None
    if number in {_FLOATS, _DOUBLES}:
        return np.frombuffer(value, "<f4" if number == _FLOATS else "<f8")
    if number == _INT32S:  # both 16-bit kinds, one varint each
        halves = np.array(list(_varints(value)), np.uint16)
        return _from_bfloat16(halves) if kind == _BFLOAT16 else halves.view(np.float16)
    return None


def _from_bfloat16(values: NDArray[np.unsignedinteger]) -> NDArray[np.float32]:
    return (values.astype(np.uint32) << 16).view(np.float32)


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("a number where a part was expected")  # noqa: TRY004 - of the file, not of our types
    return value


def _fields(message: memoryview) -> Iterator[Field]:
    """Number and value of each field of a protobuf message."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        wire = key & 7
        if wire == 0:
            number, position = _varint(message, position)
            yield key >> 3, number
            continue
        if wire == 2:
            length, position = _varint(message, position)
        elif wire in {1, 5}:
            length = 8 if wire == 1 else 4
        else:
            raise ValueError(f"byte {position} begins no field")
        if position + length > len(message):
            raise ValueError("it ends in the middle of a field")
        yield key >> 3, message[position : position + length]
        position += length


def _varints(packed: memoryview) -> Iterator[int]:
    position = 0
    while position < len(packed):
        value, position = _varint(packed, position)
        yield value & 0xFFFF


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """The number that begins at ``position``, and where it ends."""
    value = shift = 0
    while shift < 70:
        if position >= len(message):
            raise ValueError("it ends in the middle of a number")
        byte = message[position]
        value |= (byte & 0x7F) << shift
        position += 1
        if byte < 0x80:
            return value, position
        shift += 7
    raise ValueError(f"byte {position} ends no number")
