"""A page of figures, tables and sentences, written as Markdown or as one HTML file."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from jinja2 import Environment
from matplotlib.figure import Figure

from experiments.report.figures.style import png


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


def write_pictures(sections: Sequence[Section], folder: Path) -> None:
    """Write every picture as `<name>.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Picture):
                (folder / f"{block.name}.png").write_bytes(block.image)


def sentences(found: Sequence[str]) -> list[Block]:
    """A block of sentences; none where nothing was found."""
    return [Findings(tuple(found))] if found else []


def markdown(sections: Sequence[Section], images: str, level: int = 2) -> str:
    """Sections as Markdown.

    Args:
        sections: What to write.
        images: Path of the folder with the pictures, as seen from the page.
        level: Of the sections' headings.
    """
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
    """One page that needs no other file: pictures and style are inside."""
    template = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(_PAGE)
    return template.render(title=title, sections=sections, kind=_kind, code=_is_code, data=_data)


def _kind(block: Block) -> str:
    return type(block).__name__.lower()


def _is_code(cell: str) -> bool:
    """Whether it stands between backticks, as code does in Markdown."""
    return len(cell) > 1 and cell[0] == cell[-1] == "`"


def _data(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.image).decode("ascii")


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff;
       max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; }
h2 { margin-top: 3rem; border-top: 1px solid #ddd; padding-top: 1rem; }
figure { margin: 1.5rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption, caption { font-size: 0.9rem; text-align: left; }
.scroll { overflow-x: auto; margin: 1.5rem 0; }
table { border-collapse: collapse; font-size: 0.85rem; }
caption { font-weight: 600; padding-bottom: 0.3rem; }
th, td { text-align: left; padding: 0.2rem 0.7rem 0.2rem 0; border-bottom: 1px solid #e5e5e5;
         vertical-align: top; }
.missing { color: #777; font-style: italic; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<ul>
{% for section in sections %}
<li><a href="#{{ section.name }}">{{ section.title }}</a></li>
{% endfor %}
</ul>
{% for section in sections %}
<h2 id="{{ section.name }}">{{ section.title }}</h2>
{% for block in section.blocks %}
{% if kind(block) == "picture" %}
<figure>
<img src="{{ data(block) }}" alt="{{ block.title }}">
<figcaption><b>{{ block.title }}.</b> {{ block.caption }}</figcaption>
</figure>
{% elif kind(block) == "table" %}
<div class="scroll"><table>
<caption>{{ block.title }}</caption>
<tr>{% for cell in block.header %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for row in block.rows %}
<tr>
{% for cell in row %}
{% if code(cell) %}
<td><code>{{ cell.strip("`") }}</code></td>
{% else %}
<td>{{ cell }}</td>
{% endif %}
{% endfor %}
</tr>
{% endfor %}
</table></div>
{% elif kind(block) == "findings" %}
<ul>
{% for sentence in block.sentences %}
<li>{{ sentence }}</li>
{% endfor %}
</ul>
{% else %}
<p class="missing">Left out: {{ block.what }}: {{ block.why }}.</p>
{% endif %}
{% endfor %}
{% endfor %}
</body>
</html>
"""
