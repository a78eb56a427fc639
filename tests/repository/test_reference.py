"""The reference pages say what the code says."""

from __future__ import annotations

from pathlib import Path

import pytest
import reference

from shared import messages
from shared.keys import ALIVE_PATTERN, STREAMS

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("name", ["protocol.md", "configuration.md"])
def test_generated_tables_are_up_to_date(name: str) -> None:
    page = (DOCS / name).read_text()
    assert reference.renewed(page) == page, f"run: python -m tests.reference docs/{name}"


def test_protocol_names_every_stream_message_and_the_version() -> None:
    page = (DOCS / "protocol.md").read_text()
    for stream in STREAMS:
        assert f"`{stream.pattern}`" in page
    for cls in reference.carried():
        assert f"### {cls.__name__}\n" in page
        for field in cls.model_fields:
            assert f"| `{field}` |" in page
    told = f"the protocol version (an integer, now `{messages.PROTOCOL_VERSION}`)"
    assert told in " ".join(page.split())
    token = ALIVE_PATTERN.replace("{", "<").replace("}", ">")
    assert f"`{token}`" in page


def test_every_message_class_is_carried_by_some_stream() -> None:
    classes = {
        cls
        for cls in vars(messages).values()
        if isinstance(cls, type) and issubclass(cls, messages.Message)
    }
    assert classes - {messages.Message} == set(reference.carried())
