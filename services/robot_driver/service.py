"""The driver service: one robot on the bus, in lockstep or in real time."""

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from services.robot_driver.driver import Driver
from services.robot_driver.host import Host
from services.robot_driver.kinds import make_robot
from services.robot_driver.motion_control import SLICE_S
from services.robot_driver.robot import NotReady
from shared import statefile
from shared.complaints import Complaints
from shared.config import Config
from shared.errors import StateError
from shared.halts.keeper import KeptBook, clock_s
from shared.inbox import Inbox
from shared.keys import ACTION, HALT, OBSERVATION, RELEASE, ROBOT_STATE, ROBOT_WORLD
from shared.messages import Action, Halts, Observation, Release, Standing, WorldChange
from shared.service import TICK_S, Service, Stopped, service

STATE, WORLD = "state.msgpack", "world.msgpack"
"""Files of a robot: all of a driver that was stopped; its world, also of one that was killed."""
LEARN_S = 1.0
"""Longest that a driver asks for halts in force before its first motion."""


def run(config: Config, folder: Path, life: str) -> None:
    """Drive one robot until stopped; a clean stop saves where it is."""
    own = folder / "robot" / config.robot.id
    robot = make_robot(config)
    driver = Driver(config, robot, life)
    try:
        _restore(driver, own, config.robot.kind)
        # Stopped before it was up, it has driven nothing, but has taken up what was saved.
        with suppress(Stopped), service("driver", config.robot.id, config, life=driver.life) as me:
            loop = DriverLoop(me, driver, folder)
            try:
                loop.run()
            finally:
                driver.halt()
                driver.state = "stopped"
                loop.beat(force=True)
        statefile.save(own / STATE, driver.saved())
    finally:
        driver.halt()
        robot.close()


def _restore(driver: Driver, own: Path, kind: str) -> None:
    """Continue after a clean stop; after a kill begin anew, but in the world as it was."""
    path = own / STATE
    try:
        if (saved := statefile.take(path)) is not None and saved["kind"] == kind:
            driver.restore(saved)
            return
        path = own / WORLD
        if kind == "sim" and (kept := statefile.read(path)) is not None:
            driver.restore_kept(kept)
    except (KeyError, TypeError, ValueError) as error:
        raise StateError(f"{path}: saved state of the robot does not fit: {error}") from error


