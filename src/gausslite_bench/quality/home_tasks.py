"""The 24 tasks in simulated homes with the objects in their regions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from gausslite.domain.errors import InvalidInputError


class TaskKind(StrEnum):
    """Kind of task (Sec. IV-A)."""

    MANIPULATION = "manipulation"
    SEARCH = "search"
    NAVIGATION = "navigation"


@dataclass(frozen=True, slots=True)
class HomeTask:
    """A task in a home. objects: names of the ground-truth objects in its region."""

    home: int
    kind: TaskKind
    task: str
    objects: tuple[str, ...]

    @property
    def name(self) -> str:
        """Such as home-3-search."""
        return f"home-{self.home}-{self.kind}"


_OFFICE_DESK = ("laptop", "mug_1", "keyboard_1", "mouse_1", "monitor_1", "papers_1", "pen_cup", "plant_1")
_MEETING_CHAIRS = tuple(f"chair_{i}" for i in range(1, 9))
_TINS = tuple(f"paint_can_{i}" for i in range(1, 6))

HOME_TASKS = (
    HomeTask(1, TaskKind.MANIPULATION, "Prepare to pick up the mug on the coffee table", ("mug_1",)),
    HomeTask(1, TaskKind.SEARCH, "Look for the armchair", ("armchair",)),
    HomeTask(1, TaskKind.NAVIGATION, "Navigate to the sofa", ("sofa",)),
    HomeTask(2, TaskKind.MANIPULATION, "Pick up the mug on the nightstand", ("mug",)),
    HomeTask(2, TaskKind.SEARCH, "Find the shoes next to the bed", ("shoe_1",)),
    HomeTask(2, TaskKind.NAVIGATION, "Go to the dresser", ("dresser",)),
    HomeTask(3, TaskKind.MANIPULATION, "Prepare to pick up the bottles on the counter", ("bottle_1", "bottle_2")),
    HomeTask(3, TaskKind.SEARCH, "Find the bowl on the table", ("bowl",)),
    HomeTask(3, TaskKind.NAVIGATION, "Avoid the chairs", ("chair_1", "chair_2", "chair_3", "chair_4")),
    HomeTask(4, TaskKind.MANIPULATION, "Grab the headphones on the desk", ("headphones",)),
    HomeTask(4, TaskKind.SEARCH, "Look for the plant on the shelf", ("plant_1",)),
    HomeTask(4, TaskKind.NAVIGATION, "Navigate to the desk", ("desk",)),
    HomeTask(5, TaskKind.MANIPULATION, "Prepare to pick up the object on the desk", _OFFICE_DESK),
    HomeTask(5, TaskKind.SEARCH, "Locate the printer", ("printer",)),
    HomeTask(5, TaskKind.NAVIGATION, "Avoid the office chairs", ("chair_1", "chair_2", "chair_3", "chair_4")),
    HomeTask(6, TaskKind.MANIPULATION, "Pick up the laptop and the mug on the table", ("laptop", "mug_1", "mug_2")),
    HomeTask(6, TaskKind.SEARCH, "Search for the screen", ("screen",)),
    HomeTask(6, TaskKind.NAVIGATION, "Locate all chairs and find a path to the door", (*_MEETING_CHAIRS, "door")),
    HomeTask(7, TaskKind.MANIPULATION, "Fetch the teapot from the table", ("teapot",)),
    HomeTask(7, TaskKind.SEARCH, "Look for the plants", ("plant_1", "plant_2", "plant_3")),
    HomeTask(7, TaskKind.NAVIGATION, "Drive to the sofas", ("sofa_1", "sofa_2")),
    HomeTask(8, TaskKind.MANIPULATION, "Prepare to pick up the drill on the workbench", ("drill",)),
    HomeTask(8, TaskKind.SEARCH, "Find the paint cans on the rack", _TINS),
    HomeTask(8, TaskKind.NAVIGATION, "Navigate to the ladder", ("ladder",)),
)


def choose_home_tasks(names: Sequence[str]) -> tuple[HomeTask, ...]:
    """Return the tasks whose name equals or starts with one of these ("home-3" selects three); all without names.

    Raises InvalidInputError.
    """
    chosen = tuple(task for task in HOME_TASKS if not names or any(f"{task.name}-".startswith(f"{n}-") for n in names))
    unknown = [name for name in names if not any(f"{task.name}-".startswith(f"{name}-") for task in chosen)]
    if unknown:
        expected = f"names such as home-3 or home-3-search (1 to 8; {', '.join(TaskKind)})"
        raise InvalidInputError(f"pairs: expected {expected}, got {', '.join(unknown)}")
    return chosen
