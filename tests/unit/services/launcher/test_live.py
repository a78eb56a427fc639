"""From heartbeats to what a person reads, without a bus and without a clock."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import pytest
from fakes import message
from rich.console import Console, ConsoleDimensions
from rich.live import Live

from services.launcher.display import LINE_EVERY_S, Lines, Table, display_for
from services.launcher.live import RunView, duration, line, panel, warnings
from services.launcher.supervisor import ChildStatus
from services.monitor.heartbeats import Reader, Seen, Snapshot
from shared.keys import ACTOR_STATE, REPLAY_STATE, Stream
from shared.messages import ActorState, LearnerState, Message, ReplayState, RobotState, Told

REPLAY = message(
    ReplayState, episode=137, size=4321, capacity=6000, by_action=(2000, 1200, 1121),
    retention=(Told(name="threshold_percent", value=1),),
    fitness_mean_100=38.25, bumps=120, laps_left=3, laps_right=2, actions=12345,
)  # fmt: skip
LEARNER = message(
    LearnerState, episode=136, weights_version=42, activity="fitting", fit_epoch=2,
    fit_batch=45, fit_batches=180, loss=0.01234, train_steps=540, fits=2,
)  # fmt: skip
ACTOR = message(ActorState, robot="r1", phase="driving", step=17, actions_per_s=21.34)
ROBOT = message(RobotState, robot="r1", state="driving", world="minus")


def view(**given: Any) -> RunView:
    fields: dict[str, Any] = {"run": "demo", "endpoint": "tcp/127.0.0.1:1", "uptime_s": 3725.0}
    snapshot = {name: given.pop(name) for name in Snapshot.__annotations__ if name in given}
    return RunView(**{**fields, **given}, snapshot=Snapshot(**snapshot))


def full(**given: Any) -> RunView:
    seen = {
        "replay": Seen(REPLAY, 0.1),
        "learner": Seen(LEARNER, 0.1),
        "actors": {"r1": Seen(ACTOR, 0.1)},
        "robots": {"r1": Seen(ROBOT, 0.1)},
    }
    return view(**{**seen, **given})


def text(view: RunView, width: int = 110) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    with console.capture() as capture:
        console.print(panel(view))
    return capture.get()


def test_the_line_tells_everything() -> None:
    parts = line(full()).split(" | ")
    assert parts == [
        "1:02:05",
        "episode 137",
        "fitness 38.2",
        "bumps 120",
        "laps 3 left 2 right",
        "memory 4321/6000 (forward 2000  left 1200  right 1121)",
        "retention threshold percent 1",
        "21.3 steps/s",
        "weights 42",
        "learner fitting, epoch 2, 25 %",
    ]


def test_the_panel_tells_everything() -> None:
    shown = text(full(episodes_wanted=200))
    for part in (
        "run demo", "1:02:05", "137 of 200", "fitness 38.2", "120", "laps 3 left, 2 right",
        "12345", "21.3 per second", "4321 of 6000", "forward 2000  left 1200  right 1121",
        "threshold percent 1", "weights version 42", "540 training steps", "2 fitting phases",
        "loss 0.01234", "fitting, epoch 2, 25 %", "robot r1", "driving in minus", "step 17",
        "Ctrl-C",
    ):  # fmt: skip
        assert part in shown, part
    assert "━" in shown  # the bars


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_the_panel_fits_any_terminal(width: int) -> None:
    assert all(len(row) <= width for row in text(full(), width).splitlines())


def test_before_anything_is_known() -> None:
    assert line(view()) == "1:02:05 | services are starting"
    children = (ChildStatus("replay", "running", 0, ""), ChildStatus("actor", "running", 0, ""))
    assert "replay, actor" in text(view(children=children))
    assert warnings(view(children=children)) == []


def test_filling_shows_its_progress() -> None:
    filling = message(ReplayState, filling=True, size=600, capacity=6000)
    shown = full(replay=Seen(filling, 0.0))
    assert "filling, 10 %" in line(shown)
    assert "fitness -" in line(shown)
    assert "retention -" in line(shown)
    assert "filling, 10 %" in text(shown)


def test_work_on_the_whole_memory_shows_its_progress() -> None:
    busy = message(ReplayState, activity="equalising", progress=0.5, capacity=6000)
    assert "equalising, 50 %" in text(full(replay=Seen(busy, 0.0)))


def test_a_learner_that_is_not_fitting_has_no_bar_of_its_own() -> None:
    training = message(LearnerState, activity="training", episode=7)
    shown = text(full(learner=Seen(training, 0.0)))
    assert "training" in shown
    assert "episode 7 done" in shown
    assert "loss" not in shown


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"robots": {"r1": Seen(message(RobotState, state="estop"), 0.0)}},
         "robot r1: emergency stop, release it by `corridor clear`"),
        ({"robots": {"r1": Seen(message(RobotState, state="paused"), 0.0)}},
         "robot r1: paused, let it go on by `corridor resume`"),
        ({"commanded": {"r1"}, "actors": {"r1": Seen(ACTOR, 60.0)}},
         "robot r1: the actor gave way to `corridor drive` or another commander"),
        ({"children": [ChildStatus("actor", "restarting", 1, "signal SIGKILL")]},
         "actor is being restarted after signal SIGKILL"),
        ({"children": [ChildStatus("actor", "running", 1, "exit code 1: E: x", 59.0)]},
         "actor was restarted once, last after exit code 1: E: x"),
        ({"children": [ChildStatus("actor", "running", 3, "exit code 1", 61.0)]},
         "actor was restarted 3 times"),
        ({"children": [ChildStatus("actor", "stopped", 0, "")]}, "actor has stopped"),
        ({"learner": Seen(LEARNER, 3.1)}, "learner: silent for 3 s"),
        ({"replay": Seen(message(ReplayState, undecodable=2), 0.0),
          "learner": Seen(message(LearnerState, undecodable=3), 0.0)},
         "5 messages could not be decoded"),
        ({"replay": Seen(message(ReplayState, refused=1), 0.0)}, "1 episodes were refused"),
    ],
)  # fmt: skip
def test_warnings(given: dict[str, Any], expected: str) -> None:
    given = {"robots": {"r1": Seen(ROBOT, 0.0)}, **given}
    assert warnings(view(**given)) == [expected]
    assert f"! {expected}" in line(view(**given))


def test_the_address_of_the_page_is_shown_from_the_first_second() -> None:
    there = "http://127.0.0.1:17011/#token"
    assert line(view(page=there)) == f"1:02:05 | page {there} | services are starting"
    assert there in text(view(page=there))
    assert "page" not in line(view())


def test_the_key_and_what_became_of_it_are_shown() -> None:
    told = "12:00:00 emergency stop sent; robots: r1 stands"
    assert "space" not in text(full())
    assert "space: emergency stop" in text(full(keys=True))
    assert told in text(full(told=told))
    assert told in line(full(told=told))


def test_a_slow_heartbeat_is_not_silence() -> None:
    assert warnings(view(learner=Seen(LEARNER, 25.0), heartbeat_s=10.0)) == []


def test_episodes_done_counts_what_the_learner_has_finished() -> None:
    assert Snapshot().episodes_done == 0
    assert full().snapshot.episodes_done == 136


@pytest.mark.parametrize(
    ("seconds", "expected"), [(0, "0:00:00"), (59.9, "0:00:59"), (3600, "1:00:00")]
)
def test_duration(seconds: float, expected: str) -> None:
    assert duration(seconds) == expected


class FakeInbox:
    """Messages by stream, each given once."""

    def __init__(self) -> None:
        self.subscribed: list[str] = []
        self.waiting: dict[str, list[tuple[str, Message]]] = {}

    def subscribe(self, stream: Stream, ident: str = "*") -> None:
        self.subscribed.append(stream.name)

    def take(self, stream: Stream, cls: type[Any]) -> list[tuple[str, Any]]:
        return self.waiting.pop(stream.name, [])


def test_the_reader_keeps_the_newest_and_its_age() -> None:
    now_s = 100.0
    inbox = FakeInbox()
    reader = Reader(inbox, clock=lambda: now_s)
    assert sorted(inbox.subscribed) == [
        "actor_state",
        "learner_state",
        "replay_state",
        "robot_state",
    ]
    inbox.waiting = {
        ACTOR_STATE.name: [("r2", ACTOR), ("r1", ACTOR)],
        REPLAY_STATE.name: [("main", REPLAY)],
    }
    reader.update()
    now_s = 102.0
    inbox.waiting = {ACTOR_STATE.name: [("r1", message(ActorState, actions_per_s=1.0))]}
    reader.update()
    snapshot = reader.snapshot()
    assert [(name, seen.age_s) for name, seen in snapshot.actors.items()] == [
        ("r1", 0.0),
        ("r2", 2.0),
    ]
    assert snapshot.replay == Seen(REPLAY, 2.0)
    assert snapshot.learner is None
    assert snapshot.actions_per_s == pytest.approx(22.34)


def shown_lines(views: Sequence[tuple[float, RunView]]) -> list[str]:
    """Output of the plain display for views shown at given times."""
    now_s = 0.0
    output = io.StringIO()
    display = Lines(output, clock=lambda: now_s)
    for now_s, each in views:  # noqa: B007 - read by the clock
        display.show(each)
    return output.getvalue().splitlines()


def test_plain_lines_come_now_and_then_and_at_once_with_news() -> None:
    restarting = full(children=[ChildStatus("actor", "restarting", 1, "exit code 1")])
    lines = shown_lines(
        [(0.0, full()), (1.0, full()), (2.0, restarting), (3.0, restarting),
         (2.1 + LINE_EVERY_S, restarting), (2.2 + LINE_EVERY_S, full(told="stop sent")),
         (2.3 + LINE_EVERY_S, full(told="stop sent", note="stopping"))]
    )  # fmt: skip
    assert len(lines) == 5
    assert "restarted" in lines[1]
    assert lines[-1].endswith("stopping")


def test_the_display_depends_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    with display_for(io.StringIO()) as display:
        assert isinstance(display, Lines)
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    with display_for(terminal) as display:
        assert isinstance(display, Table)
        display.show(full())
    assert "137" in terminal.getvalue()


def test_a_small_window_shows_what_is_urgent_first_and_texts_as_they_are() -> None:
    seen = full(told="all stand [/] [red]")
    console = Console(file=io.StringIO(), width=40, height=12, markup=False)
    with console.capture() as capture:
        console.print(panel(seen, small=True))
    lines = capture.get().splitlines()
    assert lines[0].startswith("all stand [/] [red]")
    assert "episode 137" in [text.strip() for text in lines]
    assert all(len(text) <= 40 for text in lines)


def test_the_view_follows_the_size_of_the_window() -> None:
    output = io.StringIO()
    console = Console(file=output, force_terminal=True, width=40, height=12)
    with Live(console=console, auto_refresh=False) as live:
        Table(live).show(full())
        assert "\u2502" not in output.getvalue()
        console.size = ConsoleDimensions(100, 40)
        Table(live).show(full())
    assert "\u2502" in output.getvalue()
