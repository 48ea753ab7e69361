"""Streams to ROS 2: the messages by the published definitions of `rosbags`, written to CDR and read again."""

import array
import importlib.util
import sys
from dataclasses import asdict
from types import ModuleType

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from morph_dslam.errors import StreamError
from morph_dslam.extend.streams import StreamedObject, StreamSink
from morph_dslam.streams.destinations import open_destination
from morph_dslam.streams.ros2_messages import build, topics
from tests.support.inner_structures import NODES, TRIANGLES, inner_structure, moved
from tests.support.rendered_sequence import CAMERA
from tests.support.streamed import (
    DEVIATIONS,
    POSE,
    held_block_model,
    lost_result,
    stress_at,
    tracked_frame,
    tracked_result,
    vertices_at,
)
from tests.support.stretched_block import SIZE

STRETCH, SLIDE = 0.12, -0.004
STORES = (Stores.ROS2_FOXY, Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY)


class Kept:
    """Keeps what a sink publishes."""

    place, is_watched = "memory", True

    def __init__(self):
        self.scene, self.frames = None, []

    def begin(self, scene):
        self.scene = scene

    def publish(self, message):
        self.frames.append(message)

    def close(self):
        pass


def default(store, kind, argument):
    """What ROS puts in a field that nobody sets."""
    if kind.name == "NAME":
        return filled(store, argument)()
    if kind.name == "BASE":
        return {"string": "", "bool": False}.get(argument[0], 0)
    is_named = argument[0][0].name == "NAME" or argument[0][1][0] == "string"
    return [] if is_named else np.zeros(0, dtype=argument[0][1][0])


def filled(store, kind):
    """The class of a type, with defaults as in ROS."""

    def make(**fields):
        known = dict(store.fielddefs[kind][1])
        assert set(fields) <= set(known), kind
        return store.types[kind](**{n: default(store, *d) for n, d in known.items() if n not in fields} | fields)

    return make


def round_trip(store, message):
    """A message after it was written and read."""
    built = build(message, lambda kind: filled(store, kind), lambda values: values, lambda value: value)
    return store.deserialize_cdr(store.serialize_cdr(built, message.type), message.type)


@pytest.fixture(params=STORES, ids=lambda store: store.value)
def told(request):
    """What each topic carries of a tracked frame and of a lost one, and the definitions."""
    kept, model, store = Kept(), held_block_model(), get_typestore(request.param)
    inner = [inner_structure(model, "blood vessel").carried_by(model)]
    sink = StreamSink([kept]).begin({"run": StreamedObject(model, "my block", inner=inner)}, CAMERA)
    sink(tracked_frame(4, 12.25, run=tracked_result(model, STRETCH, SLIDE)))
    sink(tracked_frame(5, 12.5, run=lost_result(model)))
    found = []
    for frame in kept.frames:
        made = {name: (topic, topic.make(frame)) for name, topic in topics(kept.scene, "/morph").items()}
        assert {message.type == topic.type for topic, message in made.values() if message} == {True}
        found.append({name: round_trip(store, message) for name, (_, message) in made.items() if message})
    return *found, store, model


def stamp(header):
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def xyz(vector):
    return [vector.x, vector.y, vector.z]


def test_pose_and_frames(told):
    tracked, lost, _, _ = told
    pose = tracked["/morph/my_block/pose"]
    assert (pose.header.frame_id, stamp(pose.header)) == ("morph_camera_optical_frame", 12.25)
    assert xyz(pose.pose.position) == pytest.approx(POSE.translation)
    q = pose.pose.orientation
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), POSE.rotation, atol=1e-12)
    camera, support = tracked["/tf"].transforms
    assert (camera.header.frame_id, camera.child_frame_id) == ("morph_camera_optical_frame", "morph_my_block")
    assert xyz(camera.transform.translation) == pytest.approx(POSE.translation)
    assert (support.header.frame_id, support.child_frame_id) == ("morph_my_block", "morph_my_block_left_end")
    assert xyz(support.transform.translation) == pytest.approx([SLIDE / 2, SIZE[1] / 2, SIZE[2] / 2])
    assert support.transform.rotation.w == 1.0
    assert {"/morph/my_block/pose", "/tf"} & set(lost) == set()


