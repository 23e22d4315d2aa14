"""A kernel plan in words: what the kernels hold, what is left out, and why."""

from __future__ import annotations

import math

from mrt_mitsuba.plugins.kernel_plan import KernelPlan, Reason, SceneFacts

#: What a decision is about, by its name
WHAT = {
    "bvh": "BVH",
    "coherent": "coherent packets",
    "spheres": "table of spheres",
    "quadrics": "cones and cylinders",
    "planes": "planes",
    "lights": "shadow rays",
    "buffers": "light buffers",
    "eye": "lists for the camera",
    "touching": "lights on surfaces",
    "random": "random numbers",
    "emission": "emission",
    "sky": "sky",
    "mirrors": "bounce loop",
    "mirror_rays": "mirror rays",
    "cut_off": "cut-off",
    "guarded": "guard against overflow",
    "lobes": "one of the lobes",
    "textures": "textures",
    "shading_frames": "shading normals",
    "tangents": "tangents",
    "merged": "merged materials",
    "two_sided": "light from behind",
}

WHY = {
    Reason.NO_NATIVE_SHAPES: "no shapes but analytic ones",
    Reason.NO_MESHES: "no mesh in the scene",
    Reason.NO_SPHERES: "no sphere in the scene",
    Reason.NO_QUADRICS: "none in the scene",
    Reason.NO_PLANES: "none in the scene",
    Reason.NO_LIGHTS: "no light",
    Reason.NO_SURFACE_EMITTERS: "no surface emits",
    Reason.NO_SKY: "no sky in the scene",
    Reason.DELTA_LIGHTS: "every light is a point or a direction",
    Reason.MAX_DEPTH: "max_depth admits no mirror ray",
    Reason.NO_MIRRORS: "no material reflects visibly",
    Reason.UNIFORM: "every material is uniform",
    Reason.ONE_SIDED: "no material is lit from behind",
    Reason.SCALAR_VARIANT: "a scalar variant compiles no kernel",
    Reason.SPECTRAL_VARIANT: "a spectral variant",
    Reason.TANGENTS: "a material needs the frame along texture coordinates",
    Reason.ISOTROPIC: "no material depends on the direction of texture coordinates",
    Reason.NATIVE_SHAPES: "other shapes, or spheres that emit or face inwards",
    Reason.INSTANCES: "instances in the scene",
    Reason.OTHER_LIGHTS: "a light other than mrt_light, or one with derivatives",
    Reason.FEW_OBJECTS: "few objects",
    Reason.MANY_OBJECTS: "too many objects",
    Reason.MANY_PAIRS: "too many lights and objects",
    Reason.OTHER_CAMERA: "the first camera is no pinhole",
    Reason.OTHER_BSDF: "a material other than mrt_bsdf",
    Reason.MIXED_FRESNEL: "materials of different Fresnel formulas",
    Reason.VARYING: "a material varies over its surface",
    Reason.APART: "no point light is on a surface",
    Reason.ALONE: "a ray that leaves the only object meets nothing",
    Reason.BLACK: "every material is black",
    Reason.NO_DIFFUSE: "no material has the diffuse one",
    Reason.NO_SPECULAR: "no material has the specular one",
    Reason.UNBOUNDED: "what may still arrive has no known bound",
    Reason.BOUNDED: "no path gets that bright",
    Reason.GRADIENTS: "derivatives are wanted",
}


def held(kernel: KernelPlan, facts: SceneFacts) -> list[str]:
    """Return a line for each thing that the kernels hold."""
    spheres = {"table": "spheres from a table of centres and radii", "corrected": "hits moved onto spheres"}
    lights = {"unrolled": "unrolled", "loop": "in a loop of calls", "table": "in a loop over a table"}
    count = sum(count for kind, count in facts.quadrics if kind in kernel.quadrics)
    lines = {
        "bvh": f"{facts.native_shapes} shapes in Mitsuba's BVH",
        "coherent": "coherent packets of rays",
        "spheres": spheres.get(kernel.spheres, ""),
        "quadrics": f"{count} exact objects in a tree: {', '.join(kernel.quadrics)}",
        "planes": f"{facts.planes} analytic planes",
        "lights": f"{facts.lights} lights, {lights.get(kernel.lights)}",
        "buffers": "light buffers: what may be in the way of each light",
        "eye": "lists of the exact objects that the camera may see",
        "touching": "shadow rays that end short of lights on surfaces",
        "random": "random numbers",
        "emission": "emission of surfaces",
        "sky": {"parameter": "the integrator's sky", "environment": "the scene's sky"}.get(kernel.sky, ""),
        "mirrors": "mirror bounces" if kernel.mirror_rays else "mirror images of the sky",
        "cut_off": "an end of paths too dim to be seen" if 0 < kernel.cut_off.paths < math.inf else "",
        "guarded": "throughputs kept within float32",
        "lobes": f"lobes: {', '.join(kernel.lobes)}",
        "textures": "textures and their coordinates",
        "shading_frames": "shading normals of meshes",
        "tangents": "tangents along texture coordinates",
        "merged": "all materials as one, from a table",
        "two_sided": "light from behind surfaces",
    }
    nothing = (False, "none", ())
    return [text for name, text in lines.items() if text and getattr(kernel, name) not in nothing]


def why(reason: str) -> str:
    """Return the reason against something in words."""
    return WHY.get(Reason(reason), reason.replace("-", " "))
