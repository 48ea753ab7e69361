"""Boards, pictures of the print and guesses find objects where they are, or are refused."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.model import SurfacePoints, save_model
from morph_dslam.registration.board import BoardFile, FiducialBoard, load_board
from morph_dslam.registration.board_registration import BoardInitializer, locate_board
from morph_dslam.registration.guess import GuessFile, GuessInitializer
from morph_dslam.registration.initialization import InitializerFiles
from morph_dslam.registration.messages import Ambiguity, Ambiguous, AssumedUndeformed
from morph_dslam.registration.picture import PictureInitializer, load_picture
from morph_dslam.registration.registration_file import load_registration
from morph_dslam.slam.map_files import save_map
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.patches import normalize_contrast
from morph_dslam.tracking.relocalization import LEAST_MATCHES, state_from_matches
from morph_dslam.tracking.state import BoundPoints, State
from tests.support.bent_sheet import LENGTH, WIDTH
from tests.support.real_data import real_data
from tests.support.rendered_board import turned_tags
from tests.support.rendered_sequence import CAMERA, mean_error, write_landmarks, write_recording
from tests.support.staged_scenes import SCENES, aside

GRID = """
kind = "grid"
dictionary = "apriltag_36h11"
columns = 4
rows = 3
marker_mm = 30
gap_mm = 9
[object]
position_mm = [20, -40, -15]
rotation_deg = [10, 5, 30]
"""
CHARUCO = GRID.replace('"grid"', '"charuco"').replace("gap_mm = 9", "square_mm = 40").replace("36h11", "25h9")
PICTURE = """
image = "print.png"
[rectangle]
corner_mm = [-210, 148.5, 0]
right_mm = [420, 0, 0]
down_mm = [0, -297, 0]
"""
BOARD_POSE = RigidTransform(rotation_exp(np.array([0.35, -0.5, 0.2])), np.array([-0.06, -0.05, 0.55]))


@pytest.fixture(scope="module")
def scene():
    return SCENES["sheet"](0)


def written(folder, text):
    path = folder / "board.toml"
    path.write_text(text)
    return path


def picture_of(board: FiducialBoard, pose: RigidTransform, noise=2.0):
    """A print (h, w) with a white margin of 2 cm in the camera, in front of grey: a plane's homography."""
    density, margin, fine = 4000.0, 0.02, 4
    print_ = cv2.copyMakeBorder(board.image(density), *[int(margin * density)] * 4, cv2.BORDER_CONSTANT, value=255)
    # Pixel (0, 0) is the centre of the first one, of the print, the picture and the finer one.
    corner = 0.5 / density - margin
    board_from_print = np.array([[1 / density, 0, corner], [0, 1 / density, corner], [0, 0, 1]])
    image_from_board = CAMERA.matrix @ np.column_stack([pose.rotation[:, :2], pose.translation])
    shift = (fine - 1) / 2
    finer = np.array([[fine, 0, shift], [0, fine, shift], [0, 0, 1]])
    size = (fine * CAMERA.width, fine * CAMERA.height)
    image = cv2.warpPerspective(print_, finer @ image_from_board @ board_from_print, size, borderValue=120)
    image = cv2.resize(image, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    noisy = image + noise * np.random.default_rng(0).standard_normal(image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("text", [GRID, CHARUCO], ids=["apriltag grid", "charuco"])
def test_a_board_tells_its_pose_within_half_a_millimetre(tmp_path, text):
    board = load_board(written(tmp_path, text))
    found = locate_board(board, CAMERA, picture_of(board, BOARD_POSE))
    assert found is not None
    assert found.n_corners >= 6
    assert found.rms_px < 0.3
    assert found.ambiguity is None
    corners = np.array([[0, 0, 0], [*board.size, 0.0]])
    off = found.camera_from_board.apply(corners) - BOARD_POSE.apply(corners)
    assert 1e3 * np.linalg.norm(off, axis=1).max() < 1.0
    away = found.camera_from_board.translation - BOARD_POSE.translation
    assert (np.abs(away) < 5.0 * np.sqrt(np.diag(found.covariance)[3:])).all()


def test_tags_turned_as_apriltag_prints_them_are_read_too(tmp_path):
    board = load_board(written(tmp_path, GRID))
    picture = picture_of(turned_tags(board), BOARD_POSE)
    found = locate_board(board, CAMERA, picture)
    assert found is not None
    assert found.rms_px < 0.3
    assert found.ambiguity is None
    corners = np.array([[0, 0, 0], [*board.size, 0.0]])
    off = found.camera_from_board.apply(corners) - BOARD_POSE.apply(corners)
    assert 1e3 * np.linalg.norm(off, axis=1).max() < 1.0
    # One that is said to be OpenCV's is not read in the other order.
    said = load_board(written(tmp_path, GRID.replace("gap_mm = 9", 'gap_mm = 9\ntag_corners = "opencv"')))
    with pytest.raises(RegistrationError) as caught:
        locate_board(said, CAMERA, picture)
    assert caught.value.reason is RegistrationFailure.BOARD_DOES_NOT_FIT


@pytest.mark.parametrize(("said", "ambiguity"), [("", Ambiguity.BOARD_TAGS), ('tag_corners = "opencv"', None)])
def test_one_tag_alone_does_not_tell_the_order_of_its_corners(tmp_path, said, ambiguity):
    text = (
        GRID.replace("columns = 4", "columns = 1")
        .replace("rows = 3", f"rows = 1\n{said}")
        .replace("30\ngap", "80\ngap")
    )
    board = load_board(written(tmp_path, text))
    found = locate_board(board, CAMERA, picture_of(board, BOARD_POSE))
    assert found is not None
    assert found.ambiguity is ambiguity


def test_a_real_board_of_the_other_order_is_read():
    """The order of the corners, not the pose: three frames, against poses from the same tags by another program.

    The tags' pitch is documented; their width, 96 mm, is what leaves the least residual.
    """
    folder = real_data("rbt_scene")
    sizes = {"columns": 4, "rows": 3, "marker_mm": 96.0, "gap_mm": 24.2}
    board = FiducialBoard(BoardFile(kind="grid", dictionary="apriltag_36h11", **sizes))
    camera, true = md.load_camera(folder / "camera.yaml"), load_trajectory(folder / "tags_raw.txt")
    first, *others = (
        locate_board(board, camera, cv2.imread(str(folder / f"rgb/{frame:04}.jpg"), cv2.IMREAD_GRAYSCALE))
        for frame in (0, 12, 24, 36)
    )
    assert first is not None
    for frame, found in zip((12, 24, 36), others, strict=True):
        assert found is not None
        assert found.rms_px < 1.0
        assert found.ambiguity is None
        motion = (first.camera_from_board @ found.camera_from_board.inverse).matrix
        expected = true.camera_from_world[0] @ np.linalg.inv(true.camera_from_world[frame])
        assert np.linalg.norm(motion[:3, 3] - expected[:3, 3]) < 4e-3  # of up to 102 mm
        assert np.degrees((Rotation.from_matrix(motion[:3, :3].T @ expected[:3, :3])).magnitude()) < 0.25


def test_an_object_on_a_board_is_where_the_file_says(tmp_path, scene):
    board = load_board(written(tmp_path, GRID))
    placed = BoardInitializer(board).register(scene.model, CAMERA, picture_of(board, BOARD_POSE))
    turn = Rotation.from_euler("xyz", [10, 5, 30], degrees=True).as_matrix()
    truth = BOARD_POSE @ RigidTransform(turn, np.array([0.020, -0.040, -0.015]))
    assert 1e3 * mean_error(scene.model, placed.state, State(scene.model.default, truth)) < 1.0
    assert placed.warnings == (AssumedUndeformed(),)
    off = placed.state.camera_from_object.translation - truth.translation
    d = len(scene.model.parameters)
    assert (np.abs(off) < 5.0 * np.sqrt(np.diag(placed.covariance)[d + 3 :])).all()


def test_a_board_that_is_not_seen_or_of_other_sizes_is_refused(tmp_path, scene):
    board = load_board(written(tmp_path, GRID))
    blank = np.full((CAMERA.height, CAMERA.width), 120, dtype=np.uint8)
    with pytest.raises(RegistrationError) as caught:
        BoardInitializer(board).register(scene.model, CAMERA, blank)
    assert caught.value.reason is RegistrationFailure.BOARD_NOT_SEEN
    narrow = load_board(written(tmp_path, GRID.replace("gap_mm = 9", "gap_mm = 20")))
    with pytest.raises(RegistrationError) as caught:
        locate_board(narrow, CAMERA, picture_of(board, BOARD_POSE))
    assert caught.value.reason is RegistrationFailure.BOARD_DOES_NOT_FIT


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"apriltag_36h11"', '"4x4_49"'), "dictionary must be one of"),
        (("gap_mm = 9", ""), "a grid needs gap_mm"),
        (("gap_mm = 9", "gap_mm = 9\nsquare_mm = 40"), "square_mm is for the other kind of board"),
        (("columns = 4", "columns = 0"), "columns: "),
        (("marker_mm = 30", "marker_mm = 0.03"), "markers of 0.03 mm cannot be seen; sizes are in millimetres"),
        (("columns = 4", "columns = 50\nmargin = 3"), "unknown key margin; known here: kind, dictionary"),
    ],
)
def test_mistakes_in_a_board_file_are_named(tmp_path, change, message):
    with pytest.raises(RegistrationError, match=message):
        load_board(written(tmp_path, GRID.replace(*change)))


