"""Objects of a simulated home: a name, and meshes with textures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gausslite_sim.mesh import Mesh, Vector


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A mesh, in metres, with the name of its texture."""

    mesh: Mesh
    texture: str

    def place(self, position_m: Vector, yaw_deg: float) -> Part:
        """Return the part rotated about z, then translated."""
        return Part(self.mesh.rotate_z(float(np.radians(yaw_deg))).translate(position_m), self.texture)

    def rotate_x(self, pitch_deg: float) -> Part:
        """Return the part rotated about x: a positive angle lowers the front (-y)."""
        return Part(self.mesh.rotate_x(float(np.radians(pitch_deg))), self.texture)


@dataclass(frozen=True, slots=True, eq=False)
class Item:
    """A named object; is_structure: it is a wall, floor or ceiling, which tasks never name."""

    name: str
    parts: list[Part]
    is_structure: bool = False


def place_parts(parts: list[Part], position_m: Vector, yaw_deg: float = 0.0) -> list[Part]:
    """Return all parts rotated about z, then translated."""
    return [part.place(position_m, yaw_deg) for part in parts]
