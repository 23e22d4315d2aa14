"""``mrt_bsdf``: the report's reflectance model as a Mitsuba BSDF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from .fresnel import f0_from_ior, fresnel_dielectric, fresnel_schlick
from .lookup import ByShape
from .microfacet import (
    beckmann_d,
    half_vector_angles,
    microfacet_specular,
    sample_beckmann,
    sample_beckmann_visible,
    smith_g1_over_cos,
    tan2_theta,
)
from .parameters import ParameterError, choice, flag, number, spectrum
from .variants import first, is_jit, updatable

FRESNEL_FORMS = ("schlick", "dielectric", "unity")

# Roughness below this (zero included) acts as this: the lobe is then narrower than float32 directions can
# resolve, and D, its inverse square, still fits. Above the other, D is the same everywhere but at the horizon
ALPHA_MIN, ALPHA_MAX = 1e-8, 1e6

# Directions that are nearer to the horizon count as below it: what divides by their cosines stays in float32
COS_MIN = 1e-12

# Indices of textures and of updates, whose values are not checked, are brought between these
IOR_MIN, IOR_MAX = 1e-9, 1e9


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

    def __init__(self, props: mi.Properties):
        mi.BSDF.__init__(self, props)
        self.fresnel = choice(props, "fresnel", FRESNEL_FORMS)
        self.int_ior = self._number_or_texture(props, "int_ior", 1.5, above=0)
        self.ext_ior = self._number_or_texture(props, "ext_ior", 1.0, above=0)
        self.alpha = self._number_or_texture(props, "alpha", 0.1)
        self.diffuse_reflectance = spectrum(props, "diffuse_reflectance", 0.5)
        self.specular_reflectance = spectrum(props, "specular_reflectance", 1.0)
        self.f0 = self._read_f0(props)
        self.sample_visible = flag(props, "sample_visible", True)
        self.version = 0
        self._update()

    @staticmethod
    def _number_or_texture(props, name, default, **limits):
        if name in props and props.type(name) == mi.Properties.Type.Object:
            return spectrum(props, name)
        return updatable(number(props, name, default, **limits))

    def _read_f0(self, props):
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
    def _varies(*parameters) -> bool:
        return any(isinstance(p, mi.Texture) and _varies(p) for p in parameters)

    def traverse(self, callback) -> None:
        flags = mi.ParamFlags.Differentiable
        for name in ("alpha", "int_ior", "ext_ior", "diffuse_reflectance", "specular_reflectance"):
            callback.put(name, getattr(self, name), flags)
        if self.f0 is not None:
            callback.put("f0", self.f0, flags)

    def parameters_changed(self, keys=()) -> None:
        self._update()
        self.version += 1  # what others have derived from the parameters is out of date

    def point(self, si, active) -> _Point:
        """The parameters at a surface point."""
        return _Point(self, si, active)

    def constants(self) -> _Constants | None:
        """The parameters as numbers; None where one varies, has derivatives, or has no place there."""
        names = ("alpha", "int_ior", "ext_ior", "diffuse_reflectance", "specular_reflectance")
        if self.f0 is not None or self._varies(*(getattr(self, name) for name in names)):
            return None
        point = self.point(dr.zeros(mi.SurfaceInteraction3f), True)
        numbers, colors = [point.alpha_given, point.int_ior, point.ext_ior], [point.diffuse, point.specular]
        if dr.grad_enabled(numbers, colors):
            return None
        return _Constants([first(x) for x in numbers], *([first(x) for x in color] for color in colors))

    @staticmethod
    def merged(shapes) -> MrtBSDF | None:
        """One BSDF that is, at each of ``shapes``, what theirs are; None where that cannot be."""
        return _Merged.of(shapes)

    # -------------------------------------- Value and density ------------------------------------------

    def eval(self, ctx, si, wo, active=True):
        return mi.depolarizer(self._value(ctx, self.point(si, active), _Pair.above(si.wi, wo, active)))

    def pdf(self, ctx, si, wo, active=True):
        return self._density(ctx, self.point(si, active), _Pair.above(si.wi, wo, active))

    def eval_pdf(self, ctx, si, wo, active=True):
        point, pair = self.point(si, active), _Pair.above(si.wi, wo, active)
        return mi.depolarizer(self._value(ctx, point, pair)), self._density(ctx, point, pair)

    def _value(self, ctx, point, pair):
        """f cos θo of the enabled lobes."""
        diffuse, specular = self._enabled(ctx)
        value = mi.UnpolarizedSpectrum(0)
        if specular:
            fresnel = point.fresnel(*half_vector_angles(pair.wi, pair.wo))
            lobe = microfacet_specular(pair.wi, pair.wo, pair.tan2_theta_h, point.alpha)
            value += point.specular * fresnel * lobe
        if diffuse:
            value += point.diffuse * (dr.inv_pi * pair.wo.z)
        # The report's G₁ of a negative roughness can be negative; light cannot
        return dr.select(pair.active, dr.maximum(value, 0), 0)

    def _density(self, ctx, point, pair):
        """Density per solid angle with which ``sample`` draws ``pair.wo``."""
        diffuse, specular = self._enabled(ctx)
        density, probability = mi.Float(0), self._specular_probability(ctx, point)
        if specular:
            density += probability * self._specular_density(pair, point.alpha)
        if diffuse:
            density += (1 - probability) * (dr.inv_pi * pair.wo.z)
        return dr.select(pair.active, density, 0)

    def _specular_density(self, pair, alpha):
        """That of the microfacet normal over 4 ωo·h."""
        d = beckmann_d(pair.tan2_theta_h, alpha)
        if self.sample_visible:
            return 0.25 * d * smith_g1_over_cos(pair.wi, dr.abs(alpha))
        # D cos θh / (4 ωo·h), where h = ωi + ωo is not normalised: cos θh = h.z / |h|, ωo·h = |h|² / 2, and
        # |h|² = h.z² (1 + tan²θh). The product ωo·h itself would feel the rounding of ωo's length: by 2 % at
        # cos θ = 1e-3 in float32
        return 0.5 * d / ((pair.wi.z + pair.wo.z) * (1 + pair.tan2_theta_h))

    def _specular_probability(self, ctx, point):
        """Probability of drawing from the specular lobe, after the lobes' reflectances towards ``si.wi``."""
        diffuse, specular = self._enabled(ctx)
        if not (diffuse and specular):
            return mi.Float(1 if specular else 0)
        weight = dr.abs(dr.mean(point.mirror_reflectance))
        total = weight + dr.abs(dr.mean(point.diffuse))
        return dr.select(total > 0, weight / dr.select(total > 0, total, 1), 0.5)

    @staticmethod
    def _enabled(ctx) -> tuple[bool, bool]:
        return (
            ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0),
            ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1),
        )

    # ------------------------------------------- Sampling ----------------------------------------------

    def sample(self, ctx, si, sample1, sample2, active=True):
        point = self.point(si, active)
        above = active & (si.wi.z > COS_MIN)
        wi = dr.select(above, si.wi, mi.Vector3f(0, 0, 1))
        specular = sample1 < self._specular_probability(ctx, point)
        m = self._sample_normal(wi, point.alpha, sample2)
        lambertian = mi.warp.square_to_cosine_hemisphere(sample2)
        wo = dr.select(specular, mi.reflect(wi, m), lambertian)
        # The drawn normal *is* the half vector: of a narrow lobe, wi + wo has lost what sets it apart from n
        tan2_theta_h = dr.select(specular, tan2_theta(m), tan2_theta(wi + lambertian))
        pair = _Pair.above(wi, wo, above, tan2_theta_h)
        pdf = self._density(ctx, point, pair)
        drawn = pdf > 0
        weight = dr.select(drawn, self._value(ctx, point, pair) / dr.select(drawn, pdf, 1), 0)
        return self._record(wo, pdf, specular), mi.depolarizer(weight)

    @staticmethod
    def _record(wo, pdf, specular):
        bs = mi.BSDFSample3f()
        bs.wo, bs.pdf, bs.eta = wo, pdf, mi.Float(1)
        bs.sampled_component = dr.select(specular, mi.UInt32(1), mi.UInt32(0))
        glossy, diffuse = (
            mi.UInt32(+mi.BSDFFlags.GlossyReflection),
            mi.UInt32(+mi.BSDFFlags.DiffuseReflection),
        )
        bs.sampled_type = dr.select(specular, glossy, diffuse)
        return bs

    def _sample_normal(self, wi, alpha, sample2):
        if not self.sample_visible:
            return sample_beckmann(alpha, sample2.x, sample2.y, mi.Vector3f)
        unit = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, 1.0)
        return sample_beckmann_visible(wi, alpha, sample2, unit.sample_visible_11, mi.Vector3f)

    # ------------------------------------------ Attributes ---------------------------------------------

    def eval_diffuse_reflectance(self, si, active=True):
        return mi.Spectrum(self.point(si, active).diffuse)

    def has_attribute(self, name, active=True):
        return name in ("mirror_reflectance", "int_ior")

    def eval_attribute(self, name, si, active=True):
        if name == "mirror_reflectance":
            return self.point(si, active).mirror_reflectance
        raise ParameterError(f'mrt_bsdf: no spectrum attribute "{name}"; there is "mirror_reflectance"')

    def eval_attribute_1(self, name, si, active=True):
        if name == "int_ior":
            return self.point(si, active).int_ior
        raise ParameterError(f'mrt_bsdf: no scalar attribute "{name}"; there is "int_ior"')

    def mirror_bound(self) -> tuple[float, float]:
        """An upper bound of ``mirror_reflectance``, and ``int_ior``; inf where they vary or are unknown."""
        reflectance = self._largest(self.specular_reflectance)
        if self.f0 is not None:
            reflectance *= max(1, self._largest(self.f0))
        int_ior = float("inf") if isinstance(self.int_ior, mi.Texture) else first(self.int_ior)
        return reflectance, int_ior

    @staticmethod
    def _largest(texture) -> float:
        if _varies(texture) or mi.is_spectral:
            return float("inf")
        return max(abs(first(x)) for x in texture.eval(dr.zeros(mi.SurfaceInteraction3f)))

    def to_string(self) -> str:
        names = ("alpha", "int_ior", "ext_ior", "diffuse_reflectance", "specular_reflectance", "f0")
        return f"MrtBSDF[fresnel={self.fresnel}, " + ", ".join(f"{n}={getattr(self, n)}" for n in names) + "]"


