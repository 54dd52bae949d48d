"""The exported outputs of a tiny random network with FastSAM's interface equal those of torch."""

import warnings

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite_detectors.model_file import open_model
from gausslite_detectors.network import DetectionNetwork, letterbox

torch = pytest.importorskip("torch", reason="torch, which this network is made with, is not installed")
pytest.importorskip("onnx", reason="onnx, which torch exports with, is not installed")

HEIGHT_PX, WIDTH_PX = 48, 64


class TinyFastSam(torch.nn.Module):
    """One class, cells of 8 pixels, prototypes of 4: rows are box, score and 32 coefficients, as in the real file."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = torch.nn.Conv2d(3, 16, 4, 4)
        self.head = torch.nn.Conv2d(16, 37, 2, 2)
        self.prototypes = torch.nn.Conv2d(16, 32, 3, 1, 1)

    def forward(self, image):
        seen = torch.tanh(self.stem(image))
        rows = self.head(seen).flatten(2)
        sides = torch.tensor([WIDTH_PX, HEIGHT_PX, WIDTH_PX, HEIGHT_PX]).view(1, 4, 1)
        return torch.cat([rows[:, :4].sigmoid() * sides, rows[:, 4:5].sigmoid(), rows[:, 5:]], 1), self.prototypes(seen)


def test_boxes_scores_coefficients_and_prototypes_are_torchs(tmp_path) -> None:
    torch.manual_seed(0)
    network, path = TinyFastSam().eval(), tmp_path / "tiny.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        blank = torch.zeros(1, 3, HEIGHT_PX, WIDTH_PX)
        torch.onnx.export(network, (blank,), str(path), opset_version=17, dynamo=False)
    read = DetectionNetwork(open_model(path, 1))
    assert read.layout.classes == 1
    rgb = np.random.default_rng(1).integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    camera = Camera(60, 60, 32, 24, WIDTH_PX, HEIGHT_PX)
    output = read.run(Frame(0, 0, rgb, np.ones((HEIGHT_PX, WIDTH_PX), np.float32), camera, np.eye(4)))
    with torch.no_grad():
        rows, prototypes = (
            each[0].numpy() for each in network(torch.from_numpy(letterbox(rgb, HEIGHT_PX, WIDTH_PX)[0]))
        )
    np.testing.assert_allclose(output.reading.masks, prototypes, atol=1e-4)
    found = output.candidates(0.001)
    corners = np.concatenate([rows[:2] - rows[2:4] / 2, rows[:2] + rows[2:4] / 2]).T
    order, expected = np.argsort(found.scores), np.argsort(rows[4])
    assert len(order) == rows.shape[1]
    np.testing.assert_allclose(found.scores[order], rows[4][expected], atol=1e-4)
    np.testing.assert_allclose(output.reading.coefficients[found.rows[order]], rows[5:].T[expected], atol=1e-4)
    limits = (WIDTH_PX, HEIGHT_PX, WIDTH_PX, HEIGHT_PX)
    np.testing.assert_allclose(found.boxes_px[order], np.clip(corners, 0, limits)[expected], atol=1e-4 * WIDTH_PX)
