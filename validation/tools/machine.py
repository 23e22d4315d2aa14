"""The machine and the software that figures were measured with, as far as comparing them needs it."""

from __future__ import annotations

import platform
from typing import Any

from mrt_mitsuba.cores import usable_cores


def machine() -> dict[str, Any]:
    """Return the number of cores and the system, without the name of the machine."""
    return {"cores": usable_cores(), "system": f"{platform.system()} {platform.machine()}"}


def versions() -> dict[str, str]:
    """Return the versions of everything that bears on speed or accuracy, by name."""
    import drjit as dr
    import mitsuba as mi

    import mrt_mitsuba

    usable = dr.has_backend(dr.JitBackend.LLVM)
    return {
        "mrt-mitsuba": mrt_mitsuba.__version__,
        "mitsuba": mi.MI_VERSION,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, dr.detail.llvm_version())) if usable else "none",
        "python": platform.python_version(),
    }
