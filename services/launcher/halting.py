"""Emergency stop of all robots of a run, over a bus that is open already."""

from __future__ import annotations

import threading

from services.processes import DRIVER
from shared.bus import Bus
from shared.errors import BadMessage, BusError
from shared.keys import ROBOT_COMMAND
from shared.messages import RobotCommand, RobotState

ATTEMPTS, ATTEMPT_S = 3, 1.0


def stop_all(bus: Bus) -> str:
    """Tell all robots at once to stop and stay stopped; what each answered, in one line."""
    robots = sorted({peer.id for peer in bus.peers() if peer.service == DRIVER.name})
    if not robots:
        return "emergency stop NOT sent: no robot answers"
    answers = dict.fromkeys(robots, "does not answer")
    threads = [
        threading.Thread(target=_stop, args=(bus, robot, answers), daemon=True) for robot in robots
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(ATTEMPTS * ATTEMPT_S + 1.0)
    told = ", ".join(f"{robot} {answer}" for robot, answer in answers.items())
    return f"emergency stop sent; robots: {told}"


def _stop(bus: Bus, robot: str, answers: dict[str, str]) -> None:
    """Stop one robot, and note what it says."""
    command = RobotCommand(command="estop")
    for _ in range(ATTEMPTS):
        try:
            state = bus.request(
                ROBOT_COMMAND, command, RobotState, ident=robot, timeout_s=ATTEMPT_S
            ).state
        except (BusError, BadMessage) as error:
            answers[robot] = f"does not answer ({error})"
        else:
            answers[robot] = "stands" if state == "estop" else f"is {state}"
            return
