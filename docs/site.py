"""What the site has beside docs/: the README as its first page, and a page of each public module.

Pages link to files of the repository. Those are no pages of the site, so only their names are kept.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
MODULES = {
    "The system in one process": ["experiments.single_process", "experiments.environment"],
    "Facts, messages, streams": ["shared.facts", "shared.messages", "shared.keys", "shared.config"],
    "The algorithm": ["shared.rl"],
    "Strategies of retention": ["shared.rl.retention"],
    "What a robot must do": ["services.robot_driver.robot"],
}
"""Title of a page, and the modules on it; a package stands for the modules in it."""
FENCE = re.compile(r"^```(\w+) (\S+)$", re.MULTILINE)
"""A block of code that names its file."""
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+)\)")


def on_config(config: Any) -> Any:
    """Add the pages of modules to the navigation."""
    pages = [{title: _page(title)} for title in MODULES]
    config.nav.append({"Modules": pages})
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the README, whose links begin at the root, and the pages of modules."""
    readme = (ROOT / "README.md").read_text().replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=readme))
    for title, names in MODULES.items():
        parts = [f"::: {module}" for name in names for module in _modules(name)]
        text = "\n\n".join([f"# {title}", *parts])
        files.append(File.generated(config, _page(title), content=text))
    return files


def on_page_markdown(markdown: str, page: Any, files: Files, **_: Any) -> str:
    """Keep links to pages and pictures of the site, and the text of all others."""
    folder = Path(page.file.src_uri).parent

    def kept(link: re.Match[str]) -> str:
        text, target = link.groups()
        path = target.partition("#")[0]
        here = not path or "://" in target or files.get_file_from_path(str(folder / path))
        return link.group() if here else text

    return LINK.sub(kept, FENCE.sub(r'```\1 title="\2"', markdown))


def _page(title: str) -> str:
    return f"modules/{title.lower().replace(' ', '-').replace(',', '')}.md"


def _modules(name: str) -> list[str]:
    folder = ROOT / name.replace(".", "/")
    if not folder.is_dir():
        return [name]
    return [f"{name}.{path.stem}" for path in sorted(folder.glob("[!_]*.py"))]