@pytest.mark.parametrize("marker_mm", [19.0, 20.0, 22.2, 33.0, 45.5])
@pytest.mark.parametrize("kind", ["grid", "charuco"])
def test_markers_of_all_sizes_are_printed_where_they_belong(kind, marker_mm):
    spacing, pitch_mm = ("gap_mm", marker_mm + 9.0) if kind == "grid" else ("square_mm", 1.41 * marker_mm)
    sizes = {"marker_mm": marker_mm, spacing: 9.0 if kind == "grid" else pitch_mm}
    board, density = FiducialBoard(BoardFile(kind=kind, dictionary="apriltag_36h11", columns=5, rows=7, **sizes)), 8000
    image = cv2.copyMakeBorder(board.image(density), *[80] * 4, cv2.BORDER_CONSTANT, value=255)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    # Row by row, in a charuco board in the squares whose colour is not the first one's.
    places = [(row, column) for row in range(7) for column in range(5) if kind == "grid" or (row + column) % 2]
    assert sorted(ids.ravel().tolist()) == list(range(len(places)))
    for found, number in zip(corners, ids.ravel(), strict=True):
        row, column = places[number]
        first = np.array([column, row]) * pitch_mm + (0.0 if kind == "grid" else 0.5 * (pitch_mm - marker_mm))
        expected = 1e-3 * density * (first + marker_mm * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])) + 79.5
        assert np.abs(found[0] - expected).max() < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["png", "pdf"])
