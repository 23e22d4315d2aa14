"""Scenes: the model, the report's scenes, OBJ files, and their translation to Mitsuba."""

from __future__ import annotations

from mrt_mitsuba.scene.model import Camera, Cone, Cylinder, Light, Material, Mesh, Plane, Scene, Sphere

__all__ = ["Camera", "Cone", "Cylinder", "Light", "Material", "Mesh", "Plane", "Scene", "Sphere"]
