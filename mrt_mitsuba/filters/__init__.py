"""Filters over rendered images: pure functions from arrays to arrays, for the pictures of any renderer."""

from typing import TYPE_CHECKING

from mrt_mitsuba.filters.dof import blur_amount, gaussian_dof
from mrt_mitsuba.filters.edges import EdgeMap, geometry_edges, luma_edges, sobel_edges

if TYPE_CHECKING:
    from mrt_mitsuba.filters.denoising import Denoised as Denoised
    from mrt_mitsuba.filters.denoising import denoise as denoise

__all__ = ["Denoised", "EdgeMap", "blur_amount", "denoise"]
__all__ += ["gaussian_dof", "geometry_edges", "luma_edges", "sobel_edges"]


def __getattr__(name: str) -> object:
    """Import the denoiser when it is first used: few renders need it."""
    if name not in ("Denoised", "denoise"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mrt_mitsuba.filters import denoising

    return getattr(denoising, name)