def _varies(texture) -> bool:
    """Is a texture not the same everywhere? Mitsuba's ``mesh_attribute`` denies it, and needs a shape."""
    return texture.is_spatially_varying() or texture.class_name() == "MeshAttribute"


class _Point:
    """The parameters at a surface point; each is read when it is first asked for, and once."""

    def __init__(self, bsdf: MrtBSDF, si, active):
        self.bsdf, self.si, self.active = bsdf, si, active

    def _read(self, name: str):
        parameter = getattr(self.bsdf, name)
        if isinstance(parameter, mi.Texture):
            return parameter.eval_1(self.si, self.active)
        return parameter if is_jit() else first(parameter)

    @cached_property
    def alpha_given(self):
        return self._read("alpha")

    @cached_property
    def alpha(self):
        alpha = self.alpha_given
        size = _within(dr.abs(alpha), ALPHA_MIN, ALPHA_MAX)
        return dr.select(alpha < 0, -size, size)

    @cached_property
    def int_ior(self):
        return self._read("int_ior")

    @cached_property
    def ext_ior(self):
        return self._read("ext_ior")

    @cached_property
    def diffuse(self):
        return self.bsdf.diffuse_reflectance.eval(self.si, self.active)

    @cached_property
    def specular(self):
        return self.bsdf.specular_reflectance.eval(self.si, self.active)

    def fresnel(self, cos_theta, sin2_theta):
        """F at a microfacet: a float, or a spectrum where ``f0`` was given."""
        if self.bsdf.fresnel == "unity":
            return mi.Float(1)
        ext_ior, int_ior = (_within(ior, IOR_MIN, IOR_MAX) for ior in (self.ext_ior, self.int_ior))
        if self.bsdf.fresnel == "dielectric":
            return fresnel_dielectric(cos_theta, ext_ior, int_ior, sin2_theta)
        given = self.bsdf.f0
        f0 = f0_from_ior(ext_ior, int_ior) if given is None else given.eval(self.si, self.active)
        return fresnel_schlick(cos_theta, f0, sin2_theta)

    @cached_property
    def mirror_reflectance(self):
        """k_s F(θi): what a perfect mirror in place of the lobe would reflect; 0 from behind."""
        wi = self.si.wi
        above = wi.z > COS_MIN
        sin2_theta = dr.square(wi.x) + dr.square(wi.y)
        fresnel = self.fresnel(dr.select(above, wi.z, 1), dr.select(above, sin2_theta, 0))
        return dr.select(above, self.specular * fresnel, 0)


