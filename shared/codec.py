"""Messages to msgpack bytes and back: nothing is executed, sizes and types are checked first."""

from reprlib import repr as brief
from typing import Any, TypeVar

import msgpack
from pydantic import ValidationError

from shared.errors import BadMessage, first_problem
from shared.messages import PROTOCOL_VERSION, Message

M = TypeVar("M", bound=Message)
MAX_ARRAY, MAX_MAP, MAX_STR = 1000, 64, 4096
"""Entries of an array and of a map, bytes of a string: no message has more."""
MAX_VALUES = 20_000
"""Values of a message, those inside others included: a list of 1000 turns has half as many."""


def encode(message: Message) -> bytes:
    """The message as a msgpack map of its fields, plus "v" (protocol) and "t" (type name)."""
    fields: dict[str, Any] = {"v": PROTOCOL_VERSION, "t": type(message).__name__}
    fields.update(message.model_dump())
    data: bytes = msgpack.packb(fields, use_bin_type=True)
    return data


def decode(data: bytes, *types: type[M]) -> M:
    """The message in `data`, which must be one of `types`. Raises BadMessage for anything else."""
    expected = " or ".join(t.__name__ for t in types)
    try:
        fields = _unpacked(data)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise BadMessage(
            f"expected {expected}, got {len(data)} bytes that are not msgpack: {error}"
        ) from error
    if not isinstance(fields, dict):
        raise BadMessage(f"expected {expected} as a map, got {type(fields).__name__}")
    version = fields.pop("v", None)
    if type(version) is not int or version != PROTOCOL_VERSION:
        wanted = f"{expected} of protocol {PROTOCOL_VERSION}"
        raise BadMessage(f"expected {wanted}, got {brief(version)}")
    name = fields.pop("t", None)
    for cls in types:
        if cls.__name__ == name:
            try:
                return cls.model_validate(fields)
            except ValidationError as error:
                raise BadMessage(f"{name}: {first_problem(error)}") from error
    raise BadMessage(f"expected {expected}, got type {brief(name)}")


def _unpacked(data: bytes) -> Any:
    """What msgpack makes of the bytes. Values are counted: a byte may stand for a map of 64."""
    left = MAX_VALUES

    def count(container: Any) -> Any:
        nonlocal left
        left -= 1 + len(container)
        if left < 0:
            raise ValueError(f"more than {MAX_VALUES} values")
        return container

    return msgpack.unpackb(
        data,
        raw=False,
        use_list=False,
        strict_map_key=True,
        list_hook=count,
        object_hook=count,
        max_array_len=MAX_ARRAY,
        max_map_len=MAX_MAP,
        max_str_len=MAX_STR,
        max_ext_len=0,
    )
