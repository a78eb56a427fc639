"""`python -m services.cli` is the command `corridor`."""

import sys

from services.cli.entry import main

sys.exit(main())
