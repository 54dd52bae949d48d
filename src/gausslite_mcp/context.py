"""Say where an object is among the others: what it is near, on and under, by the relations of a task."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.perception.object_map import Landmark
from gausslite.perception.selector import is_near, is_over
from gausslite_objects.edits import box_distance_m
from gausslite_selection.questions import mapped_landmark


def relations_of(landmark: ObjectLandmark, objects: Sequence[ObjectLandmark], up_axis: UpAxis) -> dict[str, object]:
    """Return the ids that the object is near (with distances of the boxes), on, and under, nearest first."""
    up = np.array(unit_up_axis(up_axis))
    others = [other for other in objects if other.object_id != landmark.object_id]
    others.sort(key=lambda other: box_distance_m(landmark, other))
    mapped = {other.object_id: mapped_landmark(0, other) for other in others}
    own = mapped_landmark(0, landmark)

    def over(one: Landmark, other: Landmark) -> bool:
        return is_over(one.seen_from(np.zeros(3)), other, up)

    near = [other for other in others if is_near(own.seen_from(np.zeros(3)), mapped[other.object_id], up)]
    return {
        "near": [{"id": other.object_id, "distance_m": box_distance_m(landmark, other)} for other in near],
        "on": [other.object_id for other in near if over(own, mapped[other.object_id])],
        "under": [other.object_id for other in near if over(mapped[other.object_id], own)],
    }
