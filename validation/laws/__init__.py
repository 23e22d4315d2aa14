"""Laws of BSDFs, shapes and emitters: checks of anyone's plugins by what must hold, without a reference.

Needs Mitsuba, Dr.Jit, NumPy and SciPy; matplotlib for the plots of a page.
"""

from .bsdf import check_bsdf as check_bsdf
from .emitter import check_emitter as check_emitter
from .law import LoadError as LoadError
from .law import UsageError as UsageError
from .page import Check as Check
from .scene import SceneCheck as SceneCheck
from .scene import check_scene as check_scene
from .shape import check_shape as check_shape
