"""`python -m services.cli` is the command `corridor`."""

import sys

from services.cli.main import main

sys.exit(main())
