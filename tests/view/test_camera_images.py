"""Images on the page follow the time slider."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from page_controls import control, images
from sample_gaussians import plain_gaussians

from gausslite_view.contents import ViewContents

pytest.importorskip("viser")
from gausslite_view.cameras import CameraImage, CameraImages
from gausslite_view.map_page import MapPage
from gausslite_view.pages import open_page

NS_PER_S = 1_000_000_000


@pytest.fixture
def page() -> Iterator[MapPage]:
    page = open_page(0, "test")
    yield page
    page.close()


def grey(level: int) -> CameraImage:
    return CameraImage(np.full((24, 32, 3), level, np.uint8), "Newest keyframe", f"frame {level}")


def map_at(second: int) -> ViewContents:
    means_m = np.arange(3.0 * (second + 1)).reshape(-1, 3)
    return replace(ViewContents.of_one_agent(plain_gaussians(means_m)), state_ns=second * NS_PER_S)


def play(page: MapPage, camera: CameraImages, seconds: range) -> None:
    """Show a map and an image each second; the image is as bright as the second."""
    for second in seconds:
        camera.show("camera", grey(second), second * NS_PER_S)
        page.remember(map_at(second))
        page.show(map_at(second))


def camera_images(page: MapPage) -> CameraImages:
    return CameraImages(page, page.server.gui.add_folder("Camera"))


def test_a_slider_set_back_shows_the_image_of_that_time_until_it_is_at_its_end_again(page: MapPage) -> None:
    camera = camera_images(page)
    play(page, camera, range(50))
    (shown,) = images(page)
    assert (shown.label, int(shown.image[0, 0, 0])) == ("Newest keyframe: frame 49", 49)
    control(page, "Seconds").value = 20.5
    assert shown.label == "Newest keyframe at the chosen time: frame 20"
    assert abs(int(shown.image[0, 0, 0]) - 20) <= 1
    play(page, camera, range(50, 60))
    assert shown.label == "Newest keyframe at the chosen time: frame 20"
    control(page, "Seconds").value = control(page, "Seconds").max
    assert (shown.label, int(shown.image[0, 0, 0])) == ("Newest keyframe: frame 59", 59)


def test_an_image_without_a_time_is_shown_and_not_kept(page: MapPage) -> None:
    camera = camera_images(page)
    camera.show("camera", grey(7), None)
    assert [image.label for image in images(page)] == ["Newest keyframe: frame 7"]
    play(page, camera, range(8, 10))
    control(page, "Seconds").value = 0.0
    assert [image.label for image in images(page)] == ["Newest keyframe at the chosen time: frame 8"]


def test_images_of_other_names_are_removed(page: MapPage) -> None:
    camera = camera_images(page)
    camera.show("b", grey(1), 0)
    camera.show("a", grey(2), 0)
    assert [image.label for image in images(page)] == ["Newest keyframe: frame 2", "Newest keyframe: frame 1"]
    camera.keep(frozenset({"b"}))
    assert [image.label for image in images(page)] == ["Newest keyframe: frame 1"]
