"""The sample for OpenIGTLink: bytes as pyigtl writes them, what arrives over loopback, and attributes by the format."""

import socket
import struct
import threading
import time

import crcmod
import numpy as np
import pyigtl
import pytest
from pyigtl import messages as igtl

from morph_dslam.extend.streams import StreamedObject, StreamSink
from morph_dslam.streams.websocket import WebSocketPublisher
from tests.support.inner_structures import NODES, TRIANGLES as INSIDE, inner_structure, moved
from tests.support.rendered_sequence import CAMERA
from tests.support.streamed import (
    POSE,
    held_block_model,
    stream_example,
    stress_at,
    tracked_frame,
    tracked_result,
    vertices_at,
)

pytestmark = pytest.mark.usefixtures("ends_in_time")

sample = stream_example("openigtlink")
POINTS = np.array([[0.0, 1.0, 2.5], [3.0, -4.0, 5.0], [6.0, 7.0, 8.0], [-1.5, 0.0, 0.25]])
TRIANGLES = np.array([[0, 1, 2], [2, 1, 3]])


def test_the_check_sum_is_that_of_ecma_182():
    # The value that catalogues of check sums give for these digits.
    assert sample.crc64(b"123456789") == 0x6C40DF5F0B497347
    data = np.random.default_rng(0).bytes(1000)
    other = crcmod.mkCrcFun(0x142F0E1EBA9EA3693, rev=False, initCrc=0, xorOut=0)
    assert sample.crc64(data) == other(data)


def test_messages_are_byte_for_byte_those_of_another_library():
    seconds = 1234.5
    transform = igtl.TransformMessage(POSE.matrix, timestamp=seconds, device_name="seal_pose").pack()
    assert sample.packed("TRANSFORM", "seal_pose", sample.transform_body(POSE.matrix), seconds) == transform
    polygons = np.column_stack([[3, 3], TRIANGLES]).ravel()
    surface = igtl.PolyDataMessage(points=POINTS, polygons=polygons, timestamp=seconds, device_name="seal").pack()
    assert sample.packed("POLYDATA", "seal", sample.polydata_body(POINTS, TRIANGLES), seconds) == surface


@pytest.mark.parametrize(
    ("seconds", "sent"), [(-0.5, 0.0), (1.7e18, 0.0), (2.0**32, 0.0), (2.0**32 - 0.5, 2.0**32 - 0.5)]
)
def test_a_time_that_the_header_cannot_hold_is_sent_as_zero(seconds, sent):
    """As of frames whose times are nanoseconds since 1970, or before the zero of a recording's clock."""
    body = sample.transform_body(POSE.matrix)
    expected = igtl.TransformMessage(POSE.matrix, timestamp=sent, device_name="seal_pose").pack()
    assert sample.packed("TRANSFORM", "seal_pose", body, seconds) == expected


def test_no_two_devices_have_one_name_nor_one_that_is_too_long():
    """A client would take them for one. 3D Slicer's are known by their names alone, of 20 bytes."""
    fingers = ["pneumatic_finger_left", "pneumatic_finger_right", "leber_gr\u00f6\u00dfe_links_x"]
    objects = [{"name": name, "inner": ["vessel", "vessel_of_the_other_kind"]} for name in fingers]
    found = sample.device_names({"objects": objects})
    assert len(found) == len(set(found.values())) == 4 * len(fingers)
    for key, device in found.items():
        assert len(device.encode()) <= 20
        assert device[:6] == key[-1][:6] if "inner" in key else device[:4] == key[0][:4]
        assert device.endswith("_pose") == (key[-1] == "pose")
    first = found["pneumatic_finger_left",]
    assert first == "pneumatic_finger_lef"
    assert sample.packed("TRANSFORM", first, b"", 0.0)[14:34] == first.encode()


