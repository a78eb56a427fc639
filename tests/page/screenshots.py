"""Pictures of the page for the documentation: `python -m tests.page.screenshots [FOLDER]`.

FOLDER: where they go; docs/images unless given. The run lasts some minutes.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, expect

from shared.provenance import ROOT
from tests.page.rig import chromium, context, installed, running

EPISODES, MOST_BYTES = 60, 60_000
SETTINGS = ("run.name=demo", "memory.capacity=2000", "learning.fit_every=10", "network.filters=16",
            "episode.max_samples=200", "episode.horizon=50")  # fmt: skip


def keep(picture: bytes, path: Path) -> None:
    """Write a picture with 256 colours, or fewer and smaller until it is small enough."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    for colours, scale in ((256, 1.0), (64, 1.0), (256, 0.75), (64, 0.75), (32, 0.6)):
        size = (round(image.width * scale), round(image.height * scale))
        found = image.resize(size, Image.Resampling.LANCZOS).quantize(colours)
        found.save(path, optimize=True)
        if path.stat().st_size <= MOST_BYTES:
            return


def look_at_memory(page: Page) -> None:
    """Open the memory with one sample in detail."""
    page.get_by_role("button", name="Memory").click()
    expect(page.locator("#wall button")).to_have_count(48, timeout=60_000)
    page.locator("[name=candidate]").select_option("true")
    expect(page.locator("#wall button").first).to_contain_text("candidate")
    page.locator("#wall button").nth(5).click()
    expect(page.locator("#sample")).to_contain_text("Predicted by", timeout=60_000)
    page.evaluate("scrollTo(0, document.getElementById('sample').offsetTop - 400)")


def main(arguments: list[str]) -> None:
    """Drive a run and take its pictures."""
    if problem := installed():
        sys.exit(f"no browser: {problem}")
    out = Path(arguments[0]) if arguments else ROOT / "docs" / "images"
    out.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as place,
        chromium() as browser,
        running(Path(place) / "run", *SETTINGS, episodes=EPISODES) as run,
    ):
        for name, width, scheme in (
            ("page", 1280, "light"), ("page-dark", 1280, "dark"), ("page-narrow", 390, "light"),
            ("page-narrow-dark", 390, "dark"),
        ):  # fmt: skip
            window = context(browser, width, scheme)
            page = window.new_page()
            page.goto(run.address)
            expect(page.locator("#curve-loss")).to_be_visible(timeout=60_000)
            expect(page.locator(".chosen")).to_have_count(2, timeout=60_000)
            keep(page.screenshot(full_page=bool(arguments)), out / f"{name}.png")
            look_at_memory(page)
            keep(page.screenshot(full_page=bool(arguments)), out / f"{name}-memory.png")
            window.close()
            if not arguments and name == "page":
                break


if __name__ == "__main__":
    main(sys.argv[1:])
