"""How a mobile base follows commands: delay, ramps, limits and watchdog (no clock, no thread).

Measured figures of a Robotino and the published ones of a Create 3; what is not known is set to
the worse case. Units are SI.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Protocol

from services.robot_driver.real.odometry import between
from services.robot_driver.robot import STANDSTILL, Pose, Velocity

STEP_S = 0.02
"""Period of the base's own control loop."""
MAX_WAITING = 64
"""Commands on their way through the delay; more are dropped, oldest first."""
MAX_REMEMBERED = 128
"""Commands kept to be looked at."""


@dataclass(frozen=True)
class BaseDynamics:
    """Figures of one kind of base."""

    delay_s: float
    """Delay from a command's arrival until the wheels begin to follow it."""
    accel_m_s2: float
    decel_m_s2: float
    turn_accel_rad_s2: float
    turn_decel_rad_s2: float
    max_speed_m_s: float
    """Per axis; faster commands are cut to it."""
    max_turn_rad_s: float
    deadband_m_s: float
    """Slower commands do not move the wheels."""
    deadband_rad_s: float
    watchdog_s: float
    """Without a command for this long the base brakes."""
    omnidirectional: bool = True
    scale: float = 1.0
    """Part of a command that the wheels make of it."""

    def stop_time_s(self, velocity: Velocity) -> float:
        """Longest time from a stop's arrival until the base stands: delay and ramp."""
        speed = max(abs(velocity.forward_m_s), abs(velocity.left_m_s))
        turn = abs(velocity.turn_rad_s)
        ramp_s = max(speed / self.decel_m_s2, turn / self.turn_decel_rad_s2)
        return self.delay_s + ramp_s + STEP_S


ROBOTINO = BaseDynamics(
    delay_s=0.2,
    accel_m_s2=0.27,
    decel_m_s2=0.43,
    turn_accel_rad_s2=0.92,
    turn_decel_rad_s2=2.67,
    max_speed_m_s=0.68,
    max_turn_rad_s=math.radians(90.0),
    deadband_m_s=0.01,
    deadband_rad_s=0.04,
    watchdog_s=0.2,
)
CREATE3 = BaseDynamics(
    delay_s=0.05,
    accel_m_s2=0.9,
    decel_m_s2=0.9,
    turn_accel_rad_s2=7.7,
    turn_decel_rad_s2=7.7,
    max_speed_m_s=0.306,
    max_turn_rad_s=1.9,
    deadband_m_s=0.0,
    deadband_rad_s=0.0,
    watchdog_s=0.5,
    omnidirectional=False,
)


class Body(Protocol):
    """What the base moves: a robot in a simulated world, such as `SimRobot`."""

    @property
    def pose(self) -> Pose:
        """True pose in the world."""

    @property
    def contact(self) -> bool:
        """The ring bumper is pressed now."""

    def drive(self, velocity: Velocity) -> None:
        """Set the body velocity."""

    def run(self, duration_s: float, *, stop_on_contact: bool) -> bool:
        """Let time pass; return whether there was contact."""


@dataclass(frozen=True)
class Given:
    """A command and when it arrived."""

    at_s: float
    velocity: Velocity


