"""Recordings as they reach a user: in parts, of other writers, cut short, moved, or of a recorder that was killed."""

import shutil
import sqlite3
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml
import zstandard
from small_bag import (
    COLOUR,
    FRAMES,
    IMAGE,
    START_NS,
    Writer,
    channel,
    chunk,
    frames_of,
    image,
    mcap,
    mcap_parts,
    message,
    record,
    require_small_bag,
    rgb_of,
    schema,
    text,
    time_of,
    write_small_bag,
)
from tiny_sequences import write_tum

from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError
from gausslite_ros.bag_file import BagAddress
from gausslite_ros.bag_source import BagSource

pytest.importorskip("rosbags", reason="bags need the extra ros")
MAGIC = b"\x89MCAP0\r\n"
ALL_NS = START_NS, time_of(FRAMES)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
@pytest.mark.parametrize("profile", ["ros1", "ros2", ""])
def test_messages_count_and_not_the_profile(tmp_path: Path, name: str, profile: str) -> None:
    channels, messages = mcap_parts(write_small_bag(tmp_path / name))
    (tmp_path / "b.mcap").write_bytes(mcap(profile, [*channels, *(data for _, data in messages)]))
    require_small_bag(frames_of(tmp_path / "b.mcap"))


@pytest.mark.parametrize("name", ["run.mcap", "run.bag", "run"])
def test_frames_are_read_from_several_threads(tmp_path: Path, name: str) -> None:
    source = open_source(str(write_small_bag(tmp_path / name)))
    with ThreadPoolExecutor(8) as pool:
        frames = list(pool.map(lambda i: source.frame(i % FRAMES), range(20 * FRAMES)))
    for start in range(0, len(frames), FRAMES):
        require_small_bag(frames[start : start + FRAMES])


@pytest.mark.parametrize(
    ("kind", "encoding"), [("jsonschema", "json"), ("protobuf", "protobuf"), ("flatbuffer", "flatbuffer")]
)
def test_channels_of_other_serialisations_do_no_harm(tmp_path: Path, kind: str, encoding: str) -> None:
    channels, messages = mcap_parts(write_small_bag(tmp_path / "a.mcap"))
    foreign = [schema(99, "foxglove.Log", kind, "{}"), channel(99, "/log", encoding), message(99, START_NS, b"{}")]
    (tmp_path / "b.mcap").write_bytes(mcap("ros2", [*foreign, *channels, *(data for _, data in messages)]))
    require_small_bag(frames_of(tmp_path / "b.mcap"))


def test_images_of_another_serialisation_are_named(tmp_path: Path) -> None:
    parts = [schema(1, "foxglove.CompressedImage", "protobuf", ""), channel(1, "/camera", "protobuf")]
    (tmp_path / "b.mcap").write_bytes(mcap("", parts))
    with pytest.raises(DatasetError, match=r"got /camera \(foxglove.CompressedImage as protobuf\)"):
        frames_of(tmp_path / "b.mcap")


def test_chunks_out_of_order_and_compressed_are_read_in_order(tmp_path: Path) -> None:
    channels, messages = mcap_parts(write_small_bag(tmp_path / "a.mcap"))
    half, compress = len(messages) // 2, zstandard.ZstdCompressor().compress
    late, early = messages[half:], messages[:half]
    chunks = [
        chunk([*channels, *(data for _, data in part)], (part[0][0], part[-1][0]), compress) for part in (late, early)
    ]
    (tmp_path / "b.mcap").write_bytes(mcap("ros2", chunks))
    require_small_bag(frames_of(tmp_path / "b.mcap"))


def test_a_summary_without_schemas_is_completed_from_the_chunks(tmp_path: Path) -> None:
    channels, messages = mcap_parts(write_small_bag(tmp_path / "a.mcap"))
    times_ns = messages[0][0], messages[-1][0]
    whole = mcap("ros2", [chunk([*channels, *(data for _, data in messages)], times_ns)])
    start = whole.index(record(6, b"")[:1], len(MAGIC))
    end = whole.rindex(record(15, bytes(4)))
    index = struct.pack("<QQQQ", *times_ns, start, end - start) + text(b"") + bytes(8) + text("") + bytes(16)
    summary = b"".join([*channels[1::2], record(8, index)])
    footer = record(2, struct.pack("<QQI", end + 13, 0, 0))
    (tmp_path / "b.mcap").write_bytes(whole[:end] + record(15, bytes(4)) + summary + footer + MAGIC)
    require_small_bag(frames_of(tmp_path / "b.mcap"))


