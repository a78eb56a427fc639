"""Limits below everything else: whatever the network says, these hold (no bus, no clock)."""

import math
from dataclasses import dataclass

from services.robot_driver.robot import STANDSTILL, Velocity
from shared.config import RobotConfig


@dataclass
class Safety:
    """Clamps, deadman, pause and the latched emergency stop of one robot."""

    config: RobotConfig
    estop: bool = False
    """Latched: only an explicit `clear` releases it."""
    paused: bool = False
    clamped: int = 0
    deadman_stops: int = 0
    """How often a moving robot was stopped because no fresh action came."""
    _fresh_s: float = -math.inf

    @property
    def halted(self) -> bool:
        """Whether no action may be executed now."""
        return self.estop or self.paused

    def allow(self, wanted: Velocity, now_s: float) -> Velocity:
        """What may be driven from `now_s` on, cut to the limits and counted; halted: nothing."""
        parts = (wanted.forward_m_s, wanted.left_m_s, wanted.turn_rad_s)
        if self.halted or not all(math.isfinite(part) for part in parts):
            return STANDSTILL
        self._fresh_s = now_s
        speed, turn = self.config.max_speed_m_s, self.config.max_turn_rad_s
        length = math.hypot(wanted.forward_m_s, wanted.left_m_s)
        scale = min(1.0, speed / length) if length else 1.0
        allowed = Velocity(
            wanted.forward_m_s * scale,
            wanted.left_m_s * scale,
            max(-turn, min(turn, wanted.turn_rad_s)),
        )
        if allowed != wanted:
            self.clamped += 1
        return allowed

    def expired(self, now_s: float) -> bool:
        """Whether the last fresh action is older than the deadman allows."""
        return now_s - self._fresh_s > self.config.deadman_s + 1e-9
