"""Open a page; the package of the extra is imported here."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gausslite.export.packages import import_extra
from gausslite.view.level_of_detail import DEFAULT_LIMIT

if TYPE_CHECKING:
    from gausslite.view.map_page import MapPage


def open_page(port: int, title: str, limit: int = DEFAULT_LIMIT) -> MapPage:
    """Serve a page on the loopback interface; port 0 chooses a free one.

    Raises InvalidInputError without the extra `view`, and for a port in use.
    """
    import_extra("viser", "view", "the view")
    from gausslite.view.map_page import MapPage

    return MapPage(port, title, limit)
