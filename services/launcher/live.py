"""What a person sees while a run is up: pure functions from a view to text or a live table."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from services.launcher.supervisor import ChildStatus
from services.monitor.heartbeats import Snapshot
from services.monitor.words import (
    by_action,
    duration,
    fill_share,
    fit_share,
    fitness,
    learner_doing,
    replay_doing,
    retention,
)
from shared.messages import ActorState, LearnerState, ReplayState, RobotState

BAR_WIDTH = 30
RECENT_S = 60.0
"""A crash longer ago is mentioned, but no longer explained."""

PERSON_SILENT_S = 3.0
"""A person who took a robot over and says nothing for longer is gone."""


@dataclass(frozen=True)
class RunView:
    """Everything the display shows."""

    run: str
    endpoint: str
    uptime_s: float
    snapshot: Snapshot
    children: Sequence[ChildStatus] = ()
    episodes_wanted: int = 0
    """0: no end in sight."""
    heartbeat_s: float = 1.0
    page: str = ""
    """Where the web page of the run is, or why there is none."""
    note: str = ""
    """What the whole run does, such as "stopping"; empty while it drives."""
    told: str = ""
    """What became of the last order given by a key."""
    keys: bool = False
    """Whether keys are read."""
    commanded: Collection[str] = ()
    """Robots that somebody else than the run's actor commands."""


# ---------------------------------------------------------------- words


def episodes(view: RunView) -> str:
    """Episodes stored, and how many are wanted."""
    replay = view.snapshot.replay
    count = str(replay.message.episode) if replay else "-"
    return f"{count} of {view.episodes_wanted}" if view.episodes_wanted else count


def warnings(view: RunView) -> list[str]:
    """What is not as it should be, most urgent first."""
    return [*_robot_warnings(view), *_child_warnings(view), *_silences(view), *_losses(view)]


def _robot_warnings(view: RunView) -> Iterator[str]:
    for name, seen in view.snapshot.robots.items():
        if name in view.commanded:
            yield f"robot {name}: the actor gave way to `corridor drive` or another commander"
        if seen.message.state == "estop":
            yield f"robot {name}: emergency stop, release it by `corridor clear`"
        elif seen.message.state == "paused":
            yield f"robot {name}: paused, let it go on by `corridor resume`"
        if seen.message.reason:
            yield f"robot {name}: stands still: {seen.message.reason}"
    for name, told in view.snapshot.actors.items():
        if told.message.taken_over and told.message.person_silent_s > PERSON_SILENT_S:
            yield f"robot {name}: stands until it is given back: `corridor takeover`, then q"


def _child_warnings(view: RunView) -> Iterator[str]:
    for child in view.children:
        if child.state == "restarting":
            yield f"{child.name} is being restarted after {child.note}"
        elif child.state == "stopped":
            yield f"{child.name} has stopped"
        elif child.restarts:
            times = "once" if child.restarts == 1 else f"{child.restarts} times"
            why = f", last after {child.note}" if child.up_s < RECENT_S else ""
            yield f"{child.name} was restarted {times}{why}"


def _silences(view: RunView) -> Iterator[str]:
    for name, seen in view.snapshot.everybody.items():
        gave_way = name.removeprefix("actor of ") in view.commanded
        if seen.age_s > 3 * view.heartbeat_s and not gave_way:
            yield f"{name}: silent for {seen.age_s:.0f} s"


def _losses(view: RunView) -> Iterator[str]:
    snapshot = view.snapshot
    undecodable = sum(seen.message.undecodable for seen in snapshot.everybody.values())
    if undecodable:
        yield f"{undecodable} messages could not be decoded"
    if snapshot.replay and snapshot.replay.message.refused:
        yield f"{snapshot.replay.message.refused} episodes were refused"


# ---------------------------------------------------------------- one line


def line(view: RunView) -> str:
    """Everything in one line, for logs and pipes."""
    return " | ".join([*_parts(view), *_news(view)])


def _news(view: RunView) -> list[str]:
    """What is wrong, and what was done last."""
    warned = [f"! {text}" for text in warnings(view)]
    return [*warned, *(text for text in (view.told, view.note) if text)]


