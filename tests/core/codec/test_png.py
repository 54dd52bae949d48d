"""Images are written as PNG files."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from gausslite.codec.state_file import write_png
from gausslite.domain.errors import StorageError

RGB = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


def test_a_png_holds_the_same_colours(tmp_path: Path) -> None:
    write_png(tmp_path / "sheet.png", RGB)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "sheet.png"))[..., ::-1], RGB)


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    pytest.raises(StorageError, write_png, tmp_path / "missing" / "sheet.png", RGB).match(r"sheet\.png")
