"""One turn in the order of E25, as far as it concerns the memory.

append -> discard -> equalise -> (the learner:) train or fit -> target rule -> checkpoint ->
publish. The replay service and the single-process loop both call these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from shared.facts import IMAGE_SHAPE
from shared.rl.engine import Progress
from shared.rl.equalisation import due, equalised
from shared.rl.memory import SAMPLE, Images, ReplayMemory
from shared.rl.predictor import Predictor
from shared.rl.retention.strategy import Discard, Situation, beyond, discard

if TYPE_CHECKING:
    from shared.config import MemoryConfig
    from shared.messages import Episode


@dataclass(frozen=True)
class Maintenance:
    """What maintaining the memory after one submission did."""

    discarded: Discard
    equalised: bool


def sample_rows(
    memory: ReplayMemory, episode: Episode, first_id: int, commit: int, number: int
) -> tuple[np.ndarray, Images]:
    """An episode's samples as rows and images for `ReplayMemory.append`.

    first_id: insertion number of the first sample; commit: number of the submission; number: the
    global episode number e, 0 while the memory is filled.
    """
    n = episode.count
    rows = np.zeros(n, SAMPLE)
    rows["id"] = np.arange(first_id, first_id + n)
    rows["action"] = np.frombuffer(episode.sample_actions, np.uint8)
    rows["reward"] = np.frombuffer(episode.sample_rewards, "<f4")
    rows["commit"], rows["episode"] = commit, number
    rows["robot_episode"] = np.frombuffer(episode.sample_episodes, "<u4")
    rows["step"] = np.frombuffer(episode.sample_steps, "<u4")
    rows["version"] = np.frombuffer(episode.sample_versions, "<u4")
    worlds = memory.world_indices(episode.worlds)
    rows["world"] = worlds[np.frombuffer(episode.sample_worlds, np.uint8)]
    places = np.frombuffer(episode.positions, "<f4").reshape(n, 3)
    rows["x_m"], rows["y_m"], rows["heading_rad"] = places.T
    return rows, np.frombuffer(episode.images, np.uint8).reshape(n, *IMAGE_SHAPE)


def maintain(
    memory: ReplayMemory,
    number: int,
    config: MemoryConfig,
    predictor: Predictor,
    *,
    describing: Progress | None = None,
    equalising: Progress | None = None,
) -> Maintenance:
    """Discard and, when due at episode `number`, equalise after it. `memory` is changed."""
    discarded = discard(Situation(memory, number, config, predictor, describing))
    refresh = due(number, config.equalise_every) and len(memory) > 0
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