def _within(x, least: float, most: float):
    """``x`` between two limits; NaN gives the lower one."""
    return dr.select(x >= least, dr.minimum(x, most), least)


@dataclass
class _Pair:
    """Two directions, above the surface where ``active``, and tan² of their half vector's angle to z."""

    wi: mi.Vector3f
    wo: mi.Vector3f
    tan2_theta_h: mi.Float
    active: mi.Bool

    @classmethod
    def above(cls, wi, wo, active, tan2_theta_h=None) -> _Pair:
        above_i, above_o = wi.z > COS_MIN, active & (wo.z > COS_MIN)
        # Masked lanes get harmless directions: scalar variants raise on 0/0, and no NaN is born. What depends
        # on wi alone is computed once for all wo
        up = mi.Vector3f(0, 0, 1)
        wi, wo, active = dr.select(above_i, wi, up), dr.select(above_o, wo, up), above_i & above_o
        return cls(wi, wo, tan2_theta(wi + wo) if tan2_theta_h is None else tan2_theta_h, active)


# --------------------------------------------- Many as one ----------------------------------------------


@dataclass
class _Constants:
    """Parameters that are the same everywhere."""

    numbers: list[float]  # alpha, int_ior, ext_ior
    diffuse: list[float]  # of each channel
    specular: list[float]


