"""``mrt_texture``: a picture looked up as the original program does it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .parameters import ParameterError, text


class MrtTexture(mi.Texture):
    r"""The texel nearest to (u, v), as it is stored.

    With u, v clamped to [0, 1] and a picture of w × h texels, column int((w − 1) u + ½) mod w of row
    int((h − 1) v + ½) mod h; v = 0 is the first row of the picture, values are not decoded from sRGB and may
    exceed 1 in all variants (Mitsuba's ``bitmap`` clamps them in spectral ones).

    ============ ========== ========== ==============================================================
    name         type       default    unit or range
    ============ ========== ========== ==============================================================
    ``filename`` string                path of a picture; 8-bit values are divided by 255
    ``bitmap``   ``Bitmap``            in place of a file
    ============ ========== ========== ==============================================================

    .. code-block:: python

        {'type': 'mrt_texture', 'filename': 'wood.png'}

    .. code-block:: xml

        <texture type="mrt_texture"><string name="filename" value="wood.png"/></texture>

    Nearest stock plugin: ``bitmap``, which does the look-up here: with ``filter_type`` "nearest",
    ``wrap_mode`` "clamp", no sRGB decoding and a ``to_uv`` that maps the report's texel centres to its own.
    Its defaults (bilinear, sRGB) are the ``standard`` texturing of this project's scenes.
    """

    def __init__(self, props: mi.Properties) -> None:
        mi.Texture.__init__(self, props)
        bitmap = _read(props)
        width, height = bitmap.size()
        # int((w − 1) u + ½) = floor(w u') with u' = ((w − 1) u + ½) / w; "clamp" takes u' outside [0, 1] to
        # the edge
        scale = [(width - 1) / width, (height - 1) / height, 1]
        to_uv = mi.ScalarTransform4f().translate([0.5 / width, 0.5 / height, 0]).scale(scale)
        stock = {"type": "bitmap", "bitmap": bitmap, "filter_type": "nearest", "wrap_mode": "clamp"}
        # In spectral variants, Mitsuba's textures end at 1: brighter pictures are scaled, as colours are
        brightest = float(np.max(np.array(bitmap)))
        self.scale = 2 * brightest if mi.is_spectral and brightest > 1 else 1.0
        if self.scale > 1:
            stock["bitmap"] = mi.Bitmap(np.array(bitmap) / np.float32(self.scale))
        self.texels = mi.load_dict({**stock, "to_uv": to_uv})

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("texels", self.texels, mi.ParamFlags.Differentiable)

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.UnpolarizedSpectrum:
        return self.scale * self.texels.eval(si, active)

    def eval_1(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
        return self.scale * self.texels.eval_1(si, active)

    def eval_3(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
        return self.scale * self.texels.eval_3(si, active)

    def mean(self) -> mi.Float:
        return self.scale * self.texels.mean()

    def is_spatially_varying(self) -> bool:
        return True

    def resolution(self) -> mi.ScalarVector2i:
        return self.texels.resolution()

    def to_string(self) -> str:
        return f"MrtTexture[texels={self.texels}]"


def _read(props: mi.Properties) -> mi.Bitmap:
    """Return the picture in floats, marked as linear."""
    if ("filename" in props) == ("bitmap" in props):
        raise ParameterError('mrt_texture: give one of "filename" and "bitmap"')
    if "bitmap" in props:
        bitmap = props["bitmap"]
        if not isinstance(bitmap, mi.Bitmap):
            raise ParameterError(f'mrt_texture: "bitmap" is {bitmap!r}, but must be a mi.Bitmap')
    else:
        path = mi.file_resolver().resolve(text(props, "filename"))
        try:
            bitmap = mi.Bitmap(str(path))
            if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
                raise RuntimeError("it has channels that are no colour")
        except RuntimeError as error:
            raise ParameterError(
                f'mrt_texture: "filename" is {str(path)!r}, which cannot be read: {error}'
            ) from None
    bitmap.set_srgb_gamma(False)
    return bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
