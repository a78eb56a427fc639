"""What a run counts beside its loop, and what it tells of itself while it goes on."""

from dataclasses import dataclass, field
from typing import Any

from experiments.plans.plan import Unit
from experiments.single_process import SingleProcess, TurnDone
from services.replay.numbering import bump_free


@dataclass
class Totals:
    """The counts of a run. They are saved with each snapshot."""

    seconds: float = 0.0
    """Wall time of driving and learning, evaluations not counted."""
    evaluated_at: int = -1
    """Actions at the last evaluation on the way."""
    lap_checked_at: int = -1
    first_lap: dict[str, float] = field(default_factory=dict)
    run_actions: int = 0
    """Actions since the newest bump or interruption, in this run."""
    longest_run: int = 0
    """Most actions without a bump, in this run (E10, E43)."""
    prefill: str = ""
    """Hash of the memory as the first episode began: equal for all that shared it."""
    one_action_episodes: int = 0
    """Counted episodes of this run that lasted a single action (E11)."""
    stages: list[dict[str, Any]] = field(default_factory=list)
    stage: int = 0
    """Which stage of the plan goes on; their number at the end."""
    changes: int = 0
    """Changes of the world in this stage that the driver has been told of."""
    episodes_before: int = 0
    """Counted episodes before the plan began."""
    actions_before: int = 0

    def count(self, done: TurnDone) -> bool:
        """Count a turn; whether a counted episode made the longest run without a bump longer."""
        self.run_actions, length = bump_free(self.run_actions, done.submitted)
        if not done.commit.episode:
            return False
        self.one_action_episodes += done.submitted.actions == 1
        longer = length > self.longest_run
        self.longest_run = max(length, self.longest_run)
        return longer

    def done(self, loop: SingleProcess, unit: Unit) -> int:
        """Episodes or actions since the plan began."""
        if unit == "episodes":
            return loop.counters.episode - self.episodes_before
        return loop.counters.actions - self.actions_before

    def begin_stage(self, name: str, world: str, loop: SingleProcess) -> None:
        """Note where a stage begins."""
        self.changes = 0
        self.stages.append(
            {
                "name": name,
                "world": world,
                "first_episode": loop.counters.episode + 1,
                "first_action": loop.counters.actions,
                "first_train_step": loop.trainer.train_steps,
                "first_second": self.seconds,
            }
        )

    def end_stage(self, loop: SingleProcess) -> None:
        """Say how much the newest stage was."""
        entry = self.stages[-1]
        entry["last_episode"] = loop.counters.episode
        entry["actions"] = loop.counters.actions - entry.pop("first_action")
        entry["train_steps"] = loop.trainer.train_steps - entry.pop("first_train_step")
        entry["seconds"] = round(self.seconds - entry.pop("first_second"), 1)

    def note_lap(self, loop: SingleProcess) -> None:
        """Note when the network first drove a lap."""
        self.first_lap = {
            "seconds": round(self.seconds, 1),
            "actions": loop.actor.actions,
            "episode": loop.counters.episode,
            "train_steps": loop.trainer.train_steps,
        }


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    run: str
    done: int
    of: int
    unit: Unit
    fitness: float
    """Mean over the last episodes."""


class Watch:
    """Sees every turn of a run. This one does nothing about it."""

    def begin(self, loop: SingleProcess) -> None:
        """The run begins, or goes on from its last snapshot."""

    def turn(self, loop: SingleProcess, done: TurnDone) -> None:
        """A turn is over. The run may be stopped, and done again from an older snapshot."""