def test_structures_inside(told):
    tracked, lost, store, _ = told
    topic, kind = "/morph/my_block/inner/blood_vessel", store.types["visualization_msgs/msg/Marker"]
    marker = tracked[topic]
    assert (marker.type, marker.action, marker.ns) == (kind.TRIANGLE_LIST, kind.ADD, "my block/blood vessel")
    corners = moved(NODES, STRETCH, SLIDE)[TRIANGLES.ravel()]
    np.testing.assert_allclose([xyz(point) for point in marker.points], corners, atol=1e-8)
    assert xyz(marker.pose.position) == pytest.approx(POSE.translation)
    assert (marker.color.a, marker.colors) == (1.0, [])
    assert (lost[topic].action, lost[topic].ns) == (kind.DELETE, marker.ns)


def test_the_mesh(told):
    tracked, lost, store, model = told
    marker, kind = tracked["/morph/my_block/mesh"], store.types["visualization_msgs/msg/Marker"]
    assert (marker.type, marker.action) == (kind.TRIANGLE_LIST, kind.ADD)
    assert (marker.header.frame_id, marker.ns) == ("morph_camera_optical_frame", "my block")
    assert xyz(marker.scale) == [1.0, 1.0, 1.0]
    assert xyz(marker.pose.position) == pytest.approx(POSE.translation)
    corners = vertices_at(model, STRETCH, SLIDE)[model.triangles.ravel()]
    np.testing.assert_allclose([xyz(point) for point in marker.points], corners, atol=1e-7)
    # One stress everywhere: one colour, through which one sees what is inside, and not that of the low end, violet.
    colours = np.array([[c.r, c.g, c.b, c.a] for c in marker.colors])
    assert len(colours) == len(corners)
    assert np.ptp(colours, axis=0).max() == 0.0
    assert colours[0, 3] == pytest.approx(0.4)
    assert colours[0, 1] > colours[0, 2]
    assert lost["/morph/my_block/mesh"].action == kind.DELETE
    assert lost["/morph/my_block/mesh"].ns == "my block"


def test_values_at_the_vertices(told):
    tracked, lost, store, model = told
    cloud = tracked["/morph/my_block/vertices"]
    assert cloud.header.frame_id == "morph_my_block"
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "von_Mises_stress"]
    assert {field.datatype for field in cloud.fields} == {store.types["sensor_msgs/msg/PointField"].FLOAT32}
    kind = np.dtype({"names": [f.name for f in cloud.fields], "formats": ["<f4"] * 4,
                     "offsets": [f.offset for f in cloud.fields], "itemsize": cloud.point_step})  # fmt: skip
    points = cloud.data.tobytes()
    assert (cloud.height, cloud.row_step, cloud.is_bigendian, cloud.is_dense) == (1, len(points), False, True)
    points = np.frombuffer(points, kind, cloud.width)
    np.testing.assert_allclose(
        np.column_stack([points[name] for name in "xyz"]), vertices_at(model, STRETCH, SLIDE), atol=1e-7
    )
    np.testing.assert_allclose(points["von_Mises_stress"], stress_at(STRETCH, SLIDE), rtol=1e-5)
    assert "/morph/my_block/vertices" not in lost


def test_parameters_forces_and_status(told):
    tracked, lost, store, _ = told
    parameters = tracked["/morph/my_block/parameters"]
    rows, columns = parameters.layout.dim
    assert (rows.label, rows.size, rows.stride) == ("stretch [1], slide [m]", 2, 4)
    assert (columns.label, columns.size, columns.stride) == ("value, standard deviation", 2, 2)
    np.testing.assert_allclose(parameters.data.reshape(2, 2).T, [[STRETCH, SLIDE], DEVIATIONS[:2]])
    assert np.isnan(lost["/morph/my_block/parameters"].data).all()
    wrench = tracked["/morph/my_block/reactions/left_end"]
    assert (wrench.header.frame_id, stamp(wrench.header)) == ("morph_my_block_left_end", 12.25)
    force = np.array([-400.0 * STRETCH, 0.0, 5000.0 * SLIDE])
    assert xyz(wrench.wrench.force) == pytest.approx(force)
    # The model has no moment about the origin, so that about the support is what undoes the force's.
    arm = np.array([SLIDE / 2, SIZE[1] / 2, SIZE[2] / 2])
    assert xyz(wrench.wrench.torque) == pytest.approx(-np.cross(arm, force))
    assert "/morph/my_block/reactions/left_end" not in lost
    kind = store.types["diagnostic_msgs/msg/DiagnosticStatus"]
    (good,), (bad,) = tracked["/diagnostics"].status, lost["/diagnostics"].status
    assert (good.level, good.name, good.hardware_id) == (kind.OK, "morph: my block", "stretched block")
    assert {value.key: value.value for value in good.values} == {"stretch": "0.12 +- 0.01 1", "slide": "-4 +- 0.5 mm"}
    assert bad.level == kind.ERROR
    assert "4 of 300 points" in bad.message


