"""``python -m mrt_mitsuba``: the ``mrt`` command."""

import sys

from mrt_mitsuba.command import start

sys.exit(start())
