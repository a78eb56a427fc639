"""`python -m services.cli` is the command `corridor`."""

import logging
import os
import sys

from services.cli.entry import main

code = main()
logging.shutdown()
if "multiprocessing" in sys.modules:  # what it does not take back, it tells of as leaked
    from multiprocessing import util

    util._exit_function()  # type: ignore[attr-defined]
sys.stdout.flush()
sys.stderr.flush()
os._exit(code)  # taking everything apart again would take seconds where cores are busy
