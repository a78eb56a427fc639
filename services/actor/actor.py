"""The actor of one robot: chooses actions, keeps the open episode, computes rewards.

No bus and no clock in here: the service and the single-process loop feed it observations.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from shared.columns import EPISODE
from shared.config import Config
from shared.facts import CHOOSERS, HUMAN, Chooser
from shared.messages import Action, Episode, Observation, RobotProgress, image_array
from shared.rl.episode import Ending, OpenEpisode, Release, Step, stale_steps, with_current_max_q
from shared.rl.policy import Values, decide
from shared.rl.predictor import Predictor
from shared.rl.reward import episode_rewards

KEPT = (
    *("foreign_actions", "actions", "human_actions", "dropped_samples", "dropped_episodes"),
    *("_unreported_samples", "_unreported_episodes", "_actions_before"),
)
"""Counters of an actor that outlive its process."""


class Actor:
    """Turns observations of one robot into actions and finished episodes.

    For every observation call `finish` first and, once what it returned is committed, `act`. The
    target network may change only between the two: all actions of an episode come from one.
    """

    def __init__(self, config: Config, robot: str, life: str, predictor: Predictor) -> None:
        self._config, self._robot = config, robot
        self.predictor = predictor
        """The target network that acts; replace it `at_boundary` only."""
        self.life = life
        self._lives = {life}
        """The own life, and those that it continues: their actions are its own."""
        self.foreign_actions = 0
        """Actions that the robot executed, but another actor had sent."""
        self.open = OpenEpisode(config.episode)
        self.progress: RobotProgress | None = None
        self.submissions = 0
        self.actions = 0
        self.human_actions = 0
        """Those that a person chose."""
        self.dropped_samples = 0
        self.dropped_episodes = 0
        self._unreported_samples = 0
        self._unreported_episodes = 0
        self._actions_before = 0
        self._laps_before = (0, 0)
        self.at_boundary = True
        """No action of the current episode was chosen yet: here weights may change."""
        self._expected: tuple[str, int] | None = None
        """Driver life and sequence of the observation that continues the open episode."""

    @property
    def filling(self) -> bool:
        """Whether actions gather samples for filling the memory (A13, E9)."""
        return self.progress is not None and self.progress.filling

    def configure(self, config: Config) -> None:
        """Go on with other settings of policy and memory. Call between episodes."""
        self._config = config

    def begin(self, progress: RobotProgress, observation: Observation) -> None:
        """Start with what replay has of this robot; count what an earlier actor process lost.

        The driver's numbering tells how many actions came after the newest stored sample. Steps
        that were restored go on, unless replay has got samples of the robot since.
        """
        self.progress = progress
        if self._expected is not None:
            if self._follows(progress, observation):
                return  # after a clean stop nothing is lost but what `finish` finds interrupted
            self.open, self._expected = OpenEpisode(self._config.episode), None
            self._actions_before, self.at_boundary = self.actions, True
        self._laps_before = (observation.laps_left, observation.laps_right)
        if progress.robot_life in ("", observation.life, *observation.earlier):
            lost = observation.sequence - (progress.last_sequence + 1)
            self._drop(samples=lost, episodes=int(lost > 0))
        else:  # what the driver's earlier life executed unstored cannot be known any more
            self._drop(samples=observation.sequence, episodes=1)

    def _follows(self, progress: RobotProgress, observation: Observation) -> bool:
        """Whether the open steps come after all that replay has of the robot."""
        assert self._expected is not None
        life, number = self._expected
        lives = ("", life, observation.life, *observation.earlier)
        first = self.open.steps[0].sequence if len(self.open) else number
        return progress.robot_life in lives and first > progress.last_sequence

    def finish(self, observation: Observation) -> Episode | None:
        """End the open episode if this observation ends it; return what is to be stored.

        A step whose action the robot did not carry out (a late answer, a contact or a halt first,
        or another actor's action in its place) is taken back first: it is neither an action nor a
        sample.
        """
        if self._expected is not None and self._expected[0] in observation.earlier:
            self._expected = (observation.life, self._expected[1])
        if len(self.open) and self._unexecuted(self.open.steps[-1], observation):
            self._take_back()
            self._expected = (observation.life, observation.sequence)
        elif len(self.open) and self._displaced(self.open.steps[-1], observation):
            self.foreign_actions += 1
            self._take_back()
            self._expected = (observation.life, -1)
        ending = self._ending(observation)
        if ending is None:
            return None
        release = self.open.end(ending)
        self.at_boundary = True
        if ending == "interrupted":
            self._drop(samples=release.dropped, episodes=int(release.count == 0))
        if release.count == 0:
            return None
        return self._submission(release, observation)

    def committed(self, progress: RobotProgress) -> None:
        """The last submission is on disk: continue from there."""
        self.progress = progress
        self._unreported_samples = self._unreported_episodes = 0

    def lose(self, episode: Episode, life: str) -> None:
        """The last submission was refused for good: count its samples, go on under another life."""
        self.progress = None
        self.life, self.submissions = life, 0
        self._lives.add(life)
        self._drop(samples=episode.count, episodes=1)

    def act(
        self, observation: Observation, values: Values | None = None, wish: int | None = None
    ) -> Action:
        """Choose an action with the current target network and append the step (A11, A26).

        values: its clipped Q of all actions for this observation, float32 [actions], where the
        caller has already asked for them. wish: the action that a person chose in its place.
        """
        assert self.progress is not None, "begin() comes first"
        if values is None:
            image = image_array(observation.image)
            values = self.predictor.all_values(image[np.newaxis])[0]
        progress, number = self.progress, len(self.open)
        episode = progress.robot_fills if progress.filling else progress.robot_episodes
        chosen: tuple[int, Chooser] | None = None if wish is None else (wish, "human")
        action, by = chosen or decide(
            self._config, self._robot, values, filling=self.filling, episode=episode, step=number
        )
        self._append(observation, action, float(values.max()), episode, CHOOSERS.index(by))
        self.actions += 1
        self.human_actions += by == "human"
        self.at_boundary = False
        self._expected = (observation.life, observation.sequence + 1)
        return Action(
            robot=self._robot,
            actor_life=self.life,
            robot_life=observation.life,
            sequence=observation.sequence,
            attempt=observation.attempt,
            action=action,
            by=by,
            values=tuple(map(float, values)),
            weights_version=self.predictor.version,
            episode=progress.robot_episodes,
            filling=progress.filling,
            fills=progress.robot_fills,
            step=number,
        )

    def _append(
        self, observation: Observation, action: int, max_q: float, episode: int, by: int
    ) -> None:
        """Add a step to the open episode (A11)."""
        version = self.predictor.version
        self.open.add(
            Step(
                image=observation.image,
                action=action,
                x_m=observation.x_m,
                y_m=observation.y_m,
                heading_rad=observation.heading_rad,
                world=observation.world,
                max_q=max_q,
                max_q_version=version,
                acted_version=version,
                number=len(self.open),
                robot_episode=episode,
                sequence=observation.sequence,
                by=by,
            )
        )

    def state(self) -> dict[str, Any]:
        """Everything a later process needs to continue exactly here, for msgpack."""
        return {
            "lives": sorted(self._lives),
            **{name: getattr(self, name) for name in KEPT},
            "laps_before": list(self._laps_before),
            "at_boundary": self.at_boundary,
            "expected": list(self._expected) if self._expected else None,
            "steps": [asdict(step) for step in self.open.steps],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state()`. Raises KeyError, TypeError or ValueError when it is damaged."""
        self._lives = {self.life, *map(str, state["lives"])}
        for name in KEPT:
            setattr(self, name, int(state[name]))
        left, right = state["laps_before"]
        self._laps_before = (int(left), int(right))
        self.at_boundary = bool(state["at_boundary"])
        expected = state["expected"]
        self._expected = (str(expected[0]), int(expected[1])) if expected else None
        self.open = OpenEpisode(
            self._config.episode, tuple(Step(**step) for step in state["steps"])
        )

    def _unexecuted(self, newest: Step, observation: Observation) -> bool:
        """Whether the driver waits, once more, for the action that this step had chosen."""
        place = (observation.life, observation.sequence + 1)
        return self._expected == place and newest.sequence == observation.sequence

    def _displaced(self, newest: Step, observation: Observation) -> bool:
        """Whether the robot executed something else in place of this step's action."""
        if self._expected != (observation.life, observation.sequence):
            return False  # it goes on elsewhere: that is an interruption, told by the numbers
        own = observation.action == newest.action and observation.actor_life in self._lives
        return not own

    def _ending(self, observation: Observation) -> Ending | None:
        """How this observation ends the open episode, if it does (A9, E6, E10, E11, E42)."""
        if not len(self.open):
            return None
        continues = self._expected == (observation.life, observation.sequence)
        if not continues:
            return "interrupted"
        if observation.bump and observation.interruption != "moved":  # a motion is no action
            return "bump"
        if observation.interruption:
            return "interrupted"
        return "full" if self.open.full else None

    def _take_back(self) -> None:
        """Forget the newest step: its action was not executed."""
        self.human_actions -= self.open.steps[-1].by == HUMAN
        self.actions -= 1
        self.open.retract()

    def _drop(self, *, samples: int, episodes: int) -> None:
        self.dropped_samples += max(samples, 0)
        self.dropped_episodes += episodes
        self._unreported_samples += max(samples, 0)
        self._unreported_episodes += episodes

    def _rewards(self, steps: Sequence[Step], count: int, bump: bool) -> npt.NDArray[np.float32]:
        """Rewards of the first `count` steps (Eq 3.1): float32 [count]."""
        ahead = [step.max_q for step in steps[1 : count + 1]]
        return episode_rewards(
            np.array([(step.x_m, step.y_m) for step in steps]),
            np.array(ahead + [0.0] * (count - len(ahead))),
            bump=bump,
            horizon=self._config.episode.horizon,
            max_distance_m=self._config.max_distance_m,
            config=self._config.reward,
        )

    def _submission(self, release: Release, observation: Observation) -> Episode | None:
        """What is to be stored; None where all of it is a person's and that is not to be kept."""
        version = self.predictor.version
        stale = stale_steps(release, version)
        steps = release.steps
        if len(stale):
            images = np.stack([image_array(steps[i].image) for i in stale])
            values = self.predictor.all_values(images)
            steps = with_current_max_q(steps, values, stale, version)
        bump = release.ending == "bump"
        rewards = self._rewards(steps, release.count, bump)
        released = steps[: release.count]
        keep_human = self._config.memory.keep_human
        keep = [i for i, step in enumerate(released) if keep_human or step.by != HUMAN]
        self._drop(samples=release.count - len(keep), episodes=int(not keep))
        if not keep:
            return None
        actions, self._actions_before = self.actions - self._actions_before, self.actions
        laps = (observation.laps_left, observation.laps_right)
        before, self._laps_before = self._laps_before, laps
        settled = steps if release.ending == "interrupted" else released
        number, self.submissions = self.submissions, self.submissions + 1
        return Episode(
            robot=self._robot,
            life=self.life,
            number=number,
            fill=self.filling,
            ended=release.ending,
            bump=bump,
            weights_version=version,
            fitness=release.fitness,
            actions=actions,
            dropped_samples=self._unreported_samples,
            dropped_episodes=self._unreported_episodes,
            robot_life=self._expected[0] if self._expected else observation.life,
            last_sequence=settled[-1].sequence,
            laps_left=max(laps[0] - before[0], 0),
            laps_right=max(laps[1] - before[1], 0),
            **_columns([released[i] for i in keep], rewards[keep]),
        )


def _columns(steps: Sequence[Step], rewards: npt.NDArray[np.float32]) -> dict[str, Any]:
    """The per-sample fields of an `Episode`, as bytes."""
    worlds = tuple(dict.fromkeys(step.world for step in steps))
    images = np.frombuffer(b"".join(step.image for step in steps), np.uint8)
    return {
        "worlds": worlds,
        **EPISODE.encode(
            {
                "images": images,
                "sample_actions": [step.action for step in steps],
                "sample_rewards": rewards,
                "sample_steps": [step.number for step in steps],
                "sample_episodes": [step.robot_episode for step in steps],
                "sample_versions": [step.acted_version for step in steps],
                "sample_worlds": [worlds.index(step.world) for step in steps],
                "sample_by": [step.by for step in steps],
                "positions": [(step.x_m, step.y_m, step.heading_rad) for step in steps],
            }
        ),
    }
