"""Reference tables made from the code: streams, messages, configuration.

`python -m tests.reference docs/protocol.md docs/configuration.md` renews the generated parts of
these pages; a test compares them with the code.
"""

from __future__ import annotations

import re
import sys
import textwrap
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from shared import messages
from shared.config import Config
from shared.keys import STREAMS

OVERFLOW = {
    "latest": "newer replaces unread older",
    "request": "error reply 'busy', the sender repeats it",
}
MARK = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def streams_table() -> str:
    """Every row of `shared.keys.STREAMS`."""
    lines = [
        "| stream | key | payload -> answer | from -> to | delivery | rate | at most | queue "
        "| overflow |",
        _rule(9),
    ]
    for s in STREAMS:
        answers = " / ".join(reply.__name__ for reply in s.reply)
        payload = s.request.__name__ + (f" -> {answers}" if answers else "")
        lines.append(
            f"| {s.name} | `{s.pattern}` | {payload} "
            f"| {', '.join(s.senders)} -> {', '.join(s.receivers)} "
            f"| {s.delivery} | {s.rate} | {_size(s.max_bytes)} | {s.queue} "
            f"| {OVERFLOW[s.delivery]} |"
        )
    return "\n".join(lines)


def messages_tables() -> str:
    """The fields of every message that some stream carries."""
    return "\n\n".join(_message_table(cls) for cls in carried())


def carried() -> list[type[messages.Message]]:
    """All message classes of the protocol, in the order of the stream table."""
    found: dict[type[messages.Message], None] = {}
    for stream in STREAMS:
        for cls in (stream.request, *stream.reply):
            found[cls] = None
            for field in cls.model_fields.values():
                for inner in _classes(field.annotation):
                    found[inner] = None
    return [*found, messages.Refusal]


def configuration_tables() -> str:
    """Every key of the configuration tree with type, default and meaning."""
    parts = []
    for name, section in _sections(Config, ""):
        lines = [
            f"### `{name}`",
            "",
            _paragraph(section.__doc__),
            "",
            "| key | type | default | meaning |",
            _rule(4),
        ]
        for key, field in section.model_fields.items():
            if not _is_section(field):
                default = f"`{field.default!r}`".replace("'", '"')
                lines.append(
                    f"| `{name}.{key}` | {_type(field)} | {default} | {_text(field.description)} |"
                )
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


TABLES = {
    "streams": streams_table,
    "messages": messages_tables,
    "configuration": configuration_tables,
}


def renewed(page: str) -> str:
    """A page with its generated parts as they should be."""
    return MARK.sub(lambda m: f"{m[1]}\n{TABLES[m[2]]()}\n\n{m[3]}", page)


def main(paths: list[str]) -> None:
    """Renew pages in place."""
    for path in map(Path, paths):
        path.write_text(renewed(path.read_text()))


def _message_table(cls: type[messages.Message]) -> str:
    head = ["| field | type | meaning |", _rule(3)]
    lines = [f"### {cls.__name__}", "", _paragraph(cls.__doc__), "", *head]
    for name, field in cls.model_fields.items():
        optional = "" if field.is_required() else f", default `{field.default!r}`"
        lines.append(f"| `{name}` | {_type(field)}{optional} | {_text(field.description)} |")
    return "\n".join(lines)


def _sections(cls: type[BaseModel], prefix: str) -> Iterator[tuple[str, type[BaseModel]]]:
    for key, field in cls.model_fields.items():
        if _is_section(field):
            section = typing.cast(type[BaseModel], field.annotation)
            if any(not _is_section(inner) for inner in section.model_fields.values()):
                yield prefix + key, section
            yield from _sections(section, f"{prefix}{key}.")


def _is_section(field: FieldInfo) -> bool:
    return isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)


def _classes(annotation: Any) -> Iterator[type[messages.Message]]:
    if isinstance(annotation, type) and issubclass(annotation, messages.Message):
        yield annotation
    for argument in get_args(annotation):
        yield from _classes(argument)


def _type(field: FieldInfo) -> str:
    """Type and range in words, e.g. "int, >= 0" or "bytes, length 16"."""
    limits = {}
    for item in field.metadata:
        for name in ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern"):
            value = getattr(item, name, None)
            if value is not None:
                limits[name] = value
    ours = [
        item.func.ours
        for item in field.metadata
        if hasattr(item, "func") and hasattr(item.func, "ours")
    ]
    words = [" or ".join(f'"{name}"' for name in ours[0]) if ours else _name(field.annotation)]
    if "pattern" in limits:
        words.append(f"`{limits.pop('pattern')}`")
    least, most = limits.pop("min_length", None), limits.pop("max_length", None)
    if least is not None or most is not None:
        words.append(f"length {least}" if least == most else f"length {least or 0}..{most or ''}")
    signs = {"ge": ">=", "gt": ">", "le": "\\<=", "lt": "<"}
    words += [f"{signs[name]} {_number(value)}" for name, value in limits.items()]
    return ", ".join(words).replace("|", "\\|")


def _name(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(f'"{value}"' for value in arguments)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_name(argument) for argument in arguments)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"array of {_name(arguments[0])}"
        return f"array of {len(arguments)} {_name(arguments[0])}"
    if origin is typing.Annotated:
        return _name(arguments[0])
    if annotation is type(None):
        return "nil"
    return str(getattr(annotation, "__name__", annotation))


def _number(value: float) -> str:
    return "2^63" if value == 2**63 else str(value)


def _size(count: int) -> str:
    return f"{count // 2**20} MiB" if count >= 2**20 else f"{count // 1024} KiB"


def _rule(columns: int) -> str:
    """Return the line between the head and the body of a table, as the formatter writes it."""
    return "| " + "-- | " * (columns - 1) + "-- |"


def _text(doc: str | None) -> str:
    """Return a docstring as one line of Markdown; what stands between backticks stays as it is."""
    parts = " ".join((doc or "").split()).replace("|", "\\|").split("`")
    parts[::2] = [
        re.sub(r"\[([^]]*)\]:", r"\\[\1\\]:", re.sub(r"<(?=\S)", r"\\<", part))
        for part in parts[::2]
    ]
    return "`".join(parts)


def _paragraph(doc: str | None) -> str:
    """Return a docstring as a paragraph of Markdown, wrapped as the formatter wraps it."""
    return textwrap.fill(_text(doc), 100, break_long_words=False, break_on_hyphens=False)


if __name__ == "__main__":
    main(sys.argv[1:])
