"""``matte``: a rough diffuse surface, such as plaster or the moon."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from matte.maths import oren_nayar_cos
from mrt_mitsuba.plugins.parameters import number
from mrt_mitsuba.plugins.variants import first, plain, updatable


class Matte(mi.BSDF):
    """Oren and Nayar's reflection of a surface with random slopes.

    =============== ================ ======= ==============================
    name            type             default unit or range
    =============== ================ ======= ==============================
    ``reflectance`` spectrum/texture 0.5     0 to 1
    ``sigma``       float            0.3     >= 0, standard deviation of
                                             the slopes in radians; 0 is
                                             Lambert's surface
    =============== ================ ======= ==============================

    At grazing angles a white surface gives back up to 1.5 % more than it
    receives: a flaw of the model. Nearest stock plugin: ``diffuse``, which
    is ``sigma`` 0.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        self.reflectance = props.get_texture("reflectance", 0.5)
        self.sigma = updatable(number(props, "sigma", 0.3, least=0))
        self._update()

    def _update(self) -> None:
        # Data of the kernel, not part of its text: a value needs no new one
        dr.make_opaque(self.sigma)
        flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
        if self.reflectance.is_spatially_varying():
            flags |= mi.BSDFFlags.SpatiallyVarying
        self.m_components, self.m_flags = [flags], flags

    # ------------------------- Scene parameters -------------------------

    def traverse(self, callback: Any) -> None:
        callback.put(
            "reflectance", self.reflectance, mi.ParamFlags.Differentiable
        )
        callback.put("sigma", self.sigma, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any = ()) -> None:
        self._update()

    # ------------------------ Value and density -------------------------

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_pdf(
        self, ctx: Any, si: Any, wo: Any, active: Any = True
    ) -> tuple[Any, Any]:
        active = active & ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        active &= (si.wi.z > 0) & (wo.z > 0)
        # Masked lanes get harmless input before the division
        up = mi.Vector3f(0, 0, 1)
        wi = dr.select(active, si.wi, up)
        wo = dr.select(active, wo, up)
        cosine = oren_nayar_cos(wi, wo, plain(self.sigma))
        value = self.reflectance.eval(si, active) * cosine
        density = dr.select(active, dr.inv_pi * wo.z, 0)
        return mi.depolarizer(dr.select(active, value, 0)), density

    # ----------------------------- Sampling -----------------------------

    def sample(
        self,
        ctx: Any,
        si: Any,
        sample1: Any,
        sample2: Any,
        active: Any = True,
    ) -> Any:
        bs = mi.BSDFSample3f()
        bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
        bs.eta = mi.Float(1)
        bs.sampled_component = mi.UInt32(0)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
        drawn = bs.pdf > 0
        return bs, dr.select(drawn, value / dr.select(drawn, bs.pdf, 1), 0)

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        return self.reflectance.eval(si, active)

    def to_string(self) -> str:
        sigma = first(self.sigma)
        return f"Matte[sigma={sigma:g}, reflectance={self.reflectance}]"
