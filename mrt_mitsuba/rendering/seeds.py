"""Seeds of random numbers."""

from __future__ import annotations

from typing import Any
from zlib import crc32

import numpy as np


def derived_seed(seed: Any, **parts: int) -> Any:
    """Return the seed for a part of what ``seed`` decides, such as ``frame=2, refinement=1``.

    Parts of different names or numbers draw independent numbers, and so do the same parts of another seed.
    Parts with the number 0 are left out; where all are, ``seed`` itself comes back, which may then be a
    Dr.Jit array. A sum such as ``seed + frame`` would give a frame the numbers of another seed's frame.
    """
    key = [n for name, part in sorted(parts.items()) if part for n in (crc32(name.encode()), part)]
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0]) if key else seed