def test_messages_that_the_recorder_compressed_need_its_metadata(tmp_path: Path) -> None:
    channels, messages = mcap_parts(write_small_bag(tmp_path / "a.mcap"))
    head = len(message(0, 0, b""))
    parts = [
        message(int.from_bytes(data[9:11], "little"), time_ns, zstandard.compress(data[head:]))
        for time_ns, data in messages
    ]
    (tmp_path / "b.mcap").write_bytes(mcap("ros2", [*channels, *parts]))
    with pytest.raises(DatasetError, match=r"the recorder compressed each message; expected .* metadata.yaml"):
        frames_of(tmp_path / "b.mcap")


@pytest.mark.parametrize("in_chunk", [True, False])
@pytest.mark.parametrize("zeros", [0, 500])
def test_a_file_that_was_cut_gives_what_is_whole_and_says_so(tmp_path: Path, in_chunk: bool, zeros: int) -> None:
    channels, messages = mcap_parts(write_small_bag(tmp_path / "a.mcap"))
    records = [*channels, *(data for _, data in messages)]
    data = mcap("ros2", [chunk(records, ALL_NS)] if in_chunk else records)
    path = tmp_path / "b.mcap"
    path.write_bytes(data[: len(data) * 7 // 10] + bytes(0 if in_chunk else zeros))
    address = BagAddress.parse(str(path))
    source = BagSource(address)
    assert any("b.mcap was cut short after" in note for note in source.notes)
    assert 3 <= len(source) < FRAMES
    require_small_bag([source.frame(i) for i in range(len(source))], len(source))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.bag", "`rosbag reindex FILE` of ROS 1 repairs"),
        ("a.mcap", "expected messages, got a file that was cut short after 60 bytes"),
        ("a", "`sqlite3 FILE .recover` repairs"),
    ],
)
def test_a_file_without_a_whole_message_names_the_cause(tmp_path: Path, name: str, message: str) -> None:
    path = write_small_bag(tmp_path / name)
    file = next(path.glob("*.db3")) if path.is_dir() else path
    cut = tmp_path / f"cut{file.suffix}"
    cut.write_bytes(file.read_bytes()[:60])
    with pytest.raises(DatasetError, match=message) as caught:
        frames_of(cut)
    assert "\n" not in str(caught.value)


def test_the_write_ahead_log_of_a_killed_recorder_is_read_and_left_alone(tmp_path: Path) -> None:
    whole = next(write_small_bag(tmp_path / "a").glob("*.db3"))
    work, bag = tmp_path / "work.db3", tmp_path / "b.db3"
    shutil.copy(whole, work)
    database = sqlite3.connect(work)
    database.execute("pragma journal_mode=WAL")
    database.execute("pragma wal_autocheckpoint=0")
    rows = database.execute("select * from messages where timestamp > ?", (time_of(3),)).fetchall()
    database.execute("delete from messages where timestamp > ?", (time_of(3),))
    database.commit()
    database.execute("pragma wal_checkpoint(TRUNCATE)")
    database.executemany("insert into messages values (?, ?, ?, ?)", rows)
    database.commit()
    shutil.copy(work, bag)
    shutil.copy(f"{work}-wal", f"{bag}-wal")
    database.close()
    before = bag.read_bytes(), Path(f"{bag}-wal").read_bytes()
    require_small_bag(frames_of(bag))
    assert (bag.read_bytes(), Path(f"{bag}-wal").read_bytes()) == before
    assert not Path(f"{bag}-shm").exists()


@pytest.mark.parametrize("damage", ["no metadata", "renamed", "newer"])
def test_a_folder_is_read_without_its_list_of_files(tmp_path: Path, damage: str) -> None:
    folder = write_small_bag(tmp_path / "a")
    metadata = folder / "metadata.yaml"
    if damage == "no metadata":
        metadata.unlink()
    elif damage == "renamed":
        next(folder.glob("*.db3")).rename(folder / "other.db3")
    else:
        content = yaml.safe_load(metadata.read_text())
        content["rosbag2_bagfile_information"]["version"] = 99
        metadata.write_text(yaml.safe_dump(content))
    require_small_bag(frames_of(folder))


@pytest.mark.parametrize("name", ["A.BAG", "a.bag.active", "A.MCAP", "A.DB3"])
def test_names_that_recorders_and_copies_leave_are_read(tmp_path: Path, name: str) -> None:
    kind = name.lower().removesuffix(".active").rpartition(".")[2]
    path = write_small_bag(tmp_path / ("x" if kind == "db3" else f"x.{kind}"))
    file = next(path.glob("*.db3")) if path.is_dir() else path
    require_small_bag(frames_of(file.rename(tmp_path / name)))