class EmulatedBase:
    """A base that moves a body the way a real one follows commands.

    Time passes by `step` alone. Commands take effect `delay_s` after they arrived; the watchdog
    looks at the delayed commands, so that silence too takes the delay to become noticed.

    now_s: Time at the start, on the clock that `command` tells.
    """

    def __init__(self, body: Body, dynamics: BaseDynamics, now_s: float) -> None:
        self.body, self.dynamics = body, dynamics
        self.now_s = now_s
        self.velocity = STANDSTILL
        """Velocity of the wheels now."""
        self.stalled = False
        """Fault: the motors do not turn, whatever is commanded."""
        self.sequence = 0
        """Number of the odometry reading. It grows by one with each step."""
        self.still_since_s: float | None = now_s
        """Since when the wheels stand; None while they turn."""
        self.watchdog_stops = 0
        self.commands: deque[Given] = deque(maxlen=MAX_REMEMBERED)
        """The last ones, oldest first, as they arrived."""
        self._waiting: deque[Given] = deque(maxlen=MAX_WAITING)
        self._target = STANDSTILL
        self._told_s = -math.inf
        self._start = body.pose

    @property
    def odometry(self) -> Pose:
        """The way from where the base was switched on; wheels do not slip."""
        return between(self._start, self.body.pose)

    @property
    def contact(self) -> bool:
        """The ring bumper is pressed now."""
        return self.body.contact

    def configure(self, **changes: float) -> None:
        """Go on with other figures, such as another `watchdog_s`."""
        self.dynamics = replace(self.dynamics, **changes)  # type: ignore[arg-type]

    def command(self, velocity: Velocity, now_s: float) -> None:
        """A command arrives at `now_s`. Raises ValueError unless it is finite."""
        if not all(math.isfinite(part) for part in _parts(velocity)):
            raise ValueError("expected three finite numbers")
        given = Given(now_s, velocity)
        self.commands.append(given)
        self._waiting.append(given)

    def run_until(self, now_s: float) -> None:
        """Let time pass in whole steps up to `now_s`."""
        while self.now_s + STEP_S <= now_s:
            self.step(STEP_S)

    def step(self, duration_s: float) -> bool:
        """Let a short time pass; return whether there was contact."""
        self.now_s += duration_s
        self.sequence += 1
        while self._waiting and self._waiting[0].at_s + self.dynamics.delay_s <= self.now_s:
            given = self._waiting.popleft()
            self._target, self._told_s = self._limited(given.velocity), given.at_s
        silent_s = self.now_s - self.dynamics.delay_s - self._told_s
        if self._target.moving and silent_s > self.dynamics.watchdog_s:
            self._target = STANDSTILL
            self.watchdog_stops += 1
        self.velocity = STANDSTILL if self.stalled else self._ramped(duration_s)
        if self.velocity.moving:
            self.still_since_s = None
        elif self.still_since_s is None:
            self.still_since_s = self.now_s
        self.body.drive(self.velocity)
        return self.body.run(duration_s, stop_on_contact=False)

    def _limited(self, velocity: Velocity) -> Velocity:
        d = self.dynamics
        left = velocity.left_m_s if d.omnidirectional else 0.0
        return Velocity(
            _limit(d.scale * velocity.forward_m_s, d.deadband_m_s, d.max_speed_m_s),
            _limit(d.scale * left, d.deadband_m_s, d.max_speed_m_s),
            _limit(d.scale * velocity.turn_rad_s, d.deadband_rad_s, d.max_turn_rad_s),
        )

    def _ramped(self, duration_s: float) -> Velocity:
        d, now, target = self.dynamics, self.velocity, self._target
        up, down = d.accel_m_s2 * duration_s, d.decel_m_s2 * duration_s
        turn_up, turn_down = d.turn_accel_rad_s2 * duration_s, d.turn_decel_rad_s2 * duration_s
        return Velocity(
            _ramp(now.forward_m_s, target.forward_m_s, up, down),
            _ramp(now.left_m_s, target.left_m_s, up, down),
            _ramp(now.turn_rad_s, target.turn_rad_s, turn_up, turn_down),
        )


def _parts(velocity: Velocity) -> tuple[float, float, float]:
    return velocity.forward_m_s, velocity.left_m_s, velocity.turn_rad_s


def _limit(wanted: float, deadband: float, most: float) -> float:
    return 0.0 if abs(wanted) < deadband else max(-most, min(most, wanted))


def _ramp(now: float, target: float, up: float, down: float) -> float:
    """One step towards the target: braking towards zero, else accelerating."""
    braking = now * target < 0.0 or abs(target) < abs(now)
    if not braking:
        return target if abs(target - now) <= up else now + math.copysign(up, target - now)
    low = 0.0 if now * target < 0.0 else target
    return low if abs(low - now) <= down else now + math.copysign(down, low - now)
