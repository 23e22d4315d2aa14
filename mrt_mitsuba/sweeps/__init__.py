"""Many renders on many processes and machines: grids of parameters, frames, and pictures cut into tiles.

Dask distributed carries it: what is queued, retried and moved is the engine's own affair.
"""

from __future__ import annotations

from mrt_mitsuba.sweeps.run import sweep
from mrt_mitsuba.sweeps.table import Table

__all__ = ["Table", "sweep"]
