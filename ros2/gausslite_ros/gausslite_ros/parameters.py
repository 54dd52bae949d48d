"""The node's parameters: their defaults, and their check when the node starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from gausslite.datasets.ros.address import BagOptions
from gausslite.datasets.ros.topics import camera_name
from gausslite.domain.errors import InvalidInputError
from gausslite.wire.agent_link import LinkSettings
from gausslite.wire.tls import Tls

_AXES = ("optical", "body")
_LIMITS = (
    ("tolerance_ms", 0.0, 1e4),
    ("max_wait_s", 0.0, 60.0),
    ("transform_tolerance_s", 0.0, 10.0),
    ("tf_period_s", 0.01, 10.0),
    ("period_s", 0.05, 60.0),
    ("drain_s", 0.0, 86400.0),
)
_HANDOVER = {"agent": None, "yes": True, "no": False}


@dataclass(frozen=True, slots=True)
class NodeParameters:
    """Parameters by their names in ROS; docs/guides/bag.md lists them.

    color_info, depth_info "": the camera_info beside the images. camera "": the frame of the colour images.
    transform_tolerance_s: added to the time of the published tf. drain_s 0: as the agent's options. Raises
    InvalidInputError.
    """

    agent: str = "127.0.0.1:50053"
    color: str = "/camera/color/image_raw"
    depth: str = "/camera/aligned_depth_to_color/image_raw"
    color_info: str = ""
    depth_info: str = ""
    frame: str = "odom"
    camera: str = ""
    axes: str = "optical"
    tolerance_ms: float = 20.0
    max_wait_s: float = 1.5
    reliable: bool = False
    task: str = ""
    map_frame: str = "map"
    publish_tf: bool = True
    tf_period_s: float = 0.05
    transform_tolerance_s: float = 0.1
    lossless: bool = False
    end_mission: bool = True
    handover: str = "agent"
    drain_s: float = 0.0
    period_s: float = 1.0
    tls_ca: str = ""
    tls_cert: str = ""
    tls_key: str = ""

    def __post_init__(self) -> None:
        for name in ("agent", "color", "depth", "frame", "map_frame"):
            if not getattr(self, name):
                raise InvalidInputError(f"parameter {name}: expected a name, got an empty text")
        for name, choices in (("axes", _AXES), ("handover", tuple(_HANDOVER))):
            if getattr(self, name) not in choices:
                expected = " or ".join(choices)
                raise InvalidInputError(f"parameter {name}: expected {expected}, got {getattr(self, name)!r}")
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise InvalidInputError(f"parameter {name}: expected {low:g} to {high:g}, got {getattr(self, name)}")
        if self.publish_tf and self.map_frame == self.frame:
            raise InvalidInputError(
                f"parameter map_frame: expected another frame than the poses', got {self.frame!r} for both; "
                "rename it or set publish_tf to false"
            )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> NodeParameters:
        """Return the parameters of these values by name; whole numbers are accepted where a number is expected."""
        chosen: dict[str, Any] = {}
        for field in fields(cls):
            value, default = values.get(field.name, field.default), field.default
            if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
                value = float(value)
            if type(value) is not type(default):
                expected = type(default).__name__
                raise InvalidInputError(f"parameter {field.name}: expected {expected}, got {value!r}")
            chosen[field.name] = value
        return cls(**chosen)

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the defaults by name."""
        return asdict(cls())

    @property
    def color_info_topic(self) -> str:
        """Topic of colour's camera_info."""
        return self.color_info or _beside(self.color)

    @property
    def depth_info_topic(self) -> str:
        """Topic of depth's camera_info, which is used unless depth is aligned to colour."""
        return self.depth_info or _beside(self.depth)

    def topic_options(self) -> BagOptions:
        """Return what the conversion of messages needs."""
        return BagOptions(
            color=self.color,
            depth=self.depth,
            color_info=self.color_info_topic,
            depth_info=self.depth_info,
            frame=self.frame.removeprefix("/"),
            camera=self.camera.removeprefix("/"),
            axes=self.axes,
            tolerance_s=self.tolerance_ms / 1000,
        )

    def link_settings(self) -> LinkSettings:
        """Return what the link to the agent needs."""
        return LinkSettings(
            poll_s=self.period_s,
            lossless=self.lossless,
            handover=_HANDOVER[self.handover],
            drain_s=self.drain_s or None,
        )

    def tls(self) -> Tls | None:
        """Return the encryption of the connection; None without files. Raises InvalidInputError."""
        ca, certificate, key = (Path(name) if name else None for name in (self.tls_ca, self.tls_cert, self.tls_key))
        return None if ca is certificate is key is None else Tls.read(certificate, key, ca)


def _beside(image_topic: str) -> str:
    """Return the camera_info topic beside an image topic, as image_transport names it."""
    return f"{camera_name(image_topic).rpartition('/')[0]}/camera_info"
