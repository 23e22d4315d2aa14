"""Many renders on many processes and machines: grids of parameters, frames, and pictures cut into tiles.

Dask distributed carries it: what is queued, retried and moved is the engine's own affair.
"""

from __future__ import annotations

import os
import sys

# On a worker, before Dr.Jit is imported: kernels are kept near, as homes are often far away
for _worker in tuple(sys.modules["distributed"].Worker._instances) if "distributed" in sys.modules else ():
    os.environ.setdefault("DRJIT_CACHE_DIR", os.path.join(os.path.dirname(_worker.local_directory), "drjit"))

from mrt_mitsuba.sweeps.run import sweep  # noqa: E402
from mrt_mitsuba.sweeps.table import Table  # noqa: E402

__all__ = ["Table", "sweep"]
