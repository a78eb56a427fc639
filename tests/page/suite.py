"""The page of a real run with two simulated robots, as a person uses it (see `trial`)."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median, quantiles

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserContext, Page, expect

from benchmarks.robot_reaction import configuration
from benchmarks.robot_rig import Rig
from benchmarks.waiting import wait_until
from tests.page.rig import Run, at_rest, chromium, context, running

pytestmark = pytest.mark.timeout(420)
CLICKS, AT_ONCE, STOP_BAR_MS = 50, 10, 150.0
expect.set_options(timeout=20_000)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    with running(tmp_path_factory.mktemp("page") / "run", episodes=8) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


class Watched:
    """A page, all whose requests and complaints are noted."""

    def __init__(self, window: BrowserContext, address: str) -> None:
        self.requests: list[str] = []
        self.errors: list[str] = []
        self.page: Page = window.new_page()
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", self._told)
        self.page.goto(address)
        expect(self.page.locator("#numbers dd").first).not_to_have_text("–")

    def _told(self, message: object) -> None:
        kind, text = message.type, message.text  # type: ignore[attr-defined]
        if (
            kind in ("error", "warning")
            and "ERR_CONNECTION" not in text
            and "WebSocket" not in text
        ):
            self.errors.append(text)

    def fine(self, address: str) -> None:
        """Nothing went elsewhere, and nothing was complained of."""
        here = address.split("/#")[0]
        foreign = [url for url in self.requests if not url.replace("ws:", "http:").startswith(here)]
        assert foreign == []
        assert self.errors == []


@pytest.fixture
def seen(run: Run, browser: Browser) -> Iterator[Watched]:
    window = context(browser, 1280)
    watched = Watched(window, run.address)
    yield watched
    watched.fine(run.address)
    window.close()


def robots_are(page: Page, state: str) -> None:
    for name in ("robotino1", "second"):
        expect(page.locator(f"#robot-{name} > .hint")).to_contain_text(state)


def test_every_panel_has_real_values(seen: Watched, run: Run) -> None:
    page = seen.page
    robots_are(page, "in plus")
    for name in ("robotino1", "second"):
        expect(page.locator(f"#robot-{name} .chosen")).to_have_count(1)
        expect(page.locator(f"#robot-{name} > .hint")).to_contain_text("answered after")
    grey = "c => new Set(c.getContext('2d').getImageData(0, 0, 75, 50).data).size"
    assert page.locator("#robot-second > canvas").evaluate(grey) > 10
    for curve in ("fitness", "bumps", "laps", "loss", "threshold", "actions", "worlds"):
        expect(page.locator(f"#curve-{curve} span")).to_contain_text("—")
    drawn = "c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(v => v)"
    assert page.locator("#curve-fitness canvas").evaluate(drawn)
    assert page.locator("#map").evaluate(drawn)
    expect(page.locator("#map-text")).to_contain_text("second at")
    expect(page.locator("#services tr")).to_have_count(6)
    expect(page.locator("#services")).to_contain_text("0.1.0")
    expect(page.locator("#doing")).to_contain_text("Memory:")
    metrics = page.request.get(run.address.split("#")[0] + "metrics").text()
    assert 'corridor_robot_bumps{robot="second"}' in metrics
    assert "corridor_learner_train_steps" in metrics


def test_stop_clear_pause_and_resume_and_two_pages_agree(
    seen: Watched, run: Run, browser: Browser
) -> None:
    page, other = seen.page, Watched(context(browser, 390, "dark"), run.address).page
    for press in (
        lambda: page.get_by_role("button", name="Stop all robots").click(),
        lambda: page.locator("body").press("Escape"),
        lambda: page.locator("body").press(" "),
    ):
        press()
        robots_are(page, "estop")
        for shown in (page, other):
            expect(shown.locator("#stands")).to_contain_text("2 of 2")
            expect(shown.locator("#told li").first).to_contain_text("all stand")
        other.get_by_role("button", name="Clear the stop").click()
        robots_are(page, "in plus")
        expect(page.locator("#stands")).to_be_empty()
    page.get_by_role("button", name="Pause second").click()
    expect(other.locator("#robot-second > .hint")).to_contain_text("paused")
    expect(other.locator("#warnings")).to_contain_text("robot second: paused")
    other.get_by_role("button", name="Resume second").click()
    expect(page.locator("#robot-second > .hint")).not_to_contain_text("paused")
    other.close()


def test_worlds_boxes_and_notes(seen: Watched, run: Run) -> None:
    page = seen.page
    page.get_by_text("Change the world").click()
    form = page.locator("#change")
    form.locator("[name=robot]").select_option("second")
    for name, value in (("x", "4.84"), ("y", "3.04"), ("side", "0.1")):
        form.locator(f"[name={name}]").fill(value)
    page.get_by_role("button", name="Place").click()
    expect(page.locator("#told li").first).to_contain_text("place box1, second: second: world plus")
    page.get_by_role("button", name="Remove").click()
    expect(page.locator("#told li").first).to_contain_text("remove box1")
    page.locator("#edit").check()
    size = page.locator("#map").bounding_box()
    assert size is not None
    page.locator("#map").click(position={"x": size["width"] / 2, "y": size["height"] / 2})
    expect(page.locator("#told li").first).to_contain_text(re.compile("place box[12], second"))
    page.locator("#edit").uncheck()
    form.locator("[name=world]").select_option("minus")
    page.get_by_role("button", name="Switch").click()
    expect(page.locator("#robot-second > .hint")).to_contain_text("in minus")
    expect(page.locator("#map-text")).to_contain_text("World minus")
    page.locator("#note input").fill("it <b>circles</b>")
    page.get_by_role("button", name="Keep").click()
    expect(page.locator("#notes")).to_contain_text("it <b>circles</b>")
    (note,) = map(json.loads, (run.folder / "notes.jsonl").read_text().splitlines())
    assert (note["text"], note["episode"] > 0) == ("it <b>circles</b>", True)


def look_through_the_memory(page: Page) -> None:
    page.get_by_role("button", name="Memory").click()
    expect(page.locator("#counts")).to_contain_text("of 300 samples")
    expect(page.locator("#wall button")).to_have_count(48)
    page.locator("[name=action]").select_option("1")
    expect(page.locator("#found")).to_contain_text("forward 0, left ")
    expect(page.locator("#wall button").first).to_contain_text("left")
    page.get_by_role("button", name="Older").click()
    expect(page.locator("#found")).to_contain_text("Page 2")
    page.locator("#wall button").last.click()
    expect(page.locator("#sample")).to_contain_text("as observed")
    expect(page.locator("#sample")).to_contain_text("Predicted by the network of episode")
    expect(page.locator("#sample .bits120 i")).to_have_count(120)
    expect(page.locator("#sample .wall button").first).to_contain_text(" bit")
    page.locator("#bits").fill("24")
    page.locator("#bits").dispatch_event("change")
    expect(page.locator("#found")).to_contain_text("would be marked")
    expect(page.locator("#gone")).to_contain_text("samples went")
    expect(page.locator("#pairs .pair").first).to_contain_text(" bit")


def test_the_memory_of_a_run_that_goes_on(seen: Watched) -> None:
    page = seen.page
    page.get_by_role("button", name="Pause all").click()  # a memory that stands still is compared
    robots_are(page, "paused")
    try:
        look_through_the_memory(page)
    finally:
        page.get_by_role("button", name="Run", exact=True).click()
        page.get_by_role("button", name="Resume all").click()
    robots_are(page, "actor")


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(width: int, scheme: str, run: Run, browser: Browser) -> None:
    window = context(browser, width, scheme)
    page = Watched(window, run.address).page
    expect(page.locator("#curve-fitness")).to_be_visible()
    for view in ("Run", "Memory"):
        page.get_by_role("button", name=view, exact=True).click()
        if view == "Memory":
            expect(page.locator("#wall button")).to_have_count(48)
            page.locator("#wall button").first.click()
            expect(page.locator("#sample")).to_contain_text("as observed")
        wide = page.evaluate("document.documentElement.scrollWidth - innerWidth")
        assert wide <= 0, f"{view} is {wide} pixels too wide"
        found = Axe().run(page).response["violations"]
        serious = [v for v in found if v["impact"] in ("serious", "critical")]
        told = [(v["id"], [n["html"][:120] for n in v["nodes"][:3]]) for v in serious]
        assert told == [], view
    window.close()


def test_without_the_token_it_shows_and_commands_nothing(run: Run, browser: Browser) -> None:
    window = context(browser, 1280)
    page = Watched(window, run.address.split("#")[0]).page
    page.get_by_role("button", name="Stop all robots").click()
    expect(page.locator("#alert")).to_contain_text("no valid token")
    window.close()


def clicks_until_zeros_ms(browser: Browser, folder: Path, count: int) -> list[float]:
    """Milliseconds from clicks on stop until zero velocity is at an emulated Robotino."""
    found = []
    with Rig(configuration(), folder) as rig:
        rig.start("router", "driver", "actor")
        run = ("--run", rig.config.run.name, "--endpoint", rig.config.bus.endpoint)
        address = rig._first_line("page", "page", "--run-dir", str(folder), *run)
        window = context(browser, 1280)
        page = window.new_page()
        page.goto(address)
        page.evaluate("addEventListener('pointerdown', () => { window.at_ms = Date.now(); }, true)")
        expect(page.locator(".robot .chosen")).to_have_count(1)
        for _ in range(count):
            rig.wait_driving()
            page.locator("#stop").click()
            clicked_s = page.evaluate("window.at_ms") / 1e3 - (time.time() - time.monotonic())
            found.append(1e3 * rig.first_stop_s(clicked_s))
            expect(page.locator("#stands")).to_contain_text("1 of 1")
            page.get_by_role("button", name="Clear the stop").click()
        window.close()
    return found


def test_zeros_leave_soon_after_a_click_on_stop(browser: Browser, tmp_path: Path) -> None:
    """Now and then from the start, before the robot gets stuck somewhere."""
    rounds = (
        clicks_until_zeros_ms(browser, tmp_path / str(n), AT_ONCE) for n in range(CLICKS // AT_ONCE)
    )
    times_ms = [each for some in rounds for each in some]
    p95 = quantiles(times_ms, n=20)[-1]
    print(
        f"\nstop: {CLICKS} clicks, zeros at the robot after {p95:.0f} ms (p95), "
        f"{median(times_ms):.0f} ms (median), {max(times_ms):.0f} ms at most"
    )
    assert p95 <= STOP_BAR_MS


def test_a_person_drives_a_robot_and_gives_it_back(seen: Watched) -> None:
    page, wheel = seen.page, seen.page.locator("#wheel-robotino1")
    wheel.locator("summary").click()
    wheel.get_by_role("button", name="Take over").click()
    status = wheel.get_by_role("status")
    expect(status).to_contain_text("A person drives it")
    page.keyboard.down("a")
    expect(status).to_contain_text("actions by persons")
    expect(page.locator("#robot-robotino1 .chosen")).to_contain_text("by a person")
    page.keyboard.up("a")
    wheel.get_by_role("button", name="Hold to drive robotino1 forward").hover()
    page.mouse.down()
    expect(page.locator("#robot-robotino1 .chosen")).to_contain_text("forward")
    page.mouse.up()
    wheel.get_by_role("button", name="Give back").click()
    expect(status).not_to_contain_text("A person drives it")
    expect(page.locator("#robot-robotino1 .chosen")).not_to_contain_text("by a person")


@pytest.mark.parametrize("killed", ["page", "router"])
def test_it_says_what_is_gone_and_comes_back(killed: str, seen: Watched, run: Run) -> None:
    page, before = seen.page, run.pid(killed)
    run.kill(killed)
    alert = page.locator("#alert")
    expect(alert).to_contain_text(
        "page process" if killed == "page" else "No router", timeout=15_000
    )
    expect(page.locator("body")).to_have_class("lost")
    if killed == "page":
        page.locator("#stop").click()
        expect(alert).to_contain_text("NOT sent")
    wait_until(lambda: run.pid(killed) != before, 30.0, f"another {killed}")
    expect(alert).to_be_hidden(timeout=60_000)
    robots_are(page, "actor")
    shown = page.locator("#numbers dd").nth(4)
    before_text = shown.inner_text()
    wait_until(lambda: shown.inner_text() != before_text, 60.0, "more actions")


def test_a_run_that_is_over_is_shown_from_its_folder(
    run: Run, browser: Browser, tmp_path: Path
) -> None:
    copy = tmp_path / "over"
    shutil.copytree(run.folder, copy, ignore=shutil.ignore_patterns("lock", "endpoint", "page"))
    with at_rest(copy) as address:
        window = context(browser, 1280)
        page = window.new_page()
        page.goto(address)
        expect(page.locator("#curve-fitness")).to_be_visible()
        look_through_the_memory(page)
        window.close()
