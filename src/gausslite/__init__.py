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
    from gausslite.api import (
        CalibratedSequence,
        MapResult,
        RenderedImage,
        create_mapper,
        load_ply,
        map_sequence,
        open_calibrated,
        open_sequence,
        render_view,
        save_ply,
    )
    from gausslite.datasets.registered_source import DepthRegistration
    from gausslite.datasets.source import Source
    from gausslite.domain.camera import Camera
    from gausslite.domain.errors import GaussLiteError
    from gausslite.domain.frame import Frame
    from gausslite.domain.gaussians import Gaussians
    from gausslite.domain.pose_exposure_prior import PoseExposurePrior
    from gausslite.domain.region import BallRegion
    from gausslite.domain.voxel_operations import empty_batch
    from gausslite.mission.settings import MissionSettings, PerceptionSettings, SceneInfo
    from gausslite.wire.clients import AgentClient, FusionClient
    from gausslite.wire.tls import Tls

__version__ = "0.1.0"

_MODULES = {
    "gausslite.api": (
        "CalibratedSequence",
        "MapResult",
        "RenderedImage",
        "create_mapper",
        "load_ply",
        "map_sequence",
        "open_calibrated",
        "open_sequence",
        "render_view",
        "save_ply",
    ),
    "gausslite.domain.pose_exposure_prior": ("PoseExposurePrior",),
    "gausslite.datasets.registered_source": ("DepthRegistration",),
    "gausslite.datasets.source": ("Source",),
    "gausslite.domain.camera": ("Camera",),
    "gausslite.domain.frame": ("Frame",),
    "gausslite.domain.gaussians": ("Gaussians",),
    "gausslite.domain.region": ("BallRegion",),
    "gausslite.domain.voxel_operations": ("empty_batch",),
    "gausslite.domain.errors": ("GaussLiteError",),
    "gausslite.mission.settings": ("MissionSettings", "PerceptionSettings", "SceneInfo"),
    "gausslite.wire.clients": ("AgentClient", "FusionClient"),
    "gausslite.wire.tls": ("Tls",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "AgentClient",
    "BallRegion",
    "CalibratedSequence",
    "Camera",
    "DepthRegistration",
    "Frame",
    "FusionClient",
    "GaussLiteError",
    "Gaussians",
    "MapResult",
    "MissionSettings",
    "PerceptionSettings",
    "PoseExposurePrior",
    "RenderedImage",
    "SceneInfo",
    "Source",
    "Tls",
    "create_mapper",
    "empty_batch",
    "load_ply",
    "map_sequence",
    "open_calibrated",
    "open_sequence",
    "render_view",
    "save_ply",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use. Raises AttributeError for other names."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'gausslite' has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
