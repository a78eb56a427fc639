"""What services tell about themselves, as words: pure functions from heartbeats to text."""

from collections.abc import Sequence

from shared.facts import SHORT_NAMES
from shared.messages import LearnerState, ReplayState


def duration(seconds: float) -> str:
    """A time span as h:mm:ss."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def by_action(counts: Sequence[int]) -> str:
    """Counts by action, named."""
    return "  ".join(f"{name} {count}" for name, count in zip(SHORT_NAMES, counts, strict=True))


def fitness(replay: ReplayState) -> str:
    """Mean fitness of the last 100 episodes."""
    return f"{replay.fitness_mean_100:.1f}" if replay.episode else "-"


def learner_doing(learner: LearnerState) -> str:
    """What the learner is busy with."""
    if learner.activity != "fitting":
        return learner.activity
    share = 100 * fit_share(learner)
    return f"fitting, epoch {learner.fit_epoch}, {share:.0f} %"


def fit_share(learner: LearnerState) -> float:
    """Done part of the running fitting phase, 0 to 1."""
    return min(1.0, learner.fit_batch / learner.fit_batches) if learner.fit_batches else 0.0


def replay_doing(replay: ReplayState) -> str:
    """What the memory is busy with."""
    if replay.filling:
        return f"filling, {100 * fill_share(replay):.0f} %"
    busy = replay.activity in {"descriptors", "equalising", "discarding"}
    return f"{replay.activity}, {100 * replay.progress:.0f} %" if busy else replay.activity


def fill_share(replay: ReplayState) -> float:
    """Used part of the capacity, 0 to 1."""
    return min(1.0, replay.size / replay.capacity) if replay.capacity else 0.0


def retention(replay: ReplayState) -> str:
    """What the strategy of retention tells of itself; a dash while that is nothing."""
    told = (f"{each.name.replace('_', ' ')} {each.value}" for each in replay.retention)
    return "  ".join(told) or "-"
