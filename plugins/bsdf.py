"""``mrt_bsdf``: the report's reflectance model as a Mitsuba BSDF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from operator import or_
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .fresnel import f0_from_ior
from .lobes import CHOICES, LOBES, NUMBERS, Lobes, Pair
from .parameters import ParameterError, choice, flag, number, spectrum
from .variants import first, largest, plain, updatable, varies
from .whitted.plan import GRADIENTS, VARYING, Mirror


class MrtBSDF(mi.BSDF):
    r"""Lambertian base under a microfacet lobe, as in the original ray tracer.

    .. math::
        f = \frac{k_d}{\pi} + k_s \frac{F(\omega_i \cdot h)\, D(h)\, G_1(\omega_i) G_1(\omega_o)}
                                       {4 \cos\theta_i \cos\theta_o}

    with one of two distributions D, each with Smith's G₁ (Walter et al. 2007; that of Beckmann by a rational
    fit), and one of three Fresnel terms. The two lobes are simply added, so energy is conserved only where
    k_d and k_s promise it.

    ======================== ================ ========= ====================================================
    name                     type             default   unit or range
    ======================== ================ ========= ====================================================
    ``distribution``         string           beckmann  ``beckmann``, or ``ggx``, with longer tails
    ``alpha``                float or texture 0.1       roughness; 0 acts as 1e-8. A negative value keeps its
                                                        sign in Beckmann's G₁ (scene 2 of the report holds
                                                        some), and where f would be negative it is 0
    ``int_ior``              float or texture 1.5       > 0, index of refraction inside
    ``ext_ior``              float or texture 1.0       > 0, index of refraction outside
    ``diffuse_reflectance``  spectrum/texture 0.5       k_d, may exceed 1
    ``specular_reflectance`` spectrum/texture 1.0       k_s, may exceed 1
    ``fresnel``              string           schlick   ``schlick``, ``dielectric`` (exact), ``unity`` (F = 1)
    ``f0``                   spectrum/texture from IORs Schlick only: reflectance at normal incidence
    ``sample_visible``       boolean          true      sample visible normals instead of D
    ======================== ================ ========= ====================================================

    .. code-block:: python

        {'type': 'mrt_bsdf', 'alpha': 0.06, 'int_ior': 1.38,
         'diffuse_reflectance': {'type': 'rgb', 'value': [0.2, 0.4, 0.3]},
         'specular_reflectance': {'type': 'rgb', 'value': 0.2}}

    .. code-block:: xml

        <bsdf type="mrt_bsdf">
            <float name="alpha" value="0.06"/>
            <float name="int_ior" value="1.38"/>
            <rgb name="diffuse_reflectance" value="0.2, 0.4, 0.3"/>
            <rgb name="specular_reflectance" value="0.2"/>
        </bsdf>

    Nearest stock plugins: ``roughconductor`` (same D and G, exact conductor Fresnel, no diffuse part) and
    ``roughplastic`` (same lobes, but the diffuse part is refracted through the interface). Reflection is on
    the side of the normal only. Attributes (``has_attribute``, ``eval_attribute``) are all parameters that
    are numbers, spectra or textures, and ``mirror_reflectance``, k_s F(θi), the weight that ``mrt_whitted``
    gives to the mirror ray; ``int_ior`` drives its bounce budget.
    In polarised variants the reflected light is depolarised. Samples and their density are constants in
    derivatives: ``sample`` returns the value, which follows the parameters, over the density, which does not.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        self.choices = {name: choice(props, name, allowed) for name, allowed in CHOICES.items()}
        self.sample_visible = flag(props, "sample_visible", True)
        self.parameters: dict[str, Any] = {}
        for name, (default, limits) in NUMBERS.items():
            textured = name in props and props.type(name) == mi.Properties.Type.Object
            self.parameters[name] = (
                spectrum(props, name) if textured else updatable(number(props, name, default, **limits))
            )
        for lobe in LOBES:
            self.parameters[lobe.reflectance] = spectrum(props, lobe.reflectance, lobe.default)
        if "f0" in props:
            fresnel = self.choices["fresnel"]
            if fresnel != "schlick":
                raise ParameterError(
                    f'mrt_bsdf: "f0" has no meaning with fresnel="{fresnel}"; leave one of them out'
                )
            self.parameters["f0"] = spectrum(props, "f0")
        self._update()

    def _update(self) -> None:
        # Opaque numbers travel as data: instances share one compiled function, new values need no new kernel
        dr.make_opaque(*(p for p in self.parameters.values() if not isinstance(p, mi.Texture)))
        components = []
        for lobe in LOBES:
            flags = getattr(mi.BSDFFlags, lobe.flag) | mi.BSDFFlags.FrontSide
            if any(varies(self.parameters.get(name)) for name in (lobe.reflectance, *lobe.depends_on)):
                flags |= mi.BSDFFlags.SpatiallyVarying
            components.append(flags)
        self.m_components = components
        self.m_flags = reduce(or_, components)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, parameter in self.parameters.items():
            callback.put(name, parameter, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        self._update()

    def _read(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return a parameter at a surface point."""
        parameter = self.parameters[name]
        if isinstance(parameter, mi.Texture):
            return parameter.eval_1(si, active) if name in NUMBERS else parameter.eval(si, active)
        return plain(parameter)

    def lobes(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Lobes:
        """Return the lobes at a surface point."""
        given = {name: self._read(name, si, active) for name in self.parameters}
        return Lobes(self.choices, given, si.wi, visible=self.sample_visible)

    def fixed_row(self) -> np.ndarray | str:
        """Return the parameters as plain numbers [2 + lobes, 4], or why they are none: numbers, a reflectance
        for each lobe, and that at normal incidence.
        """
        if any(map(varies, self.parameters.values())):
            return VARYING
        given = self.lobes(dr.zeros(mi.SurfaceInteraction3f), True).given
        if dr.grad_enabled(given):
            return GRADIENTS
        row = np.zeros((2 + len(LOBES), 4))
        iors = (np.float32(first(given[name][0])) for name in ("ext_ior", "int_ior"))
        f0 = float(f0_from_ior(*iors))  # on the host: no kernel for each material
        from_iors = [f0] * len(given[LOBES[0].reflectance])
        colors = [given[lobe.reflectance] for lobe in LOBES] + [given.get("f0", from_iors)]
        parts = [given[name] for name in NUMBERS], *colors
        for k, part in enumerate(parts):
            row[k, : len(part)] = [first(value) for value in part]
        return row

    # -------------------------------------- Value and density ------------------------------------------

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Spectrum:
        pair = Pair.above(si.wi, wo, active)
        return mi.depolarizer(self.lobes(si, active).value(ctx, pair))

    def pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Float:
        pair = Pair.above(si.wi, wo, active)
        return self.lobes(si, active).density(ctx, pair)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        lobes = self.lobes(si, active)
        wo, pair, component = lobes.sample(ctx, sample1, sample2, active)
        pdf = lobes.density(ctx, pair)
        drawn = pdf > 0
        divisor = dr.select(drawn, dr.detach(pdf), 1)
        weight = dr.select(drawn, lobes.value(ctx, pair) / divisor, 0)
        bs = mi.BSDFSample3f()
        bs.wo = wo
        bs.pdf = pdf
        bs.eta = mi.Float(1)
        bs.sampled_component = component
        bs.sampled_type = mi.UInt32(0)
        for k, lobe in enumerate(LOBES):
            kind = mi.UInt32(+getattr(mi.BSDFFlags, lobe.flag))
            bs.sampled_type = dr.select(component == k, kind, bs.sampled_type)
        return bs, mi.depolarizer(weight)

    # ------------------------------------------ Attributes ---------------------------------------------

    def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(self._read("diffuse_reflectance", si, active))

    # All parameters, and ``mirror_reflectance``. Calls for other names must not raise: Dr.Jit records them
    # for every material of a scene

    def has_attribute(self, name: str, active: mi.Bool = True) -> mi.Bool:
        return name == "mirror_reflectance" or name in self.parameters

    def eval_attribute(
        self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool = True
    ) -> mi.UnpolarizedSpectrum:
        if name == "mirror_reflectance":
            return self.lobes(si, active).mirror_reflectance
        if name in self.parameters:
            return mi.UnpolarizedSpectrum(self._read(name, si, active))
        return mi.BSDF.eval_attribute(self, name, si, active)

    def eval_attribute_1(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
        parameter = self.parameters.get(name)
        if isinstance(parameter, mi.Texture):
            return parameter.eval_1(si, active)
        if parameter is not None:
            return plain(parameter)
        return mi.BSDF.eval_attribute_1(self, name, si, active)

    def eval_attribute_3(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
        if name in NUMBERS:
            return mi.Color3f(self._read(name, si, active))
        return mi.BSDF.eval_attribute_3(self, name, si, active)

    def mirror_bound(self) -> Mirror:
        """Return upper bounds of ``mirror_reflectance``, and ``int_ior``; inf for what varies."""
        bound = largest(self.parameters["specular_reflectance"])
        int_ior = self.parameters["int_ior"]
        indices = self.parameters["ext_ior"], int_ior
        f0 = 1.0
        if "f0" in self.parameters:
            f0 = largest(self.parameters["f0"])
        elif self.choices["fresnel"] != "unity" and not any(
            isinstance(index, mi.Texture) for index in indices
        ):
            f0 = f0_from_ior(*map(first, indices))
        index = math.inf if isinstance(int_ior, mi.Texture) else first(int_ior)
        return Mirror(bound * max(1, f0), index, bound * f0)

    def to_string(self) -> str:
        parameters = self.choices | self.parameters | {"f0": self.parameters.get("f0")}
        text = ", ".join(f"{name}={parameter}" for name, parameter in parameters.items())
        return f"MrtBSDF[{text}]"
