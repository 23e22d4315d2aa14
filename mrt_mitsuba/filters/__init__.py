"""Filters over rendered images: pure functions from arrays to arrays, for the pictures of any renderer."""

from mrt_mitsuba.filters.denoise import Denoised, denoise
from mrt_mitsuba.filters.dof import blur_amount, gaussian_dof
from mrt_mitsuba.filters.edges import EdgeMap, geometry_edges, luma_edges, sobel_edges

__all__ = ["Denoised", "EdgeMap", "blur_amount", "denoise"]
__all__ += ["gaussian_dof", "geometry_edges", "luma_edges", "sobel_edges"]
