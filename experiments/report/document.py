"""A page of figures, tables and sentences, written as Markdown or as one HTML file."""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TypeVar

from markdown_it import MarkdownIt
from matplotlib.figure import Figure

from experiments.report.figures.style import png

T = TypeVar("T")


@dataclass(frozen=True)
class Picture:
    """A figure with what it shows."""

    name: str
    """File name without ending; unique in a document."""
    title: str
    caption: str
    draw: Callable[[], Figure]

    @cached_property
    def image(self) -> bytes:
        """PNG, drawn when first asked for: text alone needs no drawing."""
        return png(self.draw())


@dataclass(frozen=True)
class Table:
    """Rows of text under a header."""

    name: str
    """Unique in a document."""
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Findings:
    """Sentences computed from the numbers of the figure or table before them."""

    sentences: tuple[str, ...]


@dataclass(frozen=True)
class Missing:
    """A figure or table that is left out, and why."""

    what: str
    why: str


Block = Picture | Table | Findings | Missing


@dataclass(frozen=True)
class Section:
    """Blocks under a heading."""

    name: str
    """Name for links and files."""
    title: str
    blocks: tuple[Block, ...]


def table(
    name: str, title: str, items: Iterable[T], columns: Mapping[str, Callable[[T], str]]
) -> Table:
    """A row for each item; `columns` by what stands above them."""
    rows = (tuple(told(item) for told in columns.values()) for item in items)
    return Table(name, title, tuple(columns), tuple(rows))


def write_pictures(sections: Sequence[Section], folder: Path) -> None:
    """Write every picture as `<name>.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Picture):
                (folder / f"{block.name}.png").write_bytes(block.image)


def markdown(sections: Sequence[Section], images: str, level: int = 2) -> str:
    """Sections as Markdown, with headings of this level; `images`: as in `block_text`."""
    parts = []
    for section in sections:
        parts.append(f"{'#' * level} {section.title}")
        parts += [block_text(block, images) for block in section.blocks]
    return "\n\n".join(parts) + "\n"


def block_text(block: Block, images: str) -> str:
    """One block as Markdown; `images` is the path of the pictures, as seen from the page."""
    match block:
        case Picture():
            caption = f"**{block.title}.** {block.caption}".strip()
            return f"![{block.title}]({images}/{block.name}.png)\n\n{caption}"
        case Table():
            lines = [block.header, tuple("---" for _ in block.header), *block.rows]
            rows = ("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)
            return f"**{block.title}**\n\n" + "\n".join(rows)
        case Findings():
            return "\n".join(f"- {sentence}" for sentence in block.sentences)
        case Missing():
            return f"*Left out: {block.what}: {block.why}.*"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def html(title: str, sections: Sequence[Section]) -> str:
    """One page that needs no other file: the Markdown as HTML, with pictures and style inside."""
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    links = (f'<li><a href="#{s.name}">{escape(s.title)}</a></li>' for s in sections)
    parts = [f"<h1>{escape(title)}</h1>", "<ul>", *links, "</ul>"]
    for section in sections:
        parts.append(f'<h2 id="{section.name}">{escape(section.title)}</h2>')
        for block in section.blocks:
            text = parser.render(block_text(block, "figures"))
            if isinstance(block, Picture):
                data = base64.b64encode(block.image).decode("ascii")
                text = text.replace(f"figures/{block.name}.png", f"data:image/png;base64,{data}")
            parts.append(text)
    return _HEAD.replace("TITLE", escape(title)) + "\n".join(parts) + "\n</body>\n</html>\n"


_HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>TITLE</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff;
       max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; }
h2 { margin-top: 3rem; border-top: 1px solid #ddd; padding-top: 1rem; }
img { max-width: 100%; height: auto; }
table { display: block; overflow-x: auto; border-collapse: collapse; font-size: 0.85rem; }
th, td { text-align: left; padding: 0.2rem 0.7rem 0.2rem 0; border-bottom: 1px solid #e5e5e5;
         vertical-align: top; }
</style>
</head>
<body>
"""
