"""The driver of one robot: observations out, actions in, safety always (no bus in here).

How a robot moves is decided in `motion_control.py`; sequence numbers and bumps are here.
"""

from collections.abc import Collection
from typing import Any

from services.robot_driver.host import Host
from services.robot_driver.motion_control import MotionControl
from services.robot_driver.robot import NotReady, Pose, Robot
from services.robot_driver.safety import Safety
from services.robot_driver.world_changes import WorldChanges, described
from shared.config import Config
from shared.messages import (
    MAX_EARLIER,
    MAX_FAULTS,
    Action,
    DriverState,
    Fault,
    HaltKind,
    Interruption,
    Motion,
    Observation,
    RobotState,
    WorldChange,
    WorldChanged,
)

COUNTS = (
    *("sequence", "bumps", "recoveries", "late_actions", "refused_actions"),
    *("resent_observations", "refused_changes", "blocks"),
)
"""What a driver counts and tells."""


class Driver:
    """Executes actions one by one and tells what the robot perceives after each."""

    def __init__(self, config: Config, robot: Robot, life: str, host: Host | None = None) -> None:
        self._config, self._robot, self._host = config, robot, host or Host()
        self.life = life
        self.earlier: tuple[str, ...] = ()
        """Lives that this one continues after clean stops, newest first."""
        self.safety = Safety(config.robot)
        self._control = MotionControl(config, robot, self.safety, self._host)
        self.state: DriverState = "waiting"
        self.sequence = 0
        self.attempt = 0
        self.bumps = self.recoveries = self.late_actions = self.refused_actions = 0
        self.resent_observations = self.refused_changes = self.blocks = 0
        self.reason = ""
        """Why the robot is not fit to drive; empty when it is."""
        self._changes = WorldChanges(robot.changeable)
        self._bump = False
        self._interruption: Interruption = ""
        self._begun: tuple[int | None, str] = (None, "")
        """The action in force and the life of its actor; below, those executed last."""
        self._executed: tuple[int | None, str] = self._begun
        self._pose = Pose(0.0, 0.0, 0.0)

    def attach(self, host: Host) -> None:
        """Belong to this process from now on."""
        self._host = self._control.host = host

    @property
    def world(self) -> str:
        """Name of the world the robot drives in now."""
        return self._changes.world or self._config.robot.world

    def observe(self) -> Observation:
        """Sense now, as the observation that the next action answers. Raises RobotFault."""
        sensed = self._robot.sense()
        self._pose = sensed.pose
        laps = self._robot.laps
        return Observation(
            robot=self._config.robot.id,
            life=self.life,
            earlier=self.earlier,
            sequence=self.sequence,
            attempt=self.attempt,
            action=self._executed[0],
            actor_life=self._executed[1],
            image=sensed.image.tobytes(),
            **vars(sensed.pose),
            bump=self._bump,
            interruption=self._interruption,
            world=self.world,
            period_s=self._config.robot.period_s,
            stamp_s=self._robot.now_s(),
            laps_left=laps.left,
            laps_right=laps.right,
        )

    def answers(self, action: Action) -> bool:
        """Whether this action answers the newest observation; any other is counted and ignored."""
        fits = (action.robot_life, action.sequence, action.attempt) == (
            self.life,
            self.sequence,
            self.attempt,
        )
        if not fits:
            self.refused_actions += 1
        return fits

    def execute(self, action: int, actor_life: str = "") -> None:
        """Lockstep: drive one whole action; stop and recover at a bump (A9, E11)."""
        self.start(action, actor_life)
        self.settle(self.advance(self._config.robot.period_s))

    def start(self, action: int, actor_life: str = "") -> None:
        """Begin to drive an action of an actor, within the limits."""
        self._begun = (action, actor_life)
        self._control.start_action(action)
        self.state = "driving"

    def move(self, motion: Motion) -> None:
        """Lockstep: carry out one whole motion that is no action."""
        if self.start_motion(motion):
            self.settle(self.advance(self._config.robot.period_s))
        else:
            self.look_again("")

    def start_motion(self, motion: Motion) -> bool:
        """Begin to turn or to creep; False, standing still, where the bumper is pressed."""
        started = self._control.start_motion(motion)
        if started:
            self.state = "driving"
        return started

    def advance(self, duration_s: float) -> bool:
        """Let time pass; True at contact, which stops the robot (`MotionControl.advance`)."""
        return self._control.advance(duration_s)

    def settle(self, bump: bool, *, executed: bool = True) -> None:
        """The action or motion is over: count it, recover from a bump, look anew.

        Realtime only: a bump before the newest observation was answered (not `executed`) belongs to
        the action before it, so the number stays. A motion never counts; after its bump the robot
        lets go.
        """
        self._bump, self._interruption = bump, ""
        self.bumps += int(bump)
        if self._control.motion:
            if bump:
                self.state = "recovering"
                self._control.let_go()
            self.look_again("moved")
            return
        if bump and self._config.robot.recovery == "back-off":
            self.state = "recovering"
            self.recoveries += self._control.back_off(self.sequence)
        self._count(executed=executed)
        self.state = "waiting"

    def look_again(self, interruption: Interruption) -> None:
        """The observation was not answered by motion: take a fresh one under the same number.

        An earlier `moved` stays: it tells that the bump, if there is one, was no action's (E42).
        """
        self.attempt += 1
        if self._interruption != "moved":
            self._interruption = interruption or self._interruption
        self.state = "waiting"

    def block(self, reason: str, *, bump: bool = False) -> None:
        """The robot is not fit to drive: stand still until `fit`, then look anew.

        A bump at that moment is counted, not recovered from, and ends the action in force (E42).
        """
        if bump and not self._control.motion:
            self._bump, self._interruption = True, ""
            self._count(executed=self.state == "driving")
        self.halt()
        self.blocks += 1
        self.bumps += int(bump)
        self.look_again("blocked")
        self.state, self.reason = "blocked", reason

    def fit(self) -> bool:
        """Whether the robot can be driven (again); if not, `reason` says why. Raises RobotFault."""
        try:
            self._robot.sense()
        except NotReady as problem:
            self.reason = str(problem)
            return False
        self.state, self.reason = "waiting", ""
        return True

    def halt(self) -> None:
        """Stand still now; may be called in any state."""
        self._control.halt()

    def hold(self, kinds: Collection[HaltKind]) -> bool:
        """Stand while halts of these kinds are in force, else look anew; whether it stands."""
        safety, realtime = self.safety, self._config.robot.timing == "realtime"
        if safety.estop and "estop" not in kinds:
            self.look_again("estop")
        if safety.paused and "pause" not in kinds and realtime:
            self.look_again("pause")
        safety.estop, safety.paused = "estop" in kinds, "pause" in kinds
        if safety.halted:
            self.halt()
        return safety.halted

    def change(self, wish: WorldChange, *, at_once: bool = False) -> WorldChanged:
        """Take a wish to change the world: it waits for its episode, or is refused, and counted.

        at_once: what need not wait is carried out now, and not instead of the next action.
        """
        if wish.kind in ("withdraw", "list"):
            return self._rearrange(wish)
        if (known := self._changes.known(wish)) is not None:
            return known
        try:
            self._changes.add(wish)
        except ValueError as error:
            self._refused(wish, str(error))
            return self._changes.answer(wish, str(error))
        outcomes = self._carry_out(0) if at_once else []
        self._host.keep(self._changes.kept())
        refusal = next((refusal for change, refusal in outcomes if change is wish), "")
        return self._changes.answer(wish, refusal)

    def apply_due(self, episode: int) -> bool:
        """Carry out the changes that are due in this episode of the robot, `Action.episode`.

        True: do not execute that action, look again instead (same sequence, next attempt).
        """
        outcomes = self._carry_out(episode)
        if outcomes:
            self._host.keep(self._changes.kept())
        return bool(outcomes)

    @property
    def shown_state(self) -> DriverState:
        """What the robot does, for others: a halt outweighs the rest."""
        return "estop" if self.safety.estop else "paused" if self.safety.paused else self.state

    def report(self, undecodable: int, busy: int = 0) -> RobotState:
        """The heartbeat."""
        laps, faults = self._robot.laps, self._robot.faults.most_common(MAX_FAULTS)
        return RobotState(
            robot=self._config.robot.id,
            life=self.life,
            state=self.shown_state,
            **{name: getattr(self, name) for name in COUNTS},
            **vars(self._pose),
            world=self.world,
            deadman_stops=self.safety.deadman_stops,
            clamped=self.safety.clamped,
            undecodable=undecodable,
            busy=busy,
            laps_left=laps.left,
            laps_right=laps.right,
            pending_changes=len(self._changes.pending),
            reason=self.reason[:200],
            faults=tuple(Fault(name=name[:64], count=count) for name, count in faults),
        )

    def saved(self) -> dict[str, Any]:
        """Everything a later process needs to continue exactly here, for msgpack."""
        names = (*COUNTS, "attempt", "_bump", "_interruption", "_executed")
        return {
            "kind": self._config.robot.kind,
            "robot": self._robot.state(),
            "changes": self._changes.saved(),
            "lives": [self.life, *self.earlier],
            **{name: getattr(self, name) for name in names},
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Continue from `saved()`. Raises KeyError, TypeError or ValueError on a misfit."""
        if saved.keys() != self.saved().keys():
            odd = sorted(saved.keys() ^ self.saved().keys())
            raise KeyError(f"missing or unknown: {', '.join(odd)}")
        self._changes.restore(saved["changes"])
        self._robot.restore(saved["robot"])
        self.earlier = tuple(map(str, saved["lives"]))[:MAX_EARLIER]
        for name in saved.keys() - {"kind", "robot", "changes", "lives"}:
            setattr(self, name, type(getattr(self, name))(saved[name]))
        if self._config.robot.kind != "sim":
            self.look_again("restart")

    def restore_kept(self, kept: dict[str, Any]) -> None:
        """Begin anew in a world that `Host.keep` got. Raises KeyError, TypeError or ValueError."""
        self._changes.restore_kept(kept)

    def _rearrange(self, wish: WorldChange) -> WorldChanged:
        """Tell what waits, or withdraw some of it."""
        refusal = self._changes.withdraw(wish.id) if wish.kind == "withdraw" else ""
        if refusal:
            self._refused(wish, refusal)
        self._host.keep(self._changes.kept())
        return self._changes.answer(wish, refusal)

    def _carry_out(self, episode: int) -> list[tuple[WorldChange, str]]:
        """Carry out what is due; the robot then stands still and looks again."""
        outcomes = self._changes.carry_out(episode)
        switched = False
        for change, refusal in outcomes:
            if refusal:
                self._refused(change, refusal)
            else:
                switched |= change.kind == "switch"
                self._host.tell(f"world: {described(change)}")
        if outcomes:
            self.halt()
            self.look_again("world" if switched else "")
        return outcomes

    def _refused(self, change: WorldChange, reason: str) -> None:
        self.refused_changes += 1
        self._host.complain(f"world: refused to {described(change)}: {reason}")

    def _count(self, *, executed: bool) -> None:
        """Number the next observation: an executed action counts, anything else is a new look."""
        if executed:
            self._executed = self._begun
            self.sequence, self.attempt = self.sequence + 1, 0
        else:
            self.attempt += 1
