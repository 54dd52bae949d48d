"""A thing of a home: meshes with the textures they show, under one name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gausslite_sim.mesh import Mesh, Vector


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A mesh that shows one texture, by name."""

    mesh: Mesh
    texture: str

    def place(self, position_m: Vector, yaw_deg: float) -> Part:
        """Turned about z, then moved."""
        return Part(self.mesh.rotate_z(float(np.radians(yaw_deg))).translate(position_m), self.texture)

    def rotate_x(self, pitch_deg: float) -> Part:
        """Turned about x: a positive angle brings the front (-y) down."""
        return Part(self.mesh.rotate_x(float(np.radians(pitch_deg))), self.texture)


@dataclass(frozen=True, slots=True, eq=False)
class Item:
    """A thing with a name; is_room marks walls, floors and ceilings, which are no objects."""

    name: str
    parts: list[Part]
    is_room: bool = False


def place_parts(parts: list[Part], position_m: Vector, yaw_deg: float = 0.0) -> list[Part]:
    """All parts turned about z, then moved."""
    return [part.place(position_m, yaw_deg) for part in parts]
