"""GaussLite: online 3D Gaussian maps that spend their detail on the robot's task.

    import gausslite as gl

    source = gl.open_sequence("sim:home")
    result = gl.map_sequence(source, task="Pick up the mug on the table", frames="0:20", size=(320, 240))
    gl.save_ply("map.ply", result.gaussians)

All names in `__all__` are imported on first use, so `import gausslite` loads neither NumPy nor torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gausslite.api import *
    from gausslite.domain import errors
    from gausslite.domain.errors import GaussLiteError

__all__ = [
    "AgentClient",
    "Answer",
    "BallRegion",
    "CalibratedSequence",
    "Camera",
    "CameraMotion",
    "DepthRegistration",
    "Export",
    "Frame",
    "FrameOutcome",
    "FusionClient",
    "GaussLiteError",
    "Gaussians",
    "Lens",
    "LensModel",
    "MapResult",
    "MissionSettings",
    "ParserClient",
    "PerceptionSettings",
    "PointedObject",
    "PoseExposurePrior",
    "PoseMode",
    "RenderedImage",
    "SceneInfo",
    "Source",
    "Tls",
    "Twist",
    "ask",
    "create_mapper",
    "empty_batch",
    "errors",
    "load_ply",
    "map_sequence",
    "open_calibrated",
    "open_sequence",
    "region_at",
    "region_on_image",
    "render_view",
    "save_ply",
]

_ERRORS = "gausslite.domain.errors"


def __getattr__(name: str) -> Any:
    """Import a public name on first use. Raises AttributeError for other names."""
    if name == "__version__":
        return import_module("gausslite.process").installed_version()
    if name not in __all__:
        raise AttributeError(f"module 'gausslite' has no attribute {name!r}")
    # a program that only catches errors does not load the library
    if name == "errors":
        value: Any = import_module(_ERRORS)
    else:
        value = getattr(import_module(_ERRORS if name == "GaussLiteError" else "gausslite.api"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
