"""The guides: every block that is marked with `<!-- test -->` runs as written, on tiny images and few frames.

Options that a command leaves out come from the environment. The ports of a page are replaced by free ones. A block
marked with `<!-- test: service -->` is a service that serves the following blocks.
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import grpc
import pytest
from guide_blocks import Block, blocks, tiny_environment
from tiny_yolo import write_tiny_yolo
from tum_recording import write_home

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
pytest.importorskip("rosbags", reason="the bag needs the extra `ros`")
pytest.importorskip("gaussforge", reason="exports need the extra `export`")

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md") if "<!-- test" in path.read_text(encoding="utf-8"))
LIMIT_S = 120


@pytest.fixture(scope="module")
def own_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files that the guides expect from their reader."""
    folder = tmp_path_factory.mktemp("files")
    write_home(folder / "my_recording")
    writer = ROOT / "tools" / "write_bag.py"
    subprocess.run([sys.executable, writer, folder / "my_recording", folder / "run1.mcap"], check=True)
    shutil.copytree(ROOT / "examples" / "colour_detector", folder / "colour_detector")
    write_tiny_yolo(folder / "yolo11n-seg.onnx", ("cup", "chair"), [(32, 32, 20, 20, 0, 0.9)])
    return folder


@contextmanager
def serving(block: Block, folder: Path, environment: dict[str, str]) -> Iterator[None]:
    """Run a service until the end of the block of code."""
    address = re.search(r"--listen \S*:(\d+)", block.text)
    assert address, f"expected --listen, got {block.text}"
    process = subprocess.Popen(["bash", "-c", f"exec {block.text}"], cwd=folder, env=environment)
    try:
        with grpc.insecure_channel(f"127.0.0.1:{address[1]}") as channel:
            grpc.channel_ready_future(channel).result(timeout=LIMIT_S)
        yield
    finally:
        process.terminate()
        process.wait(timeout=LIMIT_S)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT / "docs")))
def test_marked_blocks_run_as_written(page: Path, own_files: Path, tmp_path: Path) -> None:
    marked = blocks(page)
    assert len(marked) == page.read_text(encoding="utf-8").count("<!-- test")
    folder = tmp_path / "reader"
    shutil.copytree(own_files, folder)
    environment = tiny_environment()
    with ExitStack() as services:
        for block in marked:
            if block.is_service:
                services.enter_context(serving(block, folder, environment))
                continue
            done = subprocess.run(
                block.command(), cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT_S
            )
            assert done.returncode == 0, f"{block.text}\n{done.stdout}\n{done.stderr}"
