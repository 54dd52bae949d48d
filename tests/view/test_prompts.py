"""What a browser sends from the image on which a person points."""

import json

import pytest

from gausslite_view.pointing import read_answer


def test_shares_of_the_image_are_pixels_inside_of_it():
    assert read_answer(json.dumps({"prompt": [[0.5, 0.25]], "noun": "mug"}), 320, 240) == (((160.0, 60.0),), "mug")
    ((left, top), (right, bottom)), noun = read_answer(json.dumps({"prompt": [[-1, 0], [1, 2]], "noun": ""}), 320, 240)
    assert (left, top, noun) == (0.0, 0.0, "")
    assert 319 < right < 320
    assert 239 < bottom < 240


@pytest.mark.parametrize(
    "message",
    ["", "[]", "null", '{"noun": "mug"}', '{"prompt": "mug", "noun": "mug"}', '{"prompt": [1, 2, 3], "noun": ""}',
     '{"prompt": [[NaN, 0]], "noun": ""}', '{"prompt": [[0, 0], [1, 1], [0, 1]], "noun": ""}'],
)  # fmt: skip
def test_another_message_is_an_image_that_was_closed(message):
    assert read_answer(message, 320, 240) == ((), "")
