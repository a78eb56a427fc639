"""What is seen of one robot: its newest image and decision, its way, how soon it is answered.

No bus and no clock in here.
"""

import math
from base64 import b64encode
from collections import deque
from typing import Any

import numpy as np

from shared.messages import Action, Message, Observation

STEP_M, JUMP_M = 0.08, 0.6
"""Places of the trail lie at least so far apart; over a longer way it breaks off."""
TRAIL, BUMPS, DELAYS, WAITING = 400, 60, 500, 64
"""Places, bumps, delays and unanswered observations that are kept."""


class Track:
    """One robot as its observations and the answers to them show it."""

    def __init__(self) -> None:
        self.seen: Observation | None = None
        self.chosen: Action | None = None
        self.trail: deque[tuple[float, float] | None] = deque(maxlen=TRAIL)
        self.bumps: deque[tuple[float, float]] = deque(maxlen=BUMPS)
        self.delays_ms: deque[float] = deque(maxlen=DELAYS)
        """How long observations waited for their answers, as both arrived here."""
        self._waiting: dict[tuple[str, int, int], float] = {}

    def take(self, message: Message, at_s: float) -> None:
        """Take up what arrived at this time."""
        if isinstance(message, Observation):
            self.observe(message, at_s)
        elif isinstance(message, Action):
            self.act(message, at_s)

    def observe(self, seen: Observation, at_s: float) -> None:
        """Take up an observation that arrived at this time."""
        before, place = self.seen, (round(seen.x_m, 3), round(seen.y_m, 3))
        if before and before.world != seen.world:
            self.trail.clear()
            self.bumps.clear()
        last = (self.trail[-1] if self.trail else None) or place
        if seen.bump and not (before and before.sequence == seen.sequence):
            self.bumps.append(last)
        if math.dist(last, place) >= JUMP_M:
            self.trail.append(None)
        if not self.trail or math.dist(last, place) >= STEP_M:
            self.trail.append(place)
        self.seen = seen
        self._waiting.setdefault((seen.life, seen.sequence, seen.attempt), at_s)
        while len(self._waiting) > WAITING:
            del self._waiting[next(iter(self._waiting))]

    def act(self, chosen: Action, at_s: float) -> None:
        """Take up the answer to an observation."""
        self.chosen = chosen
        asked = self._waiting.pop((chosen.robot_life, chosen.sequence, chosen.attempt), None)
        if asked is not None:
            self.delays_ms.append(max(0.0, 1e3 * (at_s - asked)))

    def latency_ms(self) -> tuple[float, ...]:
        """Median and 95th percentile of the newest delays; empty without any."""
        if not self.delays_ms:
            return ()
        return tuple(round(float(q), 2) for q in np.percentile(self.delays_ms, [50, 95]))

    def shown(self) -> dict[str, Any]:
        """What the page paints of it, ready for JSON."""
        told: dict[str, Any] = {"latency_ms": self.latency_ms()}
        if self.seen:
            seen = self.seen
            told |= {"image": b64encode(seen.image).decode(), "world": seen.world}
            told["pose"] = [seen.x_m, seen.y_m, seen.heading_rad]
        if self.chosen:
            told |= self.chosen.model_dump(include={"values", "action", "by", "episode"})
        return told
