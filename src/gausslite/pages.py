"""The protocol of `gausslite.pages`: a running service, a running `map` and finished runs, shown in the browser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

from gausslite.plugins import Group, load

if TYPE_CHECKING:
    from gausslite.mission.schedule import ScheduledTaskMapper
    from gausslite.mission.task_mapper import FrameOutcome
    from gausslite.wire.security import Tls


BeginView: TypeAlias = "Callable[[ScheduledTaskMapper], Callable[[FrameOutcome], None]]"
"""To be called when the mission begins; returns what to call after each frame."""


@runtime_checkable
class Pages(Protocol):
    """Serves pages on the loopback interface; port 0 chooses a free one. Pages raise InvalidInputError for a bad port.

    A page lives until its context ends.
    """

    def require_usable(self, option: str) -> None:
        """Raise InvalidInputError, which names the option, if a package is missing that all pages need."""

    def service_page(self, port: int, listen: str, is_agent: bool, tls: Tls | None) -> AbstractContextManager[None]:
        """Show the service of this process, an agent or a fusion server, and log the page's URL.

        listen: the address at which the service listens. Raises InvalidInputError if its port is 0.
        """

    def live_page(self, port: int, address: str, is_agent: bool) -> AbstractContextManager[str]:
        """Show an agent or a fusion server, also one that starts later; the context gives the page's URL."""

    def mission_view(self, port: int) -> AbstractContextManager[BeginView]:
        """Show a mission of this process, from before it begins, and print the page's URL."""

    def write_report(self, path: Path, folders: Sequence[Path]) -> None:
        """Write one HTML page of results folders. Raises MapFileError for a folder without a run, StorageError."""


def load_pages(purpose: str) -> Pages:
    """Return the installed pages. Raises MissingPluginError, which names the option or file that needs them."""
    pages: Pages = load(Group.PAGES, purpose=purpose)
    return pages