def test_a_board_is_printed_in_its_size(tmp_path, suffix, capsys):
    target = tmp_path / f"board.{suffix}"
    assert main(["board", str(written(tmp_path, GRID)), "-o", str(target)]) == 0
    assert "147 x 108 mm" in capsys.readouterr().out
    if suffix == "png":
        image = cv2.imread(str(target), cv2.IMREAD_GRAYSCALE)
        dots = 300 / 0.0254
        assert image.shape[1] == pytest.approx((0.147 + 0.03) * dots, abs=2)
        points, pixels = load_board(tmp_path / "board.toml").find(image)
        assert len(points) == 4 * 12
        # A metre of the board is as many dots in the file.
        apart = np.linalg.norm(np.ptp(pixels, axis=0)) / np.linalg.norm(np.ptp(points, axis=0))
        assert apart == pytest.approx(dots, rel=0.005)


#: Seen so, the other order of its tags' corners has no pose at all.
FEW_TAGS = GRID.replace("columns = 4\nrows = 3", "columns = 3\nrows = 2").replace("30\ngap_mm = 9", "35\ngap_mm = 10")


@pytest.mark.parametrize(
    ("text", "printed", "angles"),
    [
        (GRID, lambda board: board, (-0.3, 0.0, 0.3)),
        (GRID, turned_tags, (-0.3, 0.0, 0.3)),
        (FEW_TAGS, lambda board: board, (0.6, 0.45, 0.3)),
    ],
    ids=["OpenCV's tags", "AprilTag's", "few tags"],
)
def test_a_board_in_a_map_tells_the_unit_and_the_place(tmp_path, scene, text, printed, angles, refused, capsys):
    board = printed(load_board(written(tmp_path, text)))
    world = SimilarityTransform(3.7, rotation_exp(np.array([0.4, -0.9, 1.3])), np.array([0.5, -1.2, 2.0]))
    rigid_map = RigidMap()
    rigid_map.add_points(np.zeros((1, 3)), np.zeros((1, 2)), 0, GOOD)
    for k, angle in enumerate(angles):
        pose = RigidTransform(rotation_exp(np.array([0.2, angle, 0.1])) @ BOARD_POSE.rotation, BOARD_POSE.translation)
        rotation = pose.rotation @ world.rotation.T
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = rotation, 3.7 * pose.translation - rotation @ world.translation
        normalized = normalize_contrast(picture_of(board, pose), 31)
        rigid_map.add_keyframe(Keyframe(k, 0.1 * k, normalized, view, np.arange(1), np.zeros((1, 2))))
    save_map(tmp_path / "map.h5", rigid_map, CAMERA)
    save_camera(tmp_path / "camera.yaml", CAMERA)
    save_model(tmp_path / "sheet.morph", scene.model)
    files = [str(tmp_path / name) for name in ("map.h5", "sheet.morph", "camera.yaml", "board.toml", "place")]
    arguments = ["register", files[0], "--model", files[1], "--camera", files[2], "--board", files[3]]
    assert main([*arguments, "-o", files[4]]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    said = dict(pair.split("=") for pair in line.split())
    assert float(said["map_units_per_metre"]) == pytest.approx(3.7, rel=2e-3)
    assert list(said)[1:] == ["rms_px", "place_std_mm", "angle_std_deg", "ambiguous"]
    assert said["ambiguous"] == "no"
    placed = load_registration(tmp_path / "place" / "registration.json", scene.model)
    assert placed.facts["map_units_per_metre"] == pytest.approx(3.7, rel=2e-3)
    turn = Rotation.from_euler("xyz", [10, 5, 30], degrees=True).as_matrix()
    truth = pose @ RigidTransform(turn, np.array([0.020, -0.040, -0.015]))
    assert 1e3 * mean_error(scene.model, placed.state, State(scene.model.default, truth)) < 1.5
    assert placed.covariance is not None
    # The folder may be moved as a whole.
    content = json.loads((tmp_path / "place" / "registration.json").read_text())
    assert (content["map"], content["model"]) == ("../map.h5", "../sheet.morph")
    # It is not replaced by accident.
    (tmp_path / "place" / "registration.json").write_text("{}")
    assert "place holds a registration already" in refused(*arguments, "-o", files[4])
    assert (tmp_path / "place" / "registration.json").read_text() == "{}"
    assert main([*arguments, "-o", files[4], "--overwrite"]) == 0
    assert load_registration(tmp_path / "place" / "registration.json", scene.model).facts == placed.facts


def print_on_sheet(scene):
    corners = [[-LENGTH / 2, WIDTH / 2, 0], [LENGTH, 0, 0], [0, -WIDTH, 0]]
    return PictureInitializer(scene.stage.texture, np.array(corners), None)


def grey(scene, states):
    return np.ascontiguousarray(scene.stage.frame(states)[:, :, 0])


@pytest.mark.slow
def test_a_picture_of_the_print_places_a_bent_sheet(scene):
    truth = scene.state(0.3)
    by_rectangle = print_on_sheet(scene).register(scene.model, CAMERA, grey(scene, [truth]))
    assert 1e3 * mean_error(scene.model, by_rectangle.state, truth) < 3.0
    by_nodes = PictureInitializer(scene.stage.texture, None, scene.stage.coordinates)
    placed = by_nodes.register(scene.model, CAMERA, grey(scene, [truth]))
    assert 1e3 * mean_error(scene.model, placed.state, truth) < 1.5
    assert placed.facts["n_agreeing"] > 200
    assert not placed.ambiguous


@pytest.mark.slow
def test_a_second_sheet_with_the_print_is_told_and_another_print_is_refused(scene):
    truth = scene.state(0.3)
    two = grey(scene, [truth, aside(truth, [scene.beside, 0.02, 0.0])])
    placed = print_on_sheet(scene).register(scene.model, CAMERA, two)
    assert any(isinstance(warning, Ambiguous) for warning in placed.warnings)
    other = SCENES["sheet"](7)
    with pytest.raises(RegistrationError) as caught:
        print_on_sheet(scene).register(scene.model, CAMERA, grey(other, [other.state(0.3)]))
    assert caught.value.reason is RegistrationFailure.PICTURE_NOT_SEEN


def test_a_picture_file_is_read_and_its_mistakes_named(tmp_path, scene):
    cv2.imwrite(str(tmp_path / "print.png"), scene.stage.texture)
    path = tmp_path / "picture.toml"
    path.write_text(PICTURE)
    read = load_picture(path)
    np.testing.assert_allclose(read.rectangle, print_on_sheet(scene).rectangle)
    np.testing.assert_array_equal(read.image, scene.stage.texture)
    path.write_text('image = "print.png"\n')
    with pytest.raises(RegistrationError, match="either rectangle, or coordinates"):
        load_picture(path)


def guess_near(scene, truth, shift, turn):
    pose = truth.camera_from_object
    angles = Rotation.from_matrix(rotation_exp(np.array(turn)) @ pose.rotation).as_euler("xyz", degrees=True)
    position = 1e3 * (pose.translation + shift)
    values = {p.name: p.display(v) for p, v in zip(scene.model.parameters, truth.parameters, strict=True)}
    return GuessInitializer(
        GuessFile.model_validate(
            {"pose": {"position_mm": tuple(position), "rotation_deg": tuple(angles)}, "parameters": values}
        )
    )


@pytest.mark.parametrize("name", ["sheet", "wedge in the hand"])
def test_a_guess_is_refined_to_a_hundredth_of_the_distance(name):
    scene = SCENES[name](0)
    truth = scene.state(0.0)
    guess = guess_near(scene, truth, np.array([6e-3, -5e-3, 8e-3]), [0.02, -0.03, 0.03])
    placed = guess.register(scene.model, scene.stage.camera, grey(scene, [truth]))
    off = 1e3 * mean_error(scene.model, placed.state, truth)
    assert off < 1e3 * mean_error(scene.model, guess.state(scene.model), truth)
    assert off < 25.0 * truth.camera_from_object.translation[2]
    assert placed.facts["outline_on_edges"] > 0.8
    assert placed.facts["by_chance"] < 0.15


@pytest.mark.parametrize("name", ["sheet", "wedge in the hand"])
def test_a_guess_that_the_image_contradicts_is_refused(name):
    scene = SCENES[name](0)
    truth = scene.state(0.0)
    far = guess_near(scene, truth, np.array([0.08, 0.05, 0.0]), [0.1, 0.1, 0.3])
    near = guess_near(scene, truth, np.zeros(3), [0.0, 0.0, 0.0])
    for guess, shown in ((far, [truth]), (near, [])):
        with pytest.raises(RegistrationError) as caught:
            guess.register(scene.model, scene.stage.camera, grey(scene, shown))
        assert caught.value.reason is RegistrationFailure.GUESS_CONTRADICTED


@pytest.fixture(scope="module")
def recording(tmp_path_factory, scene):
    """Twelve frames of the sheet, which jumps to another place behind a covered camera at frame 6."""
    folder = tmp_path_factory.mktemp("recording")
    images = {
        number: scene.stage.frame([state_of(scene, number)], cover=1.0 if number in (4, 5) else 0.0)
        for number in range(12)
    }
    write_recording(folder, images, scene.model)
    cv2.imwrite(str(folder / "print.png"), scene.stage.texture)
    (folder / "picture.toml").write_text(PICTURE)
    return folder


def state_of(scene, number):
    return scene.state(0.01 * number + (0.3 if number > 5 else 0.0))


def options(recording, output, **changes):
    files = {"frames": "frames", "model": "sheet.morph", "camera": "camera.yaml"}
    return md.TrackOptions(
        **{name: recording / path for name, path in files.items()}, output=output, video=False, **changes
    )


def frames_of(summary, kind):
    return [notice["frame"] for notice in summary["notices"] if notice["kind"] == kind]


def error_mm(scene, run, row):
    """Mean distance of the nodes from the truth in one frame."""
    found = State(run.parameters[row], RigidTransform.from_matrix(run.camera_from_object[row]))
    return 1e3 * mean_error(scene.model, found, state_of(scene, run.frames[row]))


def test_a_run_starts_from_a_picture_and_is_registered_anew(recording, scene, tmp_path):
    arguments = ["track", str(recording / "frames"), "--model", str(recording / "sheet.morph")]
    arguments += ["--camera", str(recording / "camera.yaml"), "--picture", str(recording / "picture.toml")]
    arguments += ["--reregister-at", "7", "--reregister-at", "5", "--no-video", "-o", str(tmp_path / "run")]
    assert main(arguments) == 0
    run = load_run(tmp_path / "run")
    assert run.tracked.tolist() == [number not in (4, 5) for number in range(12)]
    assert max(error_mm(scene, run, row) for row in (0, 3, 7, 11)) < 4.0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["registration"]["from"] == "picture"
    assert (frames_of(summary, "reregistered"), frames_of(summary, "not_reregistered")) == ([7], [5])


@pytest.mark.slow
def test_a_live_run_is_registered_anew_in_the_frame_or_the_next_that_is_not_dropped(recording, scene, tmp_path):
    start = InitializerFiles(picture=recording / "picture.toml")
    summary = md.track(options(recording, tmp_path, initializer=start, reregister_at=((7, None),), live=True))
    (frame,) = frames_of(summary, "reregistered")
    assert 7 <= frame <= 11
    run = load_run(tmp_path)
    assert (run.frames[-1], run.status[-1]) == (11, "tracked")
    assert error_mm(scene, run, -1) < 4.0


def test_landmarks_of_another_frame_register_the_object_anew(recording, scene, tmp_path):
    files = {number: tmp_path / f"landmarks_{number}.csv" for number in (0, 8)}
    for number, path in files.items():
        write_landmarks(path, scene.model, state_of(scene, number), seed=1)
    run = options(recording, tmp_path / "run", landmarks=files[0], reregister_at=((8, files[8]),), last=9)
    assert frames_of(md.track(run), "reregistered") == [8]
    assert error_mm(scene, load_run(tmp_path / "run"), 9) < 0.5


def test_matches_of_one_spot_span_no_pose(scene):
    """A texture that repeats makes many matches of the same few points; they must not stop a run."""
    points = BoundPoints.from_surface(scene.model, SurfacePoints(np.full(20, 5), np.tile([0.2, 0.3, 0.5], (20, 1))))
    pixels = np.random.default_rng(0).uniform(100.0, 300.0, (20, 2))
    state, agreeing = state_from_matches(Estimator(scene.model, CAMERA), points, pixels, [scene.model.default])
    assert state is None
    assert agreeing.sum() < LEAST_MATCHES
