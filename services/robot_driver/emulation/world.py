"""An emulated base in a simulated world, running by the wall clock in a thread of its own."""

import threading
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from services.robot_driver.emulation.dynamics import STEP_S, BaseDynamics, EmulatedBase, Given
from services.robot_driver.robot import Pose, Velocity
from services.robot_driver.simulated.sim import SimRobot
from services.robot_driver.simulated.world import WorldError, load_world
from shared.config import CameraConfig, RobotConfig
from shared.errors import ConfigError

NOISE = 2.0
"""Standard deviation of the camera's noise, in grey values: no two pictures are equal."""


@dataclass(frozen=True)
class Truth:
    """What an emulated robot really does: for tests, not for drivers."""

    now_s: float
    """Monotonic clock of this computer, as all times here."""
    pose: Pose
    """In the world."""
    velocity: Velocity
    contact: bool
    still_since_s: float | None
    """None while it moves."""
    watchdog_stops: int
    commands: tuple[Given, ...]
    low_told_s: float | None
    """When the robot first told that its battery is low."""

    def tree(self) -> dict[str, Any]:
        """This, ready for JSON."""
        commands = [{"at_s": given.at_s, **asdict(given.velocity)} for given in self.commands]
        return {**asdict(self), "commands": commands}


@dataclass(frozen=True)
class Counted:
    """What the base tells of itself."""

    odometry: Pose
    velocity: Velocity
    sequence: int
    contact: bool


class EmulatedRobot:
    """A base, its bumper and its camera. All methods may be called from any thread.

    It begins at the first start pose of the world of this name. Raises ConfigError: there is no
    such world, or the robot does not fit into it.
    """

    def __init__(self, world: str, dynamics: BaseDynamics, robot: RobotConfig) -> None:
        try:
            self._body = SimRobot(robot, load_world(world), seed=0)
        except (WorldError, ValueError) as error:
            raise ConfigError(f"--world: {error}") from error
        self._camera = robot.camera
        self._lock = threading.Lock()
        self._base = EmulatedBase(self._body, dynamics, time.monotonic())
        self._constant: Pose | None = None
        self._low_told_s: float | None = None
        self._noise = np.random.default_rng(0)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="emulated-base", daemon=True)
        self._thread.start()

    def command(self, velocity: Velocity) -> None:
        """A command arrives now. Raises ValueError unless it is finite."""
        with self._lock:
            self._base.command(velocity, time.monotonic())

    def counted(self) -> Counted:
        """Odometry, velocity, sequence number and bumper now."""
        with self._lock:
            base = self._base
            pose = self._constant or base.odometry
            return Counted(pose, base.velocity, base.sequence, base.contact)

    def truth(self) -> Truth:
        """What the robot really does now."""
        with self._lock:
            base = self._base
            base.run_until(time.monotonic())
            return Truth(
                now_s=base.now_s,
                pose=self._body.pose,
                velocity=base.velocity,
                contact=base.contact,
                still_since_s=base.still_since_s,
                watchdog_stops=base.watchdog_stops,
                commands=tuple(base.commands),
                low_told_s=self._low_told_s,
            )

    def tell_battery(self, *, low: bool) -> None:
        """The robot tells of its battery now."""
        with self._lock:
            self._low_told_s = (self._low_told_s or time.monotonic()) if low else None

    def configure(self, *, odometry: str, watchdog_s: float, scale: float) -> None:
        """Let the motors stall (`stalled`) or the odometry stand (`constant`); set the base."""
        with self._lock:
            self._base.stalled = odometry == "stalled"
            self._constant = self._base.odometry if odometry == "constant" else None
            self._base.configure(watchdog_s=watchdog_s, scale=scale)

    def picture(self, fault: str = "") -> npt.NDArray[np.uint8]:
        """What the camera sees now: uint8 [h, w, 3], RGB, with noise as of a real sensor.

        fault: `noiseless`, or `flat` for one grey alone.
        """
        with self._lock:
            frame = self._body.frame()
            noise = self._noise.normal(0.0, NOISE, frame.shape[:2])
        if fault == "flat":
            return np.full_like(frame, 128)
        if fault == "noiseless":
            return frame
        noisy = frame + np.rint(noise).astype(np.int16)[..., np.newaxis]
        return np.asarray(np.clip(noisy, 0, 255), np.uint8)

    def close(self) -> None:
        """End the thread and free the world. May be called twice."""
        self._done.set()
        self._thread.join(5.0)
        with self._lock:
            self._body.close()

    def _run(self) -> None:
        while not self._done.wait(STEP_S):
            with self._lock:
                self._base.run_until(time.monotonic())


def camera_of(vertical_fov_deg: float, aspect: float, width_px: int = 160) -> CameraConfig:
    """A small camera to scale up from, of a given field of view."""
    return CameraConfig(
        vertical_fov_deg=vertical_fov_deg,
        aspect=aspect,
        render_width_px=width_px,
        render_height_px=round(width_px / aspect),
    )
