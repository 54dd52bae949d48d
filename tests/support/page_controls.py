"""What a person sees and does on a page, without a browser: its contents, its controls, texts, images and plots."""

from collections.abc import Callable, Iterator
from typing import Any

import viser
from waiting import wait_until

from gausslite.domain.gaussians import Gaussians
from gausslite_view.contents import ViewContents
from gausslite_view.map_page import MapPage


class SeenPage(MapPage):
    """A page on a free port that remembers the newest contents that it was given."""

    def __init__(self) -> None:
        super().__init__(0, "test")
        self.contents = ViewContents.of_one_agent(Gaussians.empty())

    def show(self, contents: ViewContents) -> None:
        self.contents = contents
        super().show(contents)


def poll_until(poll: Callable[[], None], condition: Callable[[], bool]) -> None:
    """Poll what feeds a page until the condition is true."""

    def is_reached() -> bool:
        poll()
        return condition()

    wait_until(is_reached)


def items(page: MapPage) -> Iterator[Any]:
    """Yield all that stands in the page's panel, folders before what they contain."""
    # viser has no public list of them
    waiting = list(page.server.gui._container_handle_from_uuid["root"]._children.values())
    while waiting:
        item = waiting.pop(0)
        yield item
        waiting[:0] = getattr(item, "_children", {}).values()


def control(page: MapPage, label: str) -> Any:
    """Return the control with this label; a folder, which has no value, may have the same one."""
    return next(item for item in items(page) if hasattr(item, "value") and getattr(item, "label", None) == label)


def text(page: MapPage) -> str:
    """Return all texts of the panel."""
    return "\n".join(item.content for item in items(page) if isinstance(item, viser.GuiHtmlHandle))


def images(page: MapPage) -> list[viser.GuiImageHandle]:
    """Return the images of the panel, from the first to the last."""
    shown = [item for item in items(page) if isinstance(item, viser.GuiImageHandle)]
    return sorted(shown, key=lambda image: image.order)


def plot(page: MapPage, title: str) -> dict[str, Any]:
    """Return the values of each line of the plot with this title by name, and the times as `s`."""
    found = next(item for item in items(page) if getattr(item, "title", None) == title)
    lines = zip(found.series, found.data, strict=True)
    return {line["label"]: values for line, values in lines} if found.visible else {}
