"""Streams to rerun: what a recording holds, read back by rerun's own reader."""

import socket

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import StreamError
from morph_dslam.extend.streams import StreamedObject, StreamSink
from morph_dslam.sources import Frame
from morph_dslam.tracking.sinks import TrackedFrame
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

RrdReader = pytest.importorskip("rerun.chunk", reason="the extra rerun is not installed").RrdReader
STATES = [(0.1, 0.002), (-0.05, 0.004), (0.15, -0.006)]


def columns(path):
    """By entity and component: the frame numbers (None: static), and the values of each row."""
    found = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name in ("rerun.controls.RowId", "frame", "time", "log_time", "captured"):
                continue
            rows = batch.column(name).to_pylist()
            frames = batch.column("frame").to_pylist() if "frame" in batch.schema.names else [None] * len(rows)
            known = found.setdefault((chunk.entity_path, name.partition(":")[2] or name), {})
            known |= dict(zip(frames, rows, strict=True))
    return found


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three tracked frames from number 10 on, and a lost one."""
    path, model = tmp_path_factory.mktemp("rerun") / "run.rrd", held_block_model()
    with StreamSink([f"rerun:{path}"]) as streams:
        streams.begin({"run": StreamedObject(model, "block")}, CAMERA)
        for number, state in enumerate(STATES):
            streams(tracked_frame(10 + number, 0.5 * number, run=tracked_result(model, *state)))
        streams(tracked_frame(13, 1.5, run=lost_result(model)))
    return columns(path), model


def test_the_mesh_moves_in_the_camera_frame(recorded):
    found, model = recorded
    block = "/world/objects/block"
    np.testing.assert_array_equal(found[block, "triangle_indices"][None], model.triangles)
    assert set(found[block, "vertex_positions"]) == {10, 11, 12}
    for number, (stretch, slide) in enumerate(STATES):
        positions = np.array(found[block, "vertex_positions"][10 + number])
        np.testing.assert_allclose(positions, vertices_at(model, stretch, slide), atol=1e-7)
        # Matrices are stored column by column.
        matrix = np.reshape(found[block, "mat3x3"][10 + number][0], (3, 3)).T
        np.testing.assert_allclose(matrix, POSE.rotation, atol=1e-6)
        np.testing.assert_allclose(found[block, "translation"][10 + number][0], POSE.translation, atol=1e-7)
        values = found["/values/block", "von Mises stress [Pa]"][10 + number]
        np.testing.assert_allclose(values, stress_at(stretch, slide), rtol=1e-5)
        (colour,) = set(found[block, "vertex_colors"][10 + number])
        assert colour & 0xFF == 255
    assert list(found[block, "is_recursive"]) == [13]


def test_structures_inside_are_seen_through_the_mesh(tmp_path):
    path, model = tmp_path / "run.rrd", held_block_model()
    with StreamSink([f"rerun:{path}"]) as streams:
        inner = [inner_structure(model).carried_by(model)]
        streams.begin({"run": StreamedObject(model, "block", inner=inner)}, CAMERA)
        streams(tracked_frame(0, 0.0, run=tracked_result(model, *STATES[0])))
        streams(tracked_frame(1, 0.5, run=lost_result(model)))
    found, inside = columns(path), "/world/objects/block/inner/tumour"
    np.testing.assert_array_equal(found[inside, "triangle_indices"][None], TRIANGLES)
    np.testing.assert_allclose(found[inside, "vertex_positions"][0], moved(NODES, *STATES[0]), atol=1e-8)
    assert list(found[inside, "is_recursive"]) == [1]
    # Colours are 0xRRGGBBAA.
    assert [colour & 0xFF for colour in found[inside, "albedo_factor"][None]] == [255]
    assert {colour & 0xFF for colour in found["/world/objects/block", "vertex_colors"][0]} == {102}


def test_parameters_forces_and_status_over_the_frames(recorded):
    found, _ = recorded
    for number, (stretch, slide) in enumerate(STATES):
        frame = 10 + number
        assert found["/parameters/block/stretch", "scalars"][frame] == pytest.approx([stretch])
        assert found["/parameters/block/slide", "scalars"][frame] == pytest.approx([1e3 * slide])  # mm
        assert found["/deviations/block/slide", "scalars"][frame] == pytest.approx([1e3 * DEVIATIONS[1]])
        force = found["/forces/block/left\\ end", "scalars"][frame]
        assert force == pytest.approx([-400.0 * stretch, 0.0, 5000.0 * slide])
    assert np.isnan(found["/parameters/block/slide", "scalars"][13]).all()
    # A text is logged when it changes.
    assert list(found["/status/block", "text"]) == [10, 13]
    assert "4 of 300 points" in found["/status/block", "text"][13][0]
    assert found["/status/block", "level"][13] == ["ERROR"]


def test_the_image_is_that_of_the_pinhole(tmp_path):
    """A grid of dots seen by a lens with distortion is even again in the image that is recorded."""
    camera = Camera(320, 240, 260.0, 260.0, 159.5, 119.5, (-0.25, 0.05, 0.0, 0.0))
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 4))
    rays = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    seen, ideal = camera.project_recorded(rays), camera.project(rays)
    assert np.abs(seen - ideal).max() > 5.0
    rows, cols = np.mgrid[: camera.height, : camera.width]
    distance = np.min([np.hypot(cols - u, rows - v) for u, v in seen], axis=0)
    image = np.repeat((250 * np.exp(-0.5 * (distance / 2.0) ** 2)).astype(np.uint8)[:, :, None], 3, axis=2)
    model = held_block_model()
    with StreamSink([f"rerun:{tmp_path / 'image.rrd'}"]) as streams:
        streams.begin({"block": model}, camera)
        streams(TrackedFrame((Frame(0, 0.0, image),), {"block": lost_result(model)}))
    found = columns(tmp_path / "image.rrd")
    assert np.array(found["/world/camera", "resolution"][None]).ravel().tolist() == [320.0, 240.0]
    matrix = np.reshape(found["/world/camera", "image_from_camera"][None], (3, 3)).T
    np.testing.assert_allclose(matrix, [[260.0, 0.0, 160.0], [0.0, 260.0, 120.0], [0.0, 0.0, 1.0]])
    blob = np.asarray(found["/world/camera/image", "blob"][0][0], dtype=np.uint8)
    shown = cv2.imdecode(blob, cv2.IMREAD_GRAYSCALE).astype(float)
    for u, v in ideal:
        near = np.hypot(cols - u, rows - v) < 6.0
        weights = shown * near
        centre = np.array([(weights * cols).sum(), (weights * rows).sum()]) / weights.sum()
        np.testing.assert_allclose(centre, [u, v], atol=0.3)


def test_a_viewer_that_is_not_there_is_told_at_once():
    with socket.create_server(("127.0.0.1", 0)) as viewer:
        place = f"rerun+http://127.0.0.1:{viewer.getsockname()[1]}/proxy"
    with pytest.raises(StreamError, match=r"no viewer answers at .*start `rerun` there first"):
        StreamSink([f"rerun:{place}"])


def test_frames_that_do_not_arrive_are_told_at_the_end(tmp_path, monkeypatch):
    def fails(recording, *, timeout_sec):
        raise RuntimeError("the disk is full")

    monkeypatch.setattr("rerun.RecordingStream.flush", fails)
    streams = StreamSink([f"rerun:{tmp_path / 'run.rrd'}"])
    with pytest.raises(StreamError, match=r"run\.rrd did not get all frames: the disk is full"):
        streams.close()


def test_an_earlier_recording_is_replaced_only_where_that_is_allowed(tmp_path, refused):
    path, earlier = tmp_path / "run.rrd", b"an earlier recording" * 50
    path.write_bytes(earlier)
    with pytest.raises(StreamError, match="holds an earlier recording"):
        StreamSink([f"rerun:{path}"])
    message = refused(
        "track", tmp_path, "--model", "a", "--camera", "b", "--landmarks", "c", "-o", tmp_path / "run",
        "--stream", f"rerun:{path}",
    )  # fmt: skip
    assert "--overwrite" in message
    assert path.read_bytes() == earlier
    model = held_block_model()
    with StreamSink([f"rerun:{path}"], overwrite=True) as streams:
        streams.begin({"run": StreamedObject(model, "block")}, CAMERA)
    assert path.read_bytes() == earlier, "a run without a frame leaves it"
    with StreamSink([f"rerun:{path}"], overwrite=True) as streams:
        streams.begin({"run": StreamedObject(model, "block")}, CAMERA)
        streams(tracked_frame(0, 0.0, run=lost_result(model)))
    found = columns(path)
    np.testing.assert_array_equal(found["/world/objects/block", "triangle_indices"][None], model.triangles)


def test_a_recording_that_never_begins_leaves_no_file(tmp_path):
    with StreamSink([f"rerun:{tmp_path / 'run.rrd'}"]) as streams:
        streams.begin({"run": StreamedObject(held_block_model(), "block")}, CAMERA)
    assert list(tmp_path.iterdir()) == []


def test_places_that_are_none(tmp_path, refused):
    for where in (tmp_path / "run.txt", tmp_path / "missing" / "run.rrd", ""):
        with pytest.raises(StreamError):
            StreamSink([f"rerun:{where}"])
    (tmp_path / "run.rrd").mkdir()
    with pytest.raises(StreamError, match="Is a directory"):
        StreamSink([f"rerun:{tmp_path / 'run.rrd'}"])
    message = refused(
        "live", "webcam:0", "--model", "a", "--camera", "b", "--landmarks", "c", "-o", tmp_path / "run",
        "--stream", f"rerun:{tmp_path / 'run.txt'}",
    )  # fmt: skip
    assert "FILE.rrd" in message
