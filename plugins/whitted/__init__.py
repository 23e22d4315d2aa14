"""``mrt_whitted`` and what makes it fast: facts about a scene, the plan of its kernels, and their data."""