class _Merged(MrtBSDF):
    """An ``mrt_bsdf`` whose parameters are those of the shape that was hit, looked up in tables.

    Mitsuba calls each BSDF of a scene in turn, and the Python code of each runs to record the call: 1 ms for
    an instance, at every render. This one is recorded once, for any number of materials.
    """

    def __init__(self, shapes, constants: list[_Constants]):
        # Without mi.BSDF.__init__, by which Dr.Jit would come to know one more BSDF and record its calls in
        # the kernels of every scene: this one is called from Python only
        self.fresnel, self.f0 = shapes[0].bsdf().fresnel, None
        self.numbers, self.diffuse, self.specular = (
            ByShape(mi.Vector4f, shapes, [[*row, *[0] * (4 - len(row))] for row in rows], [1] * 4)
            for rows in zip(*(vars(c).values() for c in constants), strict=True)
        )

    @classmethod
    def of(cls, shapes) -> _Merged | None:
        """None where a BSDF is of another kind, varies over a surface, or its derivatives are wanted."""
        bsdfs = {id(b): b for b in (s.bsdf() for s in shapes)}
        # Inside an instance, shapes are not the scene's own
        if not is_jit() or mi.is_spectral or any(s.class_name() == "Instance" for s in shapes):
            return None
        if (
            not all(type(b) is MrtBSDF for b in bsdfs.values())
            or len({b.fresnel for b in bsdfs.values()}) != 1
        ):
            return None
        constants = {key: b.constants() for key, b in bsdfs.items()}
        if None in constants.values():
            return None
        return cls(shapes, [constants[id(s.bsdf())] for s in shapes])

    def point(self, si, active):
        return _Row(self, si, active)


class _Row(_Point):
    """The parameters of the shape at a surface point."""

    def __init__(self, merged: _Merged, si, active):
        super().__init__(merged, si, active)
        # One mask for all lights, or they would be looked up for each
        everywhere = mi.Bool(True)
        self.alpha_given, self.int_ior, self.ext_ior, _ = merged.numbers(si, everywhere)
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        self.diffuse, self.specular = (
            mi.UnpolarizedSpectrum(list(color(si, everywhere))[:channels])
            for color in (merged.diffuse, merged.specular)
        )


mi.register_bsdf("mrt_bsdf", MrtBSDF)
