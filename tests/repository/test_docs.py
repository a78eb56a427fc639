"""Pages for people agree with the code: links, commands, files, columns, keys, libraries."""

from __future__ import annotations

import ast
import importlib
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from services.cli.main import app
from shared import settings
from shared.messages import ActorState, LearnerState, Message, ReplayState, RobotState
from shared.run_record import EPISODE_COLUMNS, TRAINING_COLUMNS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.glob("*.md")])
CODE = re.compile(r"```.*?```|`[^`\n]+`", re.DOTALL)
STATES: dict[str, type[Message]] = {
    "driver": RobotState,
    "actor": ActorState,
    "replay": ReplayState,
    "learner": LearnerState,
}

on_every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def code(page: Path) -> list[str]:
    """What stands between backticks, blocks and single words, without them."""
    return [text.strip("`").strip() for text in CODE.findall(page.read_text())]


def section(page: str, title: str) -> str:
    """The text below a heading, up to the next one."""
    return (DOCS / page).read_text().split(f"## {title}\n")[1].split("\n## ")[0]


def first_cells(text: str) -> list[str]:
    """First column of the tables in a text."""
    return re.findall(r"^\| ([^|]+?) \|", text, flags=re.MULTILINE)


@on_every_page
def test_links_lead_to_files(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if not target.startswith("https://"):
            assert (page.parent / target.split("#")[0]).exists(), target


def commands(page: Path) -> Iterator[list[str]]:
    """Every `corridor ...` on a page, as words."""
    for text in code(page):
        for found in re.findall(r"(?<![\w/.-])corridor ([a-z](?:(?!corridor )[^\n])*)", text):
            yield found.split("#")[0].split()


@on_every_page
def test_commands_and_options_exist(page: Path) -> None:
    for words in commands(page):
        command: Any = typer.main.get_command(app)
        while words and hasattr(command, "commands"):
            name = words.pop(0).strip(",;")
            assert name in command.commands, f"corridor {name}"
            command = command.commands[name]
        known = {option for parameter in command.params for option in parameter.opts}
        for word in words:
            if re.match(r"--[a-z]", word):
                assert word.split("=")[0].strip(",;)") in known, (command.name, word)


@on_every_page
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    for text in code(page):
        for name in re.findall(r"^make ([a-z-]+)", text, flags=re.MULTILINE):
            assert name in targets, name


@on_every_page
def test_files_named_exist(page: Path) -> None:
    top = "shared|services|experiments|tests|docs|benchmarks|tools"
    for text in code(page):
        if re.fullmatch(rf"(?:{top})/[\w./-]*", text):
            assert (ROOT / text).exists(), text


@on_every_page
def test_settings_named_exist(page: Path) -> None:
    keys = set(dict(settings.keys()))
    sections = {key.rsplit(".", 1)[0] for key in keys}
    for text in code(page):
        for key in re.findall(r"--set ([\w.]+)=", text):
            assert key in keys, key
        for name in re.findall(r"CORRIDOR_([A-Z0-9_]+)", text):
            known = keys | settings.SHORT.keys() | {"section.key"}
            assert name.lower().replace("__", ".") in known, name
        named = re.fullmatch(r"([a-z_]+(?:\.[a-z_]+)+)(?: = \S+)?", text)
        if (
            named
            and named[1].rsplit(".", 1)[0] in sections
            and not named[1].endswith((".py", ".json"))
        ):
            assert named[1] in keys | sections or defined(named[1]), named[1]


def test_every_metrics_column_is_explained_in_order() -> None:
    cells = [cell.strip("`") for cell in first_cells(section("operations.md", "Metrics"))]
    assert [cell for cell in cells if cell not in ("column", "--")] == [
        *EPISODE_COLUMNS,
        *(column for column in TRAINING_COLUMNS if column not in EPISODE_COLUMNS),
    ]


def test_every_counter_is_a_field_of_the_heartbeat() -> None:
    rows = re.findall(
        r"^\| (\w+) \| (`[^|]+) \|", section("operations.md", "Counters in heartbeats"), re.M
    )
    assert len(rows) > 10
    for service, cell in rows:
        for counter in re.findall(r"`(\w+)`", cell):
            for state in STATES.values() if service == "all" else [STATES[service]]:
                assert counter in state.model_fields, (service, counter)


def test_messages_quoted_for_troubleshooting_occur_in_the_code() -> None:
    written = {
        node.value
        for top in ("shared", "services", "experiments")
        for path in (ROOT / top).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    quoted = re.findall(r"^\| `([^`]+)`", section("operations.md", "Troubleshooting"), re.M)
    assert len(quoted) > 8
    for message in quoted:
        # Dots, capitals and names in quotes stand for what differs from case to case.
        for part in re.split(r"\.\.\.|'\w+'|\b[A-Z]{2,}\b", message):
            words = part.strip(" :,")
            assert any(words in text.replace("`", "") for text in written), (message, words)


def test_every_erratum_has_our_reading() -> None:
    listed = first_cells(section("algorithm.md", "Open questions and our readings"))
    ids = [*(f"E{n}" for n in range(1, 18)), "E17b", *(f"E{n}" for n in range(18, 47))]
    assert listed == ["id", "--", *ids]


def test_every_requirement_of_the_algorithm_has_its_place() -> None:
    page = (DOCS / "algorithm.md").read_text()
    missing = [f"A{n}" for n in range(8, 37) if f"| A{n} |" not in page]
    assert missing == []


def test_places_in_the_algorithm_exist() -> None:
    page = (DOCS / "algorithm.md").read_text()
    for row in re.findall(r"^\| [AE]\d+b? \|.*$", page, flags=re.MULTILINE):
        for place in re.findall(r"`([^`]+)`", row.rsplit(" | ", 1)[1]):
            path = place if "/" in place else f"shared/rl/{place}"
            found = (ROOT / path).is_file() if place.endswith(".py") else defined(place)
            assert found, place


def defined(name: str) -> bool:
    """Whether a (dotted) name leads to something in one of the modules of the algorithm."""
    files = (ROOT / "shared" / "rl").rglob("[a-z]*.py")
    modules = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files]
    modules += ["services.actor.actor", "services.replay.numbering"]
    for path in modules:
        module = importlib.import_module(path)
        stem, _, rest = name.partition(".")
        if _leads(module, name) or (path.endswith(f".{stem}") and rest and _leads(module, rest)):
            return True
    return False


def _leads(start: object, name: str) -> bool:
    for part in name.split("."):
        if not hasattr(start, part):
            # Methods are also named after their module's only class: `learning.step`.
            classes = [
                value
                for value in getattr(start, "__dict__", {}).values()
                if isinstance(value, type)
            ]
            start = next((cls for cls in classes if hasattr(cls, part)), None)
            if start is None:
                return False
        start = getattr(start, part)
    return True


def test_every_library_has_its_reason() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = set(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        declared |= set(extra)
    names = {re.split(r"[<>=\[]", name)[0] for name in declared} - {"corridor"}
    explained: set[str] = set()
    for cell in first_cells((DOCS / "dependencies.md").read_text()):
        explained |= set(cell.split(", "))
    assert explained - {"library", "--"} == names


def test_pictures_are_small() -> None:
    pictures = list((DOCS / "images").iterdir())
    sizes = {picture: picture.stat().st_size for picture in pictures}
    assert sum(size for picture, size in sizes.items() if picture.suffix != ".gif") < 400_000
    assert sum(sizes.values()) < 1_500_000
    used = "".join(page.read_text() for page in PAGES)
    assert all(f"images/{picture.name}" in used for picture in pictures)
