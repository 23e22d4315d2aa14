"""Filling the buffers of a Mitsuba mesh."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .variants import is_jit


def write_buffers(mesh: Any, **buffers: Any) -> None:
    """Give a mesh its ``faces``, ``vertex_positions``, ... as flat arrays."""
    if is_jit():
        # Scenes are loaded by several threads. The update evaluates the material of the mesh, too, which may
        # come from another one; Dr.Jit wants to be told of such a handover
        dr.detail.new_scope(dr.backend_v(mi.Float))
    parameters = mi.traverse(mesh)
    for name, values in buffers.items():
        parameters[name] = values
    parameters.update()
