"""What one turn does to the memory, in the order of E25.

append -> discard -> equalise -> (the learner:) train or fit -> target rule -> checkpoint ->
publish. The replay service and the single-process loop both call these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared.columns import EPISODE
from shared.rl.memory import SAMPLE, Images, ReplayMemory, world_indices
from shared.rl.retention.strategy import Discard, Situation, beyond, discard
from shared.rl.reward import equalised
from shared.rl.schedule import Moment, due

if TYPE_CHECKING:
    from shared.config import MemoryConfig
    from shared.messages import Episode
    from shared.rl.engine import Progress
    from shared.rl.predictor import Predictor


@dataclass(frozen=True)
class Maintenance:
    """What maintaining the memory after one submission did."""

    discarded: Discard
    equalised: bool


@dataclass(frozen=True)
class Commit:
    """One accepted submission: its numbers and what of it is stored."""

    commit: int
    episode: int
    """Global episode number; 0 for fill submissions."""
    first_id: int
    stored: int


def sample_rows(episode: Episode, worlds: list[str], numbers: Commit) -> tuple[np.ndarray, Images]:
    """Return the stored samples of an episode as rows and images for a `ReplayMemory`.

    worlds: names that the rows' column points into; it grows as needed.
    """
    values = EPISODE.decode(episode)
    rows = np.zeros(episode.count, SAMPLE)
    rows["id"] = numbers.first_id + np.arange(episode.count)
    rows["action"], rows["reward"] = values["sample_actions"], values["sample_rewards"]
    rows["commit"], rows["episode"] = numbers.commit, numbers.episode
    rows["robot_episode"], rows["step"] = values["sample_episodes"], values["sample_steps"]
    rows["version"], rows["by"] = values["sample_versions"], values["sample_by"]
    rows["world"] = world_indices(worlds, episode.worlds)[values["sample_worlds"]]
    rows["x_m"], rows["y_m"], rows["heading_rad"] = values["positions"].T
    return rows[: numbers.stored], values["images"][: numbers.stored]


def maintain(
    memory: ReplayMemory,
    now: Moment,
    config: MemoryConfig,
    predictor: Predictor,
    seed: int,
    *,
    describing: Progress | None = None,
    equalising: Progress | None = None,
) -> Maintenance:
    """Discard and, when due, equalise after it. `memory` is changed; `seed` is that of the run."""
    discarded = discard(Situation(memory, now.episode, config, predictor, seed, describing))
    refresh = due(now, config.equalise_every, config.equalise_every_actions) and len(memory) > 0
    if refresh:
        values = _current_values(memory, predictor, equalising)
        memory.rows["reward"] = equalised(memory.rows["reward"], values, config)
    return Maintenance(discarded, refresh)


def _current_values(
    memory: ReplayMemory, predictor: Predictor, progress: Progress | None
) -> npt.NDArray[np.float32]:
    """Return Q of each stored image and its action under the current weights: float32 [n]."""
    values = np.empty(len(memory), np.float32)
    for some, images in memory.parts(np.arange(len(memory))):
        report = beyond(int(some[0]), len(memory), progress)
        values[some] = predictor.values(images, memory.rows["action"][some], report)
    return values
