"""Say where an object is among the others: what it is near, on and under, by the relations of a task."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.perception.selector import is_near
from gausslite_objects.edits import box_distance_m
from gausslite_selection.questions import is_on, mapped_landmark


def relations_of(landmark: ObjectLandmark, objects: Sequence[ObjectLandmark], up_axis: UpAxis) -> dict[str, object]:
    """Return the ids that the object is near (with distances of the boxes), on, and under, nearest first."""
    up = np.array(unit_up_axis(up_axis))
    others = [other for other in objects if other.object_id != landmark.object_id]
    others.sort(key=lambda other: box_distance_m(landmark, other))
    mapped = {other.object_id: mapped_landmark(0, other) for other in others}
    own = mapped_landmark(0, landmark)

    near = [other for other in others if is_near(own.seen_from(np.zeros(3)), mapped[other.object_id], up)]
    return {
        "near": [{"id": other.object_id, "distance_m": box_distance_m(landmark, other)} for other in near],
        "on": [other.object_id for other in near if is_on(own, mapped[other.object_id], up)],
        "under": [other.object_id for other in near if is_on(mapped[other.object_id], own, up)],
    }
