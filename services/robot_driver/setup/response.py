"""How a robot follows one command, read off its odometry (no clock, no robot).

A base waits for its delay, speeds up evenly, then goes on at a steady speed, the slope of the last
part of the way. The delay is the one with which such a base comes closest to the rest.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

STEADY = 0.4
"""The last part of a drive, in which the base no longer speeds up."""
LEAST_READINGS = 6
"""In that part."""
DELAYS_S = np.arange(0.0, 1.0, 0.005)
BENT = 0.1
"""A steady part whose two halves differ by more of their speed than this is none."""
Floats = npt.NDArray[np.float64]


class Response(NamedTuple):
    """What a robot made of one command."""

    speed: float
    """Steady speed in metres or radians a second."""
    delay_s: float
    """From the command until the base begins to move."""


def response(times_s: Floats, way: Floats, driven_s: float) -> Response:
    """What a robot made of a command that was in force for `driven_s`. Raises ValueError.

    times_s: of the readings since the command, ascending. way: metres or radians in its direction.
    """
    driven = times_s <= driven_s
    times_s, way = times_s[driven], way[driven] - way[0]
    steady = times_s >= (1.0 - STEADY) * driven_s
    if steady.sum() < LEAST_READINGS:
        raise ValueError(f"only {steady.sum()} readings of the odometry in {STEADY * driven_s:g} s")
    speed, zero_s = _line(times_s[steady], way[steady])
    if speed <= 0.0:
        raise ValueError("the robot did not move, or the other way")
    half = len(times_s[steady]) // 2
    first, last = (
        _line(times_s[steady][part], way[steady][part])[0]
        for part in (slice(half), slice(-half, None))
    )
    if abs(first - last) > BENT * speed:
        raise ValueError(f"no steady speed: {first:.3f}, then {last:.3f}")
    delays_s = DELAYS_S[zero_s >= DELAYS_S]
    if not len(delays_s):
        return Response(speed, 0.0)
    errors = [np.square(_way(times_s, speed, delay, zero_s) - way).sum() for delay in delays_s]
    return Response(speed, float(delays_s[int(np.argmin(errors))]))


def _line(times_s: Floats, way: Floats) -> tuple[float, float]:
    """Slope of the straight line through these, and where it crosses zero."""
    slope, offset = np.polyfit(times_s, way, 1)
    return float(slope), float(-offset / slope) if slope else 0.0


def _way(times_s: Floats, speed: float, delay_s: float, zero_s: float) -> Floats:
    """The way of a base that speeds up evenly from `delay_s` on, so that its line crosses zero."""
    ramp_s = 2.0 * (zero_s - delay_s)
    since_s = np.clip(times_s - delay_s, 0.0, None)
    ramping = np.square(since_s) * speed / (2.0 * max(ramp_s, 1e-9))
    return np.asarray(np.where(since_s < ramp_s, ramping, speed * (times_s - zero_s)))
