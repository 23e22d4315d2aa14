"""``mrt_bsdf``: the report's reflectance model as a Mitsuba BSDF."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .emission import largest
from .fresnel import f0_from_ior
from .kernel_plan import MaterialRows, Mirror, Reason
from .lobes import ALPHA_MAX, ALPHA_MIN, Lobes, Pair
from .parameters import ParameterError, choice, flag, number, spectrum
from .protocols import MergeableBSDF
from .variants import first, is_jit, updatable, varies, varies_by_face

FRESNEL_FORMS = ("schlick", "dielectric", "unity")

# Names of the parameters under ``mi.traverse``
NUMBERS, COLORS = ("alpha", "int_ior", "ext_ior"), ("diffuse_reflectance", "specular_reflectance")


class MrtBSDF(mi.BSDF):
    r"""Lambertian base under a Beckmann microfacet lobe, as in the original ray tracer.

    .. math::
        f = \frac{k_d}{\pi} + k_s \frac{F(\omega_i \cdot h)\, D(h)\, G_1(\omega_i) G_1(\omega_o)}
                                       {4 \cos\theta_i \cos\theta_o}

    with Beckmann's D, the rational fit of Smith's G₁ (Walter et al. 2007) and one of three Fresnel terms. The
    two lobes are simply added, so energy is conserved only where k_d and k_s promise it.

    ======================== ================ ========= ====================================================
    name                     type             default   unit or range
    ======================== ================ ========= ====================================================
    ``alpha``                float or texture 0.1       roughness; 0 acts as 1e-8, a negative value keeps
                                                        its sign in G₁ (scene 2 of the report holds some),
                                                        and where f would be negative it is 0
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
    the side of the normal only. The attribute ``mirror_reflectance`` (``eval_attribute``) is k_s F(θi), the
    weight that ``mrt_whitted`` gives to the mirror ray, and ``int_ior`` (``eval_attribute_1``) drives its
    bounce budget.
    In polarised variants the reflected light is depolarised.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        self.fresnel = choice(props, "fresnel", FRESNEL_FORMS)
        self.int_ior = self._number_or_texture(props, "int_ior", 1.5, above=0)
        self.ext_ior = self._number_or_texture(props, "ext_ior", 1.0, above=0)
        self.alpha = self._number_or_texture(props, "alpha", 0.1)
        self.diffuse_reflectance = spectrum(props, "diffuse_reflectance", 0.5)
        self.specular_reflectance = spectrum(props, "specular_reflectance", 1.0)
        self.f0 = self._read_f0(props)
        self.sample_visible = flag(props, "sample_visible", True)
        self._update()

    @staticmethod
    def _number_or_texture(props: mi.Properties, name: str, default: float, **limits: float) -> Any:
        if name in props and props.type(name) == mi.Properties.Type.Object:
            return spectrum(props, name)
        return updatable(number(props, name, default, **limits))

    def _read_f0(self, props: mi.Properties) -> mi.Texture | None:
        if "f0" not in props:
            return None
        if self.fresnel != "schlick":
            raise ParameterError(
                f'mrt_bsdf: "f0" has no meaning with fresnel="{self.fresnel}"; leave one of them out'
            )
        return spectrum(props, "f0")

    def _update(self) -> None:
        # Opaque numbers travel as data: instances share one compiled function, new values need no new kernel
        dr.make_opaque(
            *(p for p in (self.alpha, self.int_ior, self.ext_ior) if not isinstance(p, mi.Texture))
        )
        diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
        glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        if self._varies(self.diffuse_reflectance):
            diffuse |= mi.BSDFFlags.SpatiallyVarying
        if self._varies(self.specular_reflectance, self.alpha, self.int_ior, self.ext_ior, self.f0):
            glossy |= mi.BSDFFlags.SpatiallyVarying
        self.m_components = [diffuse, glossy]
        self.m_flags = diffuse | glossy

    @staticmethod
    def _varies(*parameters: Any) -> bool:
        return any(isinstance(p, mi.Texture) and varies(p) for p in parameters)

    def traverse(self, callback: Any) -> None:
        flags = mi.ParamFlags.Differentiable
        for name in (*NUMBERS, *COLORS):
            callback.put(name, getattr(self, name), flags)
        if self.f0 is not None:
            callback.put("f0", self.f0, flags)

    def parameters_changed(self, keys: Any = ()) -> None:
        self._update()

    def lobes(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Lobes:
        """Return the lobes at a surface point."""
        return Lobes(self.fresnel, _PointParameters(self, si, active), si.wi, visible=self.sample_visible)

    def rows(self, points: mi.SurfaceInteraction3f | None = None) -> MaterialRows | Reason:
        """Return the parameters as plain numbers, or why they are none.

        ``points``: one surface point on each object of a shape, for textures that vary from face to face.
        """
        varying = [p for p in (getattr(self, name) for name in (*NUMBERS, *COLORS)) if self._varies(p)]
        if self.f0 is not None or not all(points is not None and varies_by_face(p) for p in varying):
            return Reason.VARYING
        count = 1 if points is None else dr.width(points)
        point = _PointParameters(self, dr.zeros(mi.SurfaceInteraction3f) if points is None else points, True)
        values = [point.alpha, point.int_ior, point.ext_ior], point.diffuse, point.specular
        if dr.grad_enabled(values):
            return Reason.GRADIENTS
        rows = (np.stack([np.broadcast_to(x, count) for x in value], axis=1) for value in values)
        return MaterialRows(*rows)

    # -------------------------------------- Value and density ------------------------------------------

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Spectrum:
        return mi.depolarizer(self.lobes(si, active).value(ctx, Pair.above(si.wi, wo, active)))

    def pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Float:
        return self.lobes(si, active).density(ctx, Pair.above(si.wi, wo, active))

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        lobes, pair = self.lobes(si, active), Pair.above(si.wi, wo, active)
        return mi.depolarizer(lobes.value(ctx, pair)), lobes.density(ctx, pair)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        lobes = self.lobes(si, active)
        wo, pair, specular = lobes.sample(ctx, sample1, sample2, active)
        pdf = lobes.density(ctx, pair)
        drawn = pdf > 0
        weight = dr.select(drawn, lobes.value(ctx, pair) / dr.select(drawn, pdf, 1), 0)
        bs = mi.BSDFSample3f()
        bs.wo, bs.pdf, bs.eta = wo, pdf, mi.Float(1)
        bs.sampled_component = dr.select(specular, mi.UInt32(1), mi.UInt32(0))
        glossy, diffuse = mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection
        bs.sampled_type = dr.select(specular, mi.UInt32(+glossy), mi.UInt32(+diffuse))
        return bs, mi.depolarizer(weight)

    # ------------------------------------------ Attributes ---------------------------------------------

    def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(self.diffuse_reflectance.eval(si, active))

    def has_attribute(self, name: str, active: mi.Bool = True) -> mi.Bool:
        return name in ("mirror_reflectance", "int_ior")

    def eval_attribute(
        self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool = True
    ) -> mi.UnpolarizedSpectrum:
        if name == "mirror_reflectance":
            return self.lobes(si, active).mirror_reflectance
        raise ParameterError(f'mrt_bsdf: no spectrum attribute "{name}"; there is "mirror_reflectance"')

    def eval_attribute_1(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
        if name == "int_ior":
            return _PointParameters(self, si, active).int_ior
        raise ParameterError(f'mrt_bsdf: no scalar attribute "{name}"; there is "int_ior"')

    def mirror_bound(self) -> Mirror:
        """Return upper bounds of ``mirror_reflectance``, and ``int_ior``; inf for what varies."""
        reflectance, f0 = largest(self.specular_reflectance), self._f0_bound()
        int_ior = float("inf") if isinstance(self.int_ior, mi.Texture) else first(self.int_ior)
        return Mirror(reflectance * max(1, f0), int_ior, reflectance * f0)

    def value_bound(self) -> float:
        """Return an upper bound of f cos θ; inf where a parameter varies.

        D is largest at tan²θ = 2 α² - 1, else at 0. G₁ / cos θ is 1 / cos θ up to α tan θ = 1/1.6 and at most
        3.535 / (α sin θ) beyond. A negative α has |G₁| < 3 in place of 1, twice.
        """
        if isinstance(self.alpha, mi.Texture):
            return float("inf")
        alpha = min(max(abs(first(self.alpha)), ALPHA_MIN), ALPHA_MAX)
        peak = max(1, 4 * alpha**4 * math.exp(1 / alpha**2 - 2)) if 2 * alpha**2 > 1 else 1
        shadowed = 5.66 * math.sqrt(1 + 0.4 / alpha**2) * (9 if first(self.alpha) < 0 else 1)
        lobe = 0.25 * peak / (math.pi * alpha**2) * shadowed
        fresnel = max(1, self._f0_bound())
        specular = largest(self.specular_reflectance)
        return largest(self.diffuse_reflectance) / math.pi + (specular * fresnel * lobe if specular else 0)

    def _f0_bound(self) -> float:
        """Return an upper bound of the reflectance at normal incidence."""
        if self.f0 is not None:
            return largest(self.f0)
        varying = isinstance(self.int_ior, mi.Texture) or isinstance(self.ext_ior, mi.Texture)
        if self.fresnel == "unity" or varying:
            return 1.0
        return f0_from_ior(first(self.ext_ior), first(self.int_ior))

    def to_string(self) -> str:
        names = (*NUMBERS, *COLORS, "f0")
        return f"MrtBSDF[fresnel={self.fresnel}, " + ", ".join(f"{n}={getattr(self, n)}" for n in names) + "]"


def _number(name: str) -> Any:
    def read(point: _PointParameters) -> mi.Float:
        parameter = getattr(point.bsdf, name)
        if isinstance(parameter, mi.Texture):
            return parameter.eval_1(point.si, point.active)
        return parameter if is_jit() else first(parameter)

    return cached_property(read)


def _color(name: str) -> Any:
    def read(point: _PointParameters) -> mi.UnpolarizedSpectrum | None:
        texture = getattr(point.bsdf, name)
        return None if texture is None else texture.eval(point.si, point.active)

    return cached_property(read)


class _PointParameters:
    """The parameters at a surface point; each is read when it is first asked for, and once."""

    alpha, int_ior, ext_ior = map(_number, NUMBERS)
    diffuse, specular, f0 = map(_color, (*COLORS, "f0"))

    def __init__(self, bsdf: MrtBSDF, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
        self.bsdf, self.si, self.active = bsdf, si, active


MergeableBSDF.register(MrtBSDF)
mi.register_bsdf("mrt_bsdf", MrtBSDF)
