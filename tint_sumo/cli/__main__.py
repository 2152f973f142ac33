"""``python -m tint_sumo.cli``."""

import sys

from tint_sumo.cli import main

sys.exit(main())
