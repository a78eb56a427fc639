"""What may be sent to a real robot now: below everything else (no clock, no thread).

A velocity is a lease that the driver renews. Contact, a lease that ran out and whatever else
forbids motion turn it into standstill here.
"""

import math

from services.robot_driver.robot import STANDSTILL, RobotFault, Velocity
from shared.config import RobotConfig

ZEROS = 5
"""A stop is sent at least this often, also before a robot drives back: a single one can be lost."""
TURNING_S = 0.02
"""Time between the stops before a robot drives back."""
PRESSED_RECOVERIES = 2.0
"""Recovery distances that may be driven with a bumper that never lets go; then the robot waits."""
_TOLERANCE = 1.0 + 1e-9


class Gate:
    """The velocity in force and when it is to be sent."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self.lease_s = min(config.deadman_s, config.period_s)
        """A hanging driver's robot is told to stop after this: one period, so that a robot with
        its own delay stands still within two and that delay."""
        self.problem = ""
        """Why the robot must not move; empty when it may."""
        self.lease_stops = 0
        self.lapsed = False
        """The lease ran out since the driver last set a velocity."""
        self.hit = False
        """Contact that the driver has not handled yet."""
        self.pressed = False
        self._regardless = False
        self._wanted = STANDSTILL
        self._until_s = -math.inf
        self._pressed_m = 0.0
        self._last: Velocity | None = None
        self._motion = STANDSTILL
        """The last velocity of motion that was sent."""
        self._last_s = -math.inf
        self._next_s = -math.inf
        self._zeros = 0
        self._still_s = -math.inf
        """When the robot stands: it coasts for a while after a stop."""

    @property
    def stuck(self) -> bool:
        """Whether recovery has driven its whole way with a bumper that never let go."""
        allowed_m = PRESSED_RECOVERIES * self._config.recovery_distance_m
        return self.pressed and self._pressed_m >= allowed_m - 1e-9

    @property
    def wants_motion(self) -> bool:
        """Whether the driver's last velocity was one of motion."""
        return self._wanted.moving

    def drive(self, velocity: Velocity, now_s: float) -> None:
        """Take a velocity from the driver, leased from now on.

        Raises RobotFault: not finite or beyond the limits; the robot is to stand still then.
        """
        config = self._config
        parts = (velocity.forward_m_s, velocity.left_m_s, velocity.turn_rad_s)
        if not (
            all(math.isfinite(part) for part in parts)
            and math.hypot(*parts[:2]) <= config.max_speed_m_s * _TOLERANCE
            and abs(parts[2]) <= config.max_turn_rad_s * _TOLERANCE
        ):
            self._wanted = STANDSTILL
            raise RobotFault(f"velocity {parts}: expected one within the limits of the robot")
        if not velocity.moving:
            self._regardless = False
        self._wanted, self._until_s, self.lapsed = velocity, now_s + self.lease_s, False

    def renew(self, now_s: float, *, regardless: bool) -> None:
        """The driver still lives. What it let run out stays at standstill.

        regardless: it means to move with a pressed bumper, slowly, until it wants standstill.
        """
        self._regardless = regardless
        if regardless:
            self._still_s = -math.inf
        self._expire(now_s)
        self._until_s = now_s + self.lease_s

    def feel(self, pressed: bool, now_s: float) -> None:
        """Take a reading of the bumper. Who touches a standing robot is no contact."""
        self.pressed = pressed
        if not pressed:
            self._pressed_m = 0.0
        elif not self._regardless and (self._wanted.moving or now_s < self._still_s):
            self.hit = True

    def handled(self) -> bool:
        """The driver looks: whether the robot hit something since, or is to move pressed."""
        contact = self.hit or (self.pressed and self._wanted.moving)
        self.hit = False
        return contact

    def in_force(self, now_s: float) -> Velocity:
        """What the robot may do now."""
        self._expire(now_s)
        blocked = bool(self.problem) or self.stuck
        if not self._regardless:
            blocked |= self.hit or self.pressed
        elif self.pressed:
            speed = math.hypot(self._wanted.forward_m_s, self._wanted.left_m_s)
            blocked |= speed > self._config.recovery_speed_m_s * _TOLERANCE
        return STANDSTILL if blocked or self._turning else self._wanted

    @property
    def _turning(self) -> bool:
        """Whether the robot is to drive the other way and was not stopped often enough before."""
        motion, wanted = self._motion, self._wanted
        along = motion.forward_m_s * wanted.forward_m_s + motion.left_m_s * wanted.left_m_s
        return along < 0.0 and self._zeros > 0

    def due(self, now_s: float) -> Velocity | None:
        """What to send now, if anything: changes, motion every period, a stop `ZEROS` times."""
        self._count_way(now_s)
        velocity = self.in_force(now_s)
        if velocity != self._last:
            self._zeros = ZEROS
            return velocity
        again = velocity.moving or self._zeros > 0
        return velocity if again and now_s >= self._next_s else None

    def sent(self, velocity: Velocity, now_s: float, *, arrived: bool) -> None:
        """A velocity was sent; what did not arrive is sent again."""
        moved = velocity.moving or (self._last is not None and self._last.moving)
        if moved and not self._regardless:
            self._still_s = now_s + self._config.hardware.rest_s
        self._last = velocity
        period_s = self._config.hardware.command_period_s
        self._next_s = now_s + (min(TURNING_S, period_s) if self._turning else period_s)
        if velocity.moving:
            self._motion = velocity
        if arrived and not velocity.moving:
            self._zeros -= 1

    def stop(self) -> None:
        """Forget what the driver wanted and send a stop again."""
        self._wanted, self._last = STANDSTILL, None

    @property
    def silent(self) -> bool:
        """Whether a stop was sent often enough."""
        return self._last == STANDSTILL and self._zeros <= 0

    def _expire(self, now_s: float) -> None:
        if self._wanted.moving and now_s > self._until_s:
            self._wanted, self.lapsed = STANDSTILL, True
            self.lease_stops += 1

    def _count_way(self, now_s: float) -> None:
        """Sum up the way that was commanded with a pressed bumper."""
        if self.pressed and self._last is not None and math.isfinite(self._last_s):
            speed = math.hypot(self._last.forward_m_s, self._last.left_m_s)
            self._pressed_m += speed * max(now_s - self._last_s, 0.0)
        self._last_s = now_s
