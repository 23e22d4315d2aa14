"""Camera rays: where in a pixel and when they are traced, and their random numbers."""
