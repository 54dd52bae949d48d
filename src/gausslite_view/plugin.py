"""The plug-in of `gausslite.pages`. Its pages are imported when they are shown: they load viser."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import gausslite_evaluation  # noqa: F401 - all pages show its figures: without it there are none
from gausslite.process import import_extra

if TYPE_CHECKING:
    from gausslite.pages import BeginView
    from gausslite.wire.security import Tls


class ViserPages:
    """Implements `gausslite.pages.Pages`."""

    def require_usable(self, option: str) -> None:
        """Raise InvalidInputError without the extra `view`."""
        import_extra("viser", "view", option)

    def service_page(self, port: int, listen: str, is_agent: bool, tls: Tls | None) -> AbstractContextManager[None]:
        """Show the service of this process."""
        from gausslite_view.pages import service_page

        return service_page(port, listen, is_agent, tls)

    def live_page(self, port: int, address: str, is_agent: bool) -> AbstractContextManager[str]:
        """Show a service without TLS."""
        from gausslite_view.pages import live_page

        return live_page(port, address, is_agent)

    def mission_view(self, port: int) -> AbstractContextManager[BeginView]:
        """Show a mission of this process."""
        from gausslite_view.mission_view import mission_view

        return mission_view(port)

    def write_report(self, path: Path, folders: Sequence[Path]) -> None:
        """Write the report."""
        from gausslite_view.report import write_report

        write_report(path, folders)


PAGES: Final = ViserPages()
