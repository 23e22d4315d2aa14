"""Filters over rendered images: pure functions from arrays to arrays, for the pictures of any renderer."""

from mrt_mitsuba.filters.dof import blur_amount as blur_amount
from mrt_mitsuba.filters.dof import gaussian_dof as gaussian_dof
from mrt_mitsuba.filters.edges import EdgeMap as EdgeMap
from mrt_mitsuba.filters.edges import contours as contours
from mrt_mitsuba.filters.edges import edges_image as edges_image
from mrt_mitsuba.filters.edges import geometry_edges as geometry_edges
from mrt_mitsuba.filters.edges import luma_edges as luma_edges
from mrt_mitsuba.filters.edges import save_contours as save_contours
from mrt_mitsuba.filters.edges import sobel_edges as sobel_edges