def _parts(view: RunView) -> list[str]:
    snapshot = view.snapshot
    parts = [duration(view.uptime_s), *([f"page {view.page}"] if view.page else [])]
    if snapshot.replay is None and snapshot.learner is None:
        parts.append("services are starting")
    if snapshot.replay is not None:
        replay = snapshot.replay.message
        parts += [
            f"episode {episodes(view)}",
            f"fitness {fitness(replay)}",
            f"bumps {replay.bumps}",
            f"laps {replay.laps_left} left {replay.laps_right} right",
            f"memory {replay.size}/{replay.capacity} ({by_action(replay.by_action)})",
            f"retention {retention(replay)}",
        ]
        if replay.filling:
            parts.append(replay_doing(replay))
    if snapshot.actors:
        parts.append(f"{snapshot.actions_per_s:.1f} steps/s")
    if snapshot.learner is not None:
        learner = snapshot.learner.message
        parts += [f"weights {learner.weights_version}", f"learner {learner_doing(learner)}"]
    return parts


# ---------------------------------------------------------------- live table


def panel(view: RunView, *, small: bool = False) -> RenderableType:
    """The whole live view; small: for a window that would cut it off, what is urgent first."""
    if small:
        return Text("\n".join([*_news(view), *_parts(view)]))
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    table.add_column()
    for row in _rows(view):
        table.add_row(*row)
    problems = [Text(f"! {text}", style="yellow") for text in warnings(view)]
    if view.told:
        problems.append(Text(view.told, style="bold red"))
    title = f"run {view.run}   {duration(view.uptime_s)}"
    key = "space: emergency stop; " if view.keys else ""
    foot = view.note or f"{key}Ctrl-C stops; the same command continues"
    return Panel(Group(table, *problems), title=title, subtitle=foot, title_align="left")


def _rows(view: RunView) -> Iterator[tuple[RenderableType, ...]]:
    snapshot = view.snapshot
    if view.page:
        yield "page", Text(view.page, overflow="fold"), ""
    if snapshot.replay is None and snapshot.learner is None:
        yield "starting", ", ".join(child.name for child in view.children), ""
    if snapshot.replay is not None:
        yield from _learning_rows(view, snapshot.replay.message)
        yield from _memory_rows(snapshot.replay.message)
    if snapshot.learner is not None:
        yield from _learner_rows(snapshot.learner.message)
    for name in sorted({*snapshot.robots, *snapshot.actors}):
        robot, actor = snapshot.robots.get(name), snapshot.actors.get(name)
        yield _robot_row(name, robot.message if robot else None, actor.message if actor else None)


def _learning_rows(view: RunView, replay: ReplayState) -> Iterator[tuple[RenderableType, ...]]:
    yield "episodes", episodes(view), f"fitness {fitness(replay)} (mean of the last 100)"
    laps = f"laps {replay.laps_left} left, {replay.laps_right} right"
    yield "bumps", str(replay.bumps), laps
    rate = f"{view.snapshot.actions_per_s:.1f} per second"
    yield "steps", str(replay.actions), rate


def _memory_rows(replay: ReplayState) -> Iterator[tuple[RenderableType, ...]]:
    share = fill_share(replay)
    bar = ProgressBar(total=1.0, completed=share, width=BAR_WIDTH)
    yield "memory", bar, f"{replay.size} of {replay.capacity}, {replay_doing(replay)}"
    yield "  by action", by_action(replay.by_action), ""
    yield "  retention", retention(replay), ""


def _learner_rows(learner: LearnerState) -> Iterator[tuple[RenderableType, ...]]:
    loss = "" if learner.loss is None else f", loss {learner.loss:.5f}"
    yield (
        "network",
        f"weights version {learner.weights_version}",
        f"{learner.train_steps} training steps, {learner.fits} fitting phases{loss}",
    )
    if learner.activity == "fitting":
        bar = ProgressBar(total=1.0, completed=fit_share(learner), width=BAR_WIDTH)
        yield "learner", bar, learner_doing(learner)
    else:
        yield "learner", learner_doing(learner), f"episode {learner.episode} done"


def _robot_row(
    name: str, robot: RobotState | None, actor: ActorState | None
) -> tuple[RenderableType, ...]:
    state = f"{robot.state} in {robot.world}" if robot else "unknown"
    if actor is None:
        return f"robot {name}", state, "no actor yet"
    values = " ".join(f"{value:+.2f}" for value in actor.values)
    share = f", {actor.human_actions} of {actor.actions} by persons" if actor.human_actions else ""
    return f"robot {name}", state, f"actor {actor.phase}, step {actor.step}, Q {values}{share}"