def split(bag: Path, folder: Path, names: tuple[str, ...]) -> None:
    """Write the messages of a ROS 1 bag to parts of equal length."""
    from rosbags.rosbag1 import Reader, Writer

    folder.mkdir()
    with Reader(bag) as reader:
        messages = [(connection, time_ns, bytes(data)) for connection, time_ns, data in reader.messages()]
    size = -(-len(messages) // len(names))
    for k, name in enumerate(names):
        with Writer(folder / name) as writer:
            known = {}
            for connection, time_ns, data in messages[k * size : (k + 1) * size]:
                if connection.id not in known:
                    definition, digest = connection.msgdef.data, connection.digest
                    known[connection.id] = writer.add_connection(
                        connection.topic, connection.msgtype, msgdef=definition, md5sum=digest
                    )
                writer.write(known[connection.id], time_ns, data)


def test_the_folder_of_the_parts_is_the_recording(tmp_path: Path) -> None:
    names = tuple(f"run_2026-01-01-10-00-{k:02d}_{k}.bag" for k in range(11))
    split(write_small_bag(tmp_path / "a.bag"), tmp_path / "run", names)
    require_small_bag(frames_of(tmp_path / "run"))


def test_a_part_that_is_missing_between_others_is_reported(tmp_path: Path) -> None:
    split(write_small_bag(tmp_path / "a.bag"), tmp_path / "run", ("run_0.bag", "run_1.bag", "run_2.bag"))
    (tmp_path / "run" / "run_1.bag").unlink()
    source = BagSource(BagAddress(tmp_path / "run"))
    assert len(source) < FRAMES
    assert "run: parts 1 are not there; their frames are missing" in source.notes


def test_a_later_part_alone_names_the_missing_link(tmp_path: Path) -> None:
    split(write_small_bag(tmp_path / "a.bag"), tmp_path / "run", ("run_0.bag", "run_1.bag"))
    with pytest.raises(DatasetError, match=r"tf_static stands at the start .* give the folder of all parts"):
        frames_of(tmp_path / "run" / "run_1.bag")


@pytest.mark.parametrize("names", [("kitchen.bag", "office.bag"), ("kitchen_1.bag", "office_2.bag")])
def test_recordings_that_are_not_parts_of_one_are_listed(tmp_path: Path, names: tuple[str, str]) -> None:
    for name in names:
        write_small_bag(tmp_path / name)
    with pytest.raises(DatasetError, match=rf"got {', '.join(names)}; give the file of one recording"):
        frames_of(f"bag:{tmp_path}")


def test_several_runs_in_one_recording_are_refused(tmp_path: Path) -> None:
    def again(bag: Writer, i: int) -> None:
        # the clock is set back after every fourth frame
        time_ns = time_of(i % 4) - 10**10 * (i // 4)
        bag.write(COLOUR, IMAGE, time_of(i), image(i, "rgb8", rgb_of(i), time_ns=time_ns))

    bag = write_small_bag(tmp_path / "loop.bag", colour=again)
    with pytest.raises(
        DatasetError, match=r"image_raw: expected one run, got stamps that go back from 1000.1 to 990.0"
    ):
        frames_of(bag)


def test_a_single_stamp_of_the_future_does_no_harm(tmp_path: Path) -> None:
    def colour(bag: Writer, i: int) -> None:
        time_ns = time_of(i) + 10**12 * (i == 3)
        bag.write(COLOUR, IMAGE, time_of(i), image(i, "rgb8", rgb_of(i), time_ns=time_ns))

    frames = frames_of(write_small_bag(tmp_path / "a.bag", colour=colour))
    assert len(frames) == FRAMES - 1


def test_a_missing_part_is_named(tmp_path: Path) -> None:
    folder = write_small_bag(tmp_path / "a")
    metadata = folder / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    content["rosbag2_bagfile_information"]["relative_file_paths"].append("a_1.db3")
    metadata.write_text(yaml.safe_dump(content))
    pytest.raises(DatasetError, frames_of, folder).match(r"metadata.yaml names a_1.db3, which is not there")


def test_topics_of_all_parts_are_listed(tmp_path: Path) -> None:
    split(write_small_bag(tmp_path / "a.bag"), tmp_path / "run", ("run_0.bag", "run_1.bag"))
    address = BagAddress.parse(str(tmp_path / "run"))
    assert f"color={COLOUR}" in BagSource(address).description


def test_a_folder_of_images_with_a_metadata_file_of_its_own_is_no_bag(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1")
    (folder / "metadata.yaml").write_text("robot: husky\n")
    assert len(open_source(str(folder))) == 3
