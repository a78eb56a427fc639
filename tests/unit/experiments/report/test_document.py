"""Blocks as Markdown and HTML."""

from __future__ import annotations

from experiments.report.document import Missing, Section, Table, html, markdown


def test_text_is_escaped() -> None:
    table = Table("t", "<t>", ("a|b",), (("<script>",),))
    section = Section("s", "x & y", (table, Missing("<f>", "no data")))
    page = html("T", [section])
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert "a\\|b" in markdown([section], "figures")
