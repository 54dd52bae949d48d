"""A rectangular room and the placement of objects in it; the origin is a corner, x and y run along the walls."""

from __future__ import annotations

from typing import Literal

import numpy as np

from gausslite_sim.mesh import box, merge_meshes, panel
from gausslite_sim.scene_objects import Item, Part, place_parts

Wall = Literal["south", "north", "west", "east"]
_THICK_M = 0.06
_SHIFT_M = 0.02
_TURN_DEG = 6.0


class Room:
    """Collects the objects of a room; the random generator jitters movable objects."""

    def __init__(self, length_m: float, width_m: float, height_m: float, rng: np.random.Generator) -> None:
        self.length_m, self.width_m, self.height_m = length_m, width_m, height_m
        self.items: list[Item] = []
        self._rng = rng
        self._build()

    def place(self, name: str, parts: list[Part], x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> None:
        """Place an object at (x, y, z) in metres, its front towards -y rotated by yaw degrees."""
        self.items.append(Item(name, place_parts(parts, (x, y, z), yaw)))

    def place_jittered(
        self, name: str, parts: list[Part], x: float, y: float, z: float = 0.0, yaw: float = 0.0
    ) -> None:
        """Place an object near this pose, with a random shift and rotation."""
        dx, dy = self._rng.uniform(-_SHIFT_M, _SHIFT_M, 2)
        self.place(name, parts, x + dx, y + dy, z, yaw + self._rng.uniform(-_TURN_DEG, _TURN_DEG))

    def place_at_wall(
        self, name: str, parts: list[Part], wall: Wall, along_m: float, z: float = 0.0, off_m: float = 0.0
    ) -> None:
        """Place an object with its back to a wall, at along_m along the wall and off_m metres in front of it."""
        x, y, yaw = {
            "south": (along_m, off_m, 180.0),
            "north": (along_m, self.width_m - off_m, 0.0),
            "west": (off_m, along_m, 90.0),
            "east": (self.length_m - off_m, along_m, -90.0),
        }[wall]
        self.place(name, parts, x, y, z, yaw)

    def _build(self) -> None:
        x, y, z, t = self.length_m, self.width_m, self.height_m, _THICK_M
        walls = [
            panel((x, 0, z), (-x, 0, 0), (0, 0, -z)),
            panel((0, y, z), (x, 0, 0), (0, 0, -z)),
            panel((0, 0, z), (0, y, 0), (0, 0, -z)),
            panel((x, y, z), (0, -y, 0), (0, 0, -z)),
        ]
        boards = [
            box((0, 0, 0), (x, 0.012, 0.09)),
            box((0, y - 0.012, 0), (x, y, 0.09)),
            box((0, 0, 0), (0.012, y, 0.09)),
            box((x - 0.012, 0, 0), (x, y, 0.09)),
        ]
        self.items += [
            Item("walls", [Part(merge_meshes(walls), "wall"), Part(merge_meshes(boards), "trim")], is_structure=True),
            Item("floor", [Part(box((0, 0, -t), (x, y, 0)), "floor")], is_structure=True),
            Item("ceiling", [Part(box((0, 0, z), (x, y, z + t)), "ceiling")], is_structure=True),
        ]
