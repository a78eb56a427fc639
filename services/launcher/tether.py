"""Child processes that end with their parent, however the parent ends.

The parent keeps a pipe to the child's standard input open and never writes to it. When the parent
goes, even by SIGKILL, the kernel closes the pipe, and the child stops itself.
"""

import os
import signal
import threading
import time

GRACE_S = 3.5
"""Time for a clean stop after the parent is gone; then the process ends hard."""


def tether(grace_s: float = GRACE_S) -> None:
    """Stop this process, first by SIGTERM and then hard, once its standard input closes."""

    def watch() -> None:
        try:
            while os.read(0, 4096):
                pass
        except OSError:  # no standard input at all: nobody is holding the other end
            pass
        # To the main thread, so that a blocking call there is interrupted.
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
        time.sleep(grace_s)
        os._exit(1)

    threading.Thread(target=watch, name="tether", daemon=True).start()
