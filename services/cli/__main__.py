"""`python -m services.cli` is the command `corridor`."""

import logging
import os
import sys

from services.cli.entry import main

code = main()
logging.shutdown()
sys.stdout.flush()
sys.stderr.flush()
os._exit(code)  # taking everything apart again would take seconds where cores are busy