def test_names_that_ros_does_not_take_are_changed_and_stay_different():
    kept, model = Kept(), held_block_model()
    shown = {name: StreamedObject(model, name) for name in ("left seal", "left-seal", "2nd")}
    StreamSink([kept]).begin(shown, CAMERA)
    names = {name.split("/")[2] for name in topics(kept.scene, "/cell") if name.startswith("/cell/")}
    assert names == {"left_seal", "left_seal_2", "n2nd"}


def test_each_frame_of_the_tree_has_one_parent():
    """A support of one object, and objects, that would have the same frame."""
    kept, model = Kept(), held_block_model()
    shown = {name: StreamedObject(model, name) for name in ("seal", "seal left end", "camera optical frame")}
    results = {name: tracked_result(model, 0.1, 0.002) for name in shown}
    sink = StreamSink([kept]).begin(shown, CAMERA)
    sink(tracked_frame(0, 0.0, **results))
    made = topics(kept.scene, "/morph")
    transforms = made["/tf"].make(kept.frames[0]).fields["transforms"]
    children = [one.fields["child_frame_id"] for one in transforms]
    assert len(children) == len(set(children)) >= 6
    parents = {one.fields["header"].fields["frame_id"] for one in transforms}
    assert "morph_camera_optical_frame" in parents
    assert "morph_camera_optical_frame" not in children
    for name, wrench in made.items():
        if "/reactions/" in name:
            assert wrench.make(kept.frames[0]).fields["header"].fields["frame_id"] in children


class Node:
    """A node whose topics have a subscriber if the test says so."""

    def __init__(self, subscribed):
        self.subscribed, self.published, self.ended = subscribed, [], False

    def create_publisher(self, kind, name, depth):
        publisher = ModuleType(name)
        publisher.get_subscription_count = lambda: int(name in self.subscribed)
        publisher.publish = lambda message: self.published.append((name, kind, message))
        return publisher

    def destroy_node(self):
        self.ended = True


def test_only_what_somebody_subscribes_to_is_published(monkeypatch):
    """With a stand-in for rclpy, whose classes take the fields of the definitions and nothing else."""
    store, node, calls = get_typestore(Stores.ROS2_HUMBLE), Node({"/cell/morph/block/parameters", "/diagnostics"}), []
    rclpy = ModuleType("rclpy")
    rclpy.__spec__ = importlib.util.spec_from_loader("rclpy", None)
    rclpy.ok, rclpy.init, rclpy.shutdown = lambda: False, lambda: calls.append("init"), lambda: calls.append("shutdown")
    rclpy.create_node = lambda name: node
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.delitem(sys.modules, "morph_dslam.streams.ros2", raising=False)
    for kind in store.types:
        package, _, name = kind.split("/")
        module = sys.modules.get(f"{package}.msg") or ModuleType(f"{package}.msg")
        setattr(module, name, filled(store, kind))
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
    model = held_block_model()
    with StreamSink(["ros2:/cell/morph"]) as streams:
        assert not streams.publishers[0].is_watched
        streams.begin({"block": model}, CAMERA)
        assert streams.publishers[0].is_watched
        streams(tracked_frame(0, 0.0, block=tracked_result(model, STRETCH, SLIDE)))
    assert node.ended
    assert calls == ["init", "shutdown"]
    published = {name: message for name, _, message in node.published}
    assert set(published) == node.subscribed
    # The types that rclpy takes: array.array of an array, bytes of a byte.
    data = published["/cell/morph/block/parameters"].data
    assert isinstance(data, array.array)
    assert data.tolist() == pytest.approx([STRETCH, DEVIATIONS[0], SLIDE, DEVIATIONS[1]])
    assert published["/diagnostics"].status[0].level == b"\x00"
    assert asdict(published["/diagnostics"].header)["frame_id"] == ""


def test_without_ros_a_stream_is_refused_with_what_to_do(refused, tmp_path):
    if importlib.util.find_spec("rclpy") is not None:
        pytest.skip("ROS 2 is on this machine")
    with pytest.raises(StreamError, match=r"source /opt/ros"):
        open_destination("ros2")
    command = [
        "track", tmp_path, "--model", "a", "--camera", "b", "--landmarks", "c", "-o", tmp_path / "run", "--stream"
    ]  # fmt: skip
    assert "source /opt/ros" in refused(*command, "ros2:/cell")
    assert "beginning of topics" in refused(*command, "ros2:cell")