class PolyData(igtl.MessageBase):
    """POLYDATA read by the published format; the library's own reader does not work yet."""

    def _unpack_content(self, content):
        n_points, *counts, n_attributes = struct.unpack_from(">10I", content)
        n_vertices, _, n_lines, _, n_polygons, polygon_bytes, n_strips, _ = counts
        assert (n_vertices, n_lines, n_strips) == (0, 0, 0)
        place = 40
        self.points = np.frombuffer(content, ">f4", 3 * n_points, place).reshape(-1, 3)
        place += 12 * n_points
        self.polygons = np.frombuffer(content, ">u4", polygon_bytes // 4, place).reshape(n_polygons, -1)
        place += polygon_bytes
        if not n_attributes:
            assert place == len(content)
            return
        kind, components, n_values = struct.unpack_from(">BBI", content, place)
        assert (kind, components, n_values) == (0, 1, n_points)
        end = content.index(b"\0", place + 6)
        self.name = content[place + 6 : end].decode()
        # Names are filled up to an even number of bytes, with the zero at their ends.
        place = end + 1 + (len(self.name) + 1) % 2
        self.values = np.frombuffer(content, ">f4", n_values, place)
        assert place + 4 * n_values == len(content)


@pytest.mark.parametrize("name", ["stress", "strain2"])
def test_values_at_the_points(name):
    values = np.array([1.0, 2.0, np.nan, -4.5])
    data = PolyData()
    data._unpack_content(sample.polydata_body(POINTS, TRIANGLES, name, values))
    assert data.name == name
    np.testing.assert_array_equal(data.points, POINTS)
    np.testing.assert_array_equal(data.polygons, [[3, 0, 1, 2], [3, 2, 1, 3]])
    np.testing.assert_array_equal(data.values, values.astype(np.float32))


def test_a_client_receives_pose_surface_stress_and_what_is_inside(monkeypatch):
    """From the tracker's results by WebSocket and by OpenIGTLink to pyigtl's client."""
    monkeypatch.setitem(igtl.message_type_to_class_constructor, "POLYDATA", PolyData)
    model, publisher, server = held_block_model(), WebSocketPublisher(), socket.create_server(("127.0.0.1", 0))
    inner = [inner_structure(model).carried_by(model)]
    sink = StreamSink([publisher]).begin({"block": StreamedObject(model, inner=inner)}, CAMERA)
    relay = threading.Thread(target=sample.relay, args=(publisher.place, server))
    relay.start()
    viewer = pyigtl.OpenIGTLinkClient("127.0.0.1", server.getsockname()[1])
    stretch, slide, received, number, end = 0.1, 0.004, {}, 0, time.monotonic() + 30.0
    try:
        while set(received) != {"block_pose", "block", "tumour"}:
            assert time.monotonic() < end
            sink(tracked_frame(number, 12.25, block=tracked_result(model, stretch, slide)))
            number += 1
            time.sleep(0.02)
            received |= {message.device_name: message for message in viewer.get_latest_messages()}
    finally:
        viewer.stop()
        publisher.close()
        relay.join(20)
    pose, surface = received["block_pose"], received["block"]
    assert (pose.message_type, surface.message_type) == ("TRANSFORM", "POLYDATA")
    assert pose.timestamp == pytest.approx(12.25)
    np.testing.assert_allclose(pose.matrix[:3, :3], POSE.rotation, atol=1e-6)
    np.testing.assert_allclose(pose.matrix[:3, 3], 1e3 * POSE.translation, atol=1e-4)
    np.testing.assert_allclose(surface.points, 1e3 * vertices_at(model, stretch, slide), atol=1e-4)
    np.testing.assert_array_equal(surface.polygons[:, 1:], model.triangles)
    inside = received["tumour"]
    np.testing.assert_allclose(inside.points, 1e3 * moved(NODES, stretch, slide), atol=1e-4)
    np.testing.assert_array_equal(inside.polygons[:, 1:], INSIDE)
    assert surface.name == "von Mises stress"
    np.testing.assert_allclose(surface.values, 1e-6 * stress_at(stretch, slide), rtol=1e-5)