class DriverLoop(Host):
    """Publishes observations and executes the actions that answer them."""

    def __init__(self, me: Service, driver: Driver, folder: Path) -> None:
        self.me, self._driver, self._config = me, driver, me.config
        self._robot = me.config.robot.id
        self._inbox: Inbox = me.bus.inbox()
        self._inbox.serve(HALT)  # first, so that a stop waits behind nothing
        self._inbox.serve(RELEASE)
        self._inbox.serve(ROBOT_WORLD, self._robot)
        self._inbox.subscribe(ACTION, self._robot)
        me.stop.on_set(self._inbox.wake)
        self._next_beat_s, self._heard_s, self._router = 0.0, clock_s(), ""
        self._halts = KeptBook(folder, me.name, me.ident, me.life, self._robot)
        self._world = folder / "robot" / self._robot / WORLD
        self._complaints = Complaints(me.log.warning)
        driver.attach(self)

    @property
    def stopping(self) -> bool:
        """Whether the service is to stop."""
        return self.me.stop.is_set()

    def look(self) -> None:
        """Answer commands and publish the heartbeat."""
        self.beat()

    def tell(self, line: str) -> None:
        """Log what became of a change of the world."""
        self.me.log.info(line)

    def complain(self, line: str) -> None:
        """Log the first refusal of a minute."""
        self._complaints.tell("world", line)

    def keep(self, kept: dict[str, Any]) -> None:
        """Write the robot's world to disk."""
        statefile.save(self._world, kept)

    def run(self) -> None:
        """Turn after turn until the service is to stop."""
        self._learn_of_halts()
        lockstep = self._config.robot.timing == "lockstep"
        turn = self._lockstep_turn if lockstep else self._realtime_turn
        while not self.me.stop.is_set():
            turn()

    def beat(self, *, force: bool = False) -> None:
        """Answer commands; publish the heartbeat when due."""
        for request in self._inbox.requests():
            with request:
                if isinstance(request.message, Halts | Release):
                    changed = self._halts.hear(request.message)
                    stands = self._hold()
                    request.reply(self._halts.standing(self._driver.shown_state, stands=stands))
                    if changed:
                        self.me.log.info("%s", request.message)
                    force |= changed
                elif isinstance(request.message, WorldChange):
                    between_actions = self._driver.state == "waiting"
                    request.reply(self._driver.change(request.message, at_once=between_actions))
                    force = True
        now_s = time.monotonic()
        if force or now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self._config.bus.heartbeat_s
            report = self._driver.report(self._inbox.refused.total(), self._inbox.busy.total())
            self.me.bus.publish(ROBOT_STATE, report, self._robot)

    def _hold(self) -> bool:
        """Stand if a halt holds the robot; whether it does."""
        return self._driver.hold(self._halts.book.kinds(self._robot))

    def _learn_of_halts(self) -> None:
        """Before the robot moves (again): stand if any service that is there knows of a halt."""
        self._router = self.me.bus.router
        self._hold()
        others = {peer.life for peer in self.me.bus.peers()} - {self.me.life}
        until_s = time.monotonic() + LEARN_S
        self._inbox.ask_all(HALT, Halts(), timeout_s=LEARN_S)
        while others and (left_s := until_s - time.monotonic()) > 0 and not self.me.stop.is_set():
            self._inbox.wait(left_s)
            answers = self._inbox.answers(Standing)
            others -= {answer.life for answer in answers}
            if self._halts.join(answers):
                self.me.log.info("a halt is in force: %s", self._halts.book.holding(self._robot))
            self._hold()
            self.beat()

    def _taken(self, action: Action) -> bool:
        """Whether this action answers the newest observation and may be carried out.

        After a silence, or with another router, halts are asked for first. Without a router nobody
        could stop the robot.
        """
        router = self.me.bus.router
        if not self._driver.answers(action) or not router:
            return False
        silent_s, self._heard_s = clock_s() - self._heard_s, clock_s()
        if router != self._router or silent_s > self._config.bus.lease_ms / 1000:
            self._learn_of_halts()
        return not self._driver.safety.halted and self._driver.attempt == action.attempt

    def _lockstep_turn(self) -> None:
        """One observation, answered by one action; simulated time stands still meanwhile."""
        observation = self._driver.observe()
        action = self._await_answer(observation)
        if action is None or self._driver.apply_due(action.episode):
            return
        if action.motion:
            self._driver.move(action.motion)
        elif action.action is None:
            self._driver.look_again("")
        else:
            self._driver.execute(action.action, action.actor_life)

    def _await_answer(self, observation: Observation) -> Action | None:
        """Publish, and publish again until answered. None when interrupted or stopped."""
        driver, attempt = self._driver, observation.attempt
        resend_s = 0.0
        sent = 0
        while not self.me.stop.is_set() and driver.attempt == attempt:
            now_s = time.monotonic()
            if not driver.safety.halted and now_s >= resend_s:
                self.me.bus.publish(OBSERVATION, observation, self._robot)
                driver.resent_observations += int(sent > 0)
                sent, resend_s = sent + 1, now_s + self._config.robot.resend_s
            self._inbox.wait(min(TICK_S, max(resend_s - now_s, 0.01)))
            self.beat()
            for _, action in self._inbox.take(ACTION, Action):
                if self._taken(action):
                    return action
        return None

    def _realtime_turn(self) -> None:
        """One control period, or a stand until the robot is fit to drive."""
        try:
            self._control_period()
        except NotReady as problem:
            self._driver.block(str(problem), bump=problem.contact)
            self._stand_by()

    def _stand_by(self) -> None:
        """Stand still, answering commands, until the robot is fit to drive again."""
        driver, told = self._driver, ""
        while not self.me.stop.is_set():
            if driver.reason != told:
                told = driver.reason
                self.me.log.warning("stands still: %s", told)
                self.beat(force=True)
            self._inbox.wait(SLICE_S)
            self.beat()
            if driver.fit():
                self.me.log.info("fit to drive again")
                return

    def _control_period(self) -> None:
        """One control period: the robot goes on as it does until the answer comes, or stops."""
        driver, period_s = self._driver, self._config.robot.period_s
        observation = driver.observe()
        if not driver.safety.halted:  # an answer could not be carried out
            self.me.bus.publish(OBSERVATION, observation, self._robot)
        left_s, started, hold, bump = period_s, False, False, False
        attempt = driver.attempt
        while left_s > 1e-9 and not bump and not self.me.stop.is_set():
            self.beat()
            if driver.attempt != attempt or driver.safety.halted:
                break
            for _, action in self._inbox.take(ACTION, Action):
                if started or hold or not self._taken(action):
                    continue
                if driver.apply_due(action.episode):
                    return
                if action.motion:
                    started = driver.start_motion(action.motion)
                    hold = not started
                elif action.action is None:
                    hold = True
                    driver.halt()
                else:
                    started = True
                    driver.start(action.action, action.actor_life)
            part_s = min(SLICE_S, left_s)
            bump = driver.advance(part_s)
            left_s -= part_s
        self._end_turn(attempt, started=started, hold=hold, bump=bump)

    def _end_turn(self, attempt: int, *, started: bool, hold: bool, bump: bool) -> None:
        driver = self._driver
        if driver.safety.halted:
            driver.halt()
            self._inbox.wait(TICK_S)
        elif driver.attempt != attempt:  # stopped and released within the period: it looks again
            driver.halt()
        elif started or bump:
            driver.settle(bump, executed=started)
        else:
            driver.halt()
            driver.late_actions += int(not hold)
            driver.look_again("" if hold else "late")
