"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

OBJECTS: Final = Command(
    "print where objects are, or which ones a question means, from a fusion server or the results of a run",
    "gausslite_objects.objects_command",
)
EDIT: Final = Command(
    "correct the objects of a run or a team: delete, rename, merge, split, pin, note, undo; name areas",
    "gausslite_objects.edit_command",
)
