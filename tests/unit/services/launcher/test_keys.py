"""Keys at a pseudo-terminal: read in the foreground only, and the terminal is given back."""

from __future__ import annotations

import os
import sys

import pytest

from benchmarks.terminals import Terminal
from benchmarks.waiting import wait_until
from services.launcher.keys import Keys

READ = """
import sys, threading
from services.launcher.keys import Keys
pressed = threading.Event()
def on_key(key):
    print("pressed", repr(key), flush=True)
    if key == "q":
        pressed.set()
with Keys(on_key):
    print("reading", flush=True)
    pressed.wait(60)
"""
JOB = f"""
import os
job = os.fork()
if job == 0:
    os.setpgid(0, 0)
    exec({READ!r})
    os._exit(0)
os.fdopen(FD).readline()
os.tcsetpgrp(0, job)
_, status = os.waitpid(job, 0)
os._exit(os.waitstatus_to_exitcode(status))
"""
"""A shell that starts `READ` in the background, and brings it to the front at a line from `FD`."""


def shows(person: Terminal, what: str) -> None:
    wait_until(lambda: what in person.shown(), 20, f"{what!r} is shown")


@pytest.mark.timeout(120)
def test_each_key_counts_once_and_the_terminal_is_given_back() -> None:
    with Terminal([sys.executable, "-c", READ]) as person:
        shows(person, "reading")
        wait_until(lambda: not person.gives_lines(), 20, "single keys")
        person.press(b"    ")
        shows(person, "pressed ' '")
        person.press(b"q")
        shows(person, "pressed 'q'")
        assert person.process.wait(20) == 0
        assert person.gives_lines()
        assert person.shown().count("pressed ' '") == 1


@pytest.mark.timeout(120)
def test_a_background_job_is_neither_stopped_nor_touches_the_terminal() -> None:
    shell, front = os.pipe()
    command = [sys.executable, "-c", JOB.replace("FD", str(shell))]
    with Terminal(command, pass_fds=[shell]) as person:
        os.close(shell)
        shows(person, "reading")
        person.press(b"x\n")
        assert person.gives_lines()
        os.write(front, b"fg\n")
        wait_until(lambda: not person.gives_lines(), 20, "single keys")
        person.press(b"q")
        shows(person, "pressed 'q'")
        assert person.process.wait(20) == 0
        assert person.gives_lines()
    os.close(front)


def test_without_a_terminal_nothing_is_read() -> None:
    read, write = os.pipe()
    os.write(write, b" ")
    with Keys(lambda _: None, read) as keys:
        assert not keys.active
    assert os.read(read, 1) == b" "
    os.close(read)
    os.close(write)
