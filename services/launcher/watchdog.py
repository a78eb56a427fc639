"""Which child hangs: its process is there, but gives no sign of life. Without a clock or a bus.

Heartbeats come from the threads that work, so silence shows a process that hangs and a thread that
hangs; the answer to a ping, from a thread of its own, would show less. Only replay sends them from
another thread than its turns: there a pass over the memory must make progress, too. Work of replay
that has no progress to tell, such as the search for candidates, is not judged.

Silence is time in which we looked and the router was there: without a router nobody is heard, and
after a pause of this process nobody was. The router hangs when it answers nobody.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from services.launcher.supervisor import ChildStatus
from services.launcher.watcher import Sight
from services.monitor.health import OBSERVING
from services.processes import ACTOR, BY_NAME, DRIVER, LEARNER, REPLAY, ROUTER
from shared.config import Config
from shared.messages import Message, ReplayState

START_TIMES = 10
"""As many times `bus.hang_s` may a child be silent that was not heard since its start, and a pass
of replay stand still."""
LONGEST_LOOK_S = 2.0
"""Time between two looks counts up to this."""


@dataclass
class _Heard:
    """One process, as far as it was heard."""

    restarts: int
    life: str = ""
    """The life of the process before; what still comes of it does not count."""
    sign: object = None
    appeared: bool = False
    silent_s: float = 0.0
    progress: tuple[int, float] = (0, 1.0)
    """How far replay has come in a pass over its memory, and after which change."""
    still_s: float = 0.0
    given_up: bool = False


class Watchdog:
    """Looks at the children again and again."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._heard: dict[str, _Heard] = {}
        self._sight = Sight()
        self._looked_s = -math.inf

    def look(
        self, now_s: float, sight: Sight, children: Sequence[ChildStatus]
    ) -> tuple[str, str] | None:
        """Name of a child that hangs, and how we know; each process is named once.

        One at a time, in the order of starting: the others may only wait for it, and get new time.
        """
        if sight is self._sight or not self._config.bus.hang_s:
            return None
        passed_s = min(now_s - self._looked_s, LONGEST_LOOK_S)
        self._sight, self._looked_s = sight, now_s
        running = [c for c in children if c.name in BY_NAME and c.state == "running"]
        for child in running:
            self._listen(child, sight, passed_s)
        for child in running:
            if reason := self._reason(child.name):
                for heard in self._heard.values():
                    heard.silent_s = heard.still_s = 0.0
                self._heard[child.name].given_up = True
                return child.name, reason
        return None

    def _listen(self, child: ChildStatus, sight: Sight, passed_s: float) -> None:
        sign = self._sign(child.name, sight)
        heard = self._heard.setdefault(child.name, _Heard(child.restarts))
        if heard.restarts != child.restarts:
            heard = _Heard(child.restarts, getattr(heard.sign, "life", ""), heard.sign)
            self._heard[child.name] = heard
        late = bool(heard.life) and getattr(sign, "life", "") == heard.life
        if sign is not None and sign is not heard.sign and not late:
            heard.sign, heard.appeared, heard.silent_s = sign, True, 0.0
        elif self._expected(child.name, sight):
            heard.silent_s += passed_s
        else:
            heard.silent_s = 0.0
        if isinstance(sign, ReplayState):
            progress = (sign.change, sign.progress)
            stands = progress == heard.progress and sign.progress < 1.0
            heard.progress, heard.still_s = progress, heard.still_s + passed_s if stands else 0.0

    def _sign(self, name: str, sight: Sight) -> Sight | Message | None:
        """The newest sign of life: another object each time."""
        if name == ROUTER.name:
            return sight if sight.connected else None
        seen = sight.snapshot
        newest = {
            DRIVER.name: seen.robots.get(self._config.robot.id),
            ACTOR.name: min(seen.actors.values(), key=lambda actor: actor.age_s, default=None),
            REPLAY.name: seen.replay,
            LEARNER.name: seen.learner,
        }[name]
        return newest.message if newest else None

    def _expected(self, name: str, sight: Sight) -> bool:
        """Whether a child that is well would give a sign now."""
        robots = sight.snapshot.robots
        if name == ACTOR.name and robots and robots.keys() <= sight.commanded:
            return False  # it gave way
        if name == ACTOR.name and not self._heard[name].appeared:  # it needs a robot that observes
            fresh_s = 3 * self._config.bus.heartbeat_s
            seen = robots.values()
            return any(r.message.state in OBSERVING and r.age_s < fresh_s for r in seen)
        return sight.connected or name == ROUTER.name

    def _reason(self, name: str) -> str:
        heard, limit_s = self._heard[name], self._config.bus.hang_s
        if heard.given_up:
            return ""
        if heard.silent_s > limit_s * (BY_NAME[name].patience if heard.appeared else START_TIMES):
            what = "answer" if name == ROUTER.name else "heartbeat"
            return f"no {what} for {heard.silent_s:.0f} s"
        if heard.still_s > limit_s * START_TIMES:
            return f"no progress for {heard.still_s:.0f} s"
        return ""
