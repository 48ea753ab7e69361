"""Images of ROS 1 and ROS 2 bags, which rosbags itself writes."""

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.errors import SourceError
from morph_dslam.sources import open_source

pytest.importorskip("rosbags", reason="rosbags is not installed")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
from rosbags.typesys import Stores, get_typestore

STEP = 40_000_000  # nanoseconds
START = 1_700_000_000_500_000_000
TOPIC = "/camera/image_raw"
COLOUR = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)


def ros_types(version):
    return get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)


def header(types, nanoseconds):
    stamp = types.types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)
    kind = types.types["std_msgs/msg/Header"]
    return kind(0, stamp, "camera") if "seq" in kind.__annotations__ else kind(stamp, "camera")


def image_message(types, nanoseconds, pixels, encoding, padding=0):
    rows = pixels.reshape(pixels.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    return types.types["sensor_msgs/msg/Image"](
        header=header(types, nanoseconds),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.ravel(),
    )


def compressed_message(types, nanoseconds, pixels):
    _, data = cv2.imencode(".png", pixels)
    kind = types.types["sensor_msgs/msg/CompressedImage"]
    return kind(header=header(types, nanoseconds), format="png", data=data.ravel())


def write_bag(path, version, messages, storage=StoragePlugin.SQLITE3):
    """Messages are (topic, message, received at); returns the path."""
    types = ros_types(version)
    with Writer1(path) if version == 1 else Writer2(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, message, received in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            serialise = types.serialize_ros1 if version == 1 else types.serialize_cdr
            writer.write(connections[topic], received, serialise(message, kind))
    return path


def sequence(types, n_frames=3, stamped=True):
    return [
        (
            TOPIC,
            image_message(types, START + k * STEP if stamped else 0, COLOUR + k, "bgr8"),
            START + k * STEP + 7_000_000,
        )
        for k in range(n_frames)
    ]


@pytest.mark.parametrize(
    ("name", "version", "storage"),
    [("one.bag", 1, None), ("two", 2, StoragePlugin.SQLITE3), ("mcap", 2, StoragePlugin.MCAP)],
)
def test_bags_of_both_versions(tmp_path, name, version, storage):
    path = write_bag(tmp_path / name, version, sequence(ros_types(version)), storage)
    for given in (path, *path.glob("*.db3"), *path.glob("*.mcap")):
        source = open_source(given)
        frames = list(source)
        assert len(source) == 3
        assert [frame.index for frame in frames] == [0, 1, 2]
        for k, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.image, COLOUR + k)
            assert frame.timestamp == pytest.approx(1_700_000_000.5 + 0.04 * k, abs=1e-6, rel=0)
        assert source.fps == pytest.approx(25.0)
        assert [frame.index for frame in open_source(given, 1, 1)] == [1]


def test_headers_without_time_leave_the_recorders(tmp_path):
    path = write_bag(tmp_path / "one.bag", 1, sequence(ros_types(1), stamped=False))
    assert next(iter(open_source(path))).timestamp == pytest.approx(1_700_000_000.507, abs=1e-6, rel=0)


@pytest.mark.parametrize("encoding", ["rgb8", "rgba8", "mono8", "bgr8 padded", "compressed"])
def test_encodings(tmp_path, encoding):
    types = ros_types(2)
    if encoding == "compressed":
        message, expected = compressed_message(types, START, COLOUR), COLOUR
    elif encoding == "mono8":
        message = image_message(types, START, COLOUR[:, :, 0], "mono8")
        expected = np.repeat(COLOUR[:, :, :1], 3, axis=2)
    elif encoding == "rgba8":
        pixels = np.dstack([COLOUR, np.full((4, 6), 255, dtype=np.uint8)])
        message, expected = image_message(types, START, pixels, encoding), COLOUR[:, :, ::-1]
    elif encoding == "rgb8":
        message, expected = image_message(types, START, COLOUR, encoding), COLOUR[:, :, ::-1]
    else:
        message, expected = image_message(types, START, COLOUR, "bgr8", padding=5), COLOUR
    path = write_bag(tmp_path / "bag", 2, [("/image", message, START)])
    (frame,) = open_source(path)
    np.testing.assert_array_equal(frame.image, expected)


@pytest.mark.parametrize("is_bigendian", [0, 1])
def test_grey_of_16_bits_is_as_in_a_png(tmp_path, is_bigendian):
    grey = (np.arange(24, dtype=np.uint16) * 2731).reshape(4, 6)
    pixels = grey.astype(">u2" if is_bigendian else "<u2").view(np.uint8).reshape(4, 6, 2)
    message = replace(image_message(ros_types(2), START, pixels, "mono16", padding=3), is_bigendian=is_bigendian)
    (frame,) = open_source(write_bag(tmp_path / "bag", 2, [("/image", message, START)]))
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    expected = cv2.imread(str(tmp_path / "grey.png"), cv2.IMREAD_COLOR).astype(int)
    assert np.abs(frame.image - expected).max() <= 1  # libraries round differently
    assert frame.image.max() > 240


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns(tmp_path, pattern):
    # A uniform colour, sampled through the pattern as its name says, comes back as that colour.
    colour = {"r": 200, "g": 120, "b": 30}
    tile = np.array([colour[letter] for letter in pattern], dtype=np.uint8).reshape(2, 2)
    message = image_message(ros_types(2), START, np.tile(tile, (4, 4)), f"bayer_{pattern}8")
    (frame,) = open_source(write_bag(tmp_path / "bag", 2, [("/image", message, START)]))
    np.testing.assert_array_equal(frame.image[2:-2, 2:-2], np.broadcast_to([30, 120, 200], (4, 4, 3)))


def test_one_of_several_topics_is_chosen_by_name(tmp_path):
    types = ros_types(2)
    messages = [
        (topic, image_message(types, START, np.full((4, 6, 3), value, np.uint8), "bgr8"), START)
        for topic, value in (("/left", 1), ("/right", 2))
    ]
    path = write_bag(tmp_path / "bag", 2, messages)
    with pytest.raises(SourceError, match=r"images of the topics /left, /right: choose one, .*bag#/left"):
        open_source(path)
    (frame,) = open_source(f"{path}#/right")
    assert frame.image[0, 0, 0] == 2


def test_all_nodes_that_send_a_topic_are_read(tmp_path):
    # A camera's node that was started again has another connection.
    types = ros_types(1)
    with Writer1(tmp_path / "camera.bag") as writer:
        first, second = (
            writer.add_connection(TOPIC, "sensor_msgs/msg/Image", typestore=types, callerid=name)
            for name in ("/node_1", "/node_2")
        )
        for i in range(10):
            message = image_message(types, (100 + i) * 10**9, np.full((4, 6), 10 * i, dtype=np.uint8), "mono8")
            data = types.serialize_ros1(message, message.__msgtype__)
            writer.write(first if i < 6 else second, (100 + i) * 10**9, data)
    source = open_source(tmp_path / "camera.bag")
    frames = list(source)
    assert len(source) == 10
    assert [frame.timestamp for frame in frames] == [100.0 + i for i in range(10)]
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [10 * i for i in range(10)]


def test_bags_that_are_refused(tmp_path, monkeypatch):
    types = ros_types(2)
    text = types.types["std_msgs/msg/String"]("hello")
    with pytest.raises(SourceError, match="holds no images, but the topics /chatter"):
        open_source(write_bag(tmp_path / "chat", 2, [("/chatter", text, START)]))
    depth = image_message(types, START, np.zeros((4, 12), np.uint8), "16UC1")
    with pytest.raises(SourceError, match=r"frame 0 of .* has the encoding 16UC1; known are"):
        list(open_source(write_bag(tmp_path / "depth", 2, [("/depth", depth, START)])))
    path = write_bag(tmp_path / "one.bag", 1, sequence(ros_types(1)))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(SourceError, match=r"one\.bag cannot be read as a ROS bag"):
        open_source(path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "metadata.yaml").write_text("")
    with pytest.raises(SourceError, match="empty cannot be read as a ROS bag"):
        open_source(tmp_path / "empty")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(SourceError, match=r"pip install '\.\[ros\]'"):
        open_source(path)
