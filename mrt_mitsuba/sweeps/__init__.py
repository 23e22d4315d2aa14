"""Many renders on many processes and machines: grids of parameters, frames, seeds.

Dask distributed runs the jobs: it queues, moves and repeats them.
"""

from __future__ import annotations

from mrt_mitsuba.sweeps.run import sweep
from mrt_mitsuba.sweeps.table import Table

__all__ = ["Table", "sweep"]
