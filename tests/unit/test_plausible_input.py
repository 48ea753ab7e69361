"""Input that is well formed but cannot be meant: wrong units, wrong folders, another camera."""

from dataclasses import replace

import cv2
import h5py
import netgen.occ as occ
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam import cli
from morph_dslam.errors import CameraError, MapError, SourceError, StudyError
from morph_dslam.extend.studies import build_rigid
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.checksum import BLOCK
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.meshing.mesh_files import load_mesh
from morph_dslam.meshing.netgen_meshing import MOST_CELLS
from morph_dslam.slam.map_files import save_map
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.result import SlamFrame, SlamStatus
from morph_dslam.slam.rigid_map import GOOD, Followed, Keyframe, RigidMap
from morph_dslam.slam.run_notes import run_notes, time_notes
from morph_dslam.slam.slam import Slam
from tests.support.meshes import cell_volumes

CAMERA = md.Camera(640, 480, 528.0, 530.0, 319.5, 239.5)
LENS = (-0.2, 0.05, 1e-3, -1e-3)
#: The faces of a cube, outwards, by corners whose numbers are x + 2 y + 4 z.
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]


def written_block(path, *lengths):
    corners = [(x * lengths[0], y * lengths[1], z * lengths[2]) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners]
    path.write_text("\n".join(lines + ["f " + " ".join(str(i + 1) for i in face) for face in QUADS]) + "\n")
    return path


def saved_map(path, camera, baseline_px=0.0, trajectory=None):
    """A map of one keyframe and two points."""
    rigid_map = RigidMap(baseline_px)
    rigid_map.add_points(np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]), np.zeros((2, 2)), 0, GOOD)
    seen = Followed(np.arange(2), np.array([[319.5, 239.5], [372.3, 239.5]]))
    rigid_map.add_keyframe(
        Keyframe(0, 0.0, np.zeros((480, 640), np.uint8), np.eye(4), seen.ids, seen.pixels, seen.right)
    )
    save_map(path, rigid_map, camera, trajectory)
    return path


@pytest.mark.parametrize(
    ("change", "degrees"), [({"fx": 4.2, "fy": 4.2}, 178), ({"fx": 35.0, "fy": 35.0}, 168), ({"fy": 35.0}, 163)]
)
def test_a_focal_length_in_millimetres_is_refused_before_anything_is_written(tmp_path, capsys, change, degrees):
    # Half the angle is that of the side opposite to half the image's width or height, at the focal length.
    save_camera(tmp_path / "camera.yaml", replace(CAMERA, **change))
    (tmp_path / "film").mkdir()
    cv2.imwrite(str(tmp_path / "film" / "000.png"), np.zeros((480, 640, 3), np.uint8))
    command = ["slam", str(tmp_path / "film"), "--camera", str(tmp_path / "camera.yaml"), "-o", str(tmp_path / "run")]
    assert cli.main(command) == 2
    said = capsys.readouterr().err
    assert f"is a view of {degrees} degrees: fx and fy are in pixels, not in millimetres" in said
    assert "camera.yaml" in said
    assert not (tmp_path / "run").exists()


def test_wide_lenses_and_fisheyes_may_be_meant():
    with pytest.raises(CameraError, match="136 degrees"):
        md.Camera(640, 480, 127.9, 127.9, 320.0, 240.0).check_focal_length("camera.yaml")
    md.Camera(640, 480, 128.1, 128.1, 320.0, 240.0).check_focal_length("camera.yaml")
    md.Camera(640, 480, 60.0, 60.0, 320.0, 240.0, (0.0,) * 4, "fisheye").check_focal_length("camera.yaml")


def test_an_interrupt_before_the_first_frame_claims_nothing_that_is_not_there(tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("morph_dslam.slam.run.start_slam", interrupted)
    save_camera(tmp_path / "camera.yaml", CAMERA)
    (tmp_path / "film").mkdir()
    cv2.imwrite(str(tmp_path / "film" / "000.png"), np.zeros((480, 640, 3), np.uint8))
    command = ["slam", str(tmp_path / "film"), "--camera", str(tmp_path / "camera.yaml"), "-o", str(tmp_path / "run")]
    assert cli.main(command) == 130
    assert "interrupted; the frames seen so far, if any, and their map are kept" in capsys.readouterr().err
    assert not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize(("of_map", "given"), [(0.03, 0.0), (0.0, 0.03), (0.03, -0.03)])
def test_a_map_made_with_another_readout_time_is_refused(tmp_path, of_map, given):
    path = saved_map(tmp_path / "map.h5", replace(CAMERA, readout_s=of_map))
    assert len(md.load_scene(path, replace(CAMERA, readout_s=of_map)).points) == 2
    with pytest.raises(MapError, match=rf"made with readout_s = {of_map:g}, the camera file has {given:g}"):
        md.load_scene(path, replace(CAMERA, readout_s=given))


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_maps_of_earlier_releases_say_nothing_of_readout_time_and_lens(tmp_path, readout_s):
    path = saved_map(tmp_path / "map.h5", CAMERA)
    path.write_bytes(path.read_bytes()[BLOCK:])  # such maps had no checksum either
    with h5py.File(path, "r+") as file:
        for name in ("readout_s", "distortion", "lens_model"):
            del file.attrs[name]
    scene = md.load_scene(path, replace(CAMERA, readout_s=readout_s, distortion=LENS))
    assert scene.camera_notes == ()
    assert len(scene.points) == 2


def test_a_map_made_with_another_lens_says_by_how_much(tmp_path):
    path = saved_map(tmp_path / "map.h5", replace(CAMERA, distortion=LENS))
    columns, rows = np.meshgrid(np.linspace(0, 639, 17), np.linspace(0, 479, 13))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    recorded, _ = cv2.projectPoints(CAMERA.rays(pixels), np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(LENS))
    most = np.linalg.norm(recorded.reshape(-1, 2) - pixels, axis=1).max()
    (note,) = md.load_scene(path, CAMERA).camera_notes
    assert f"by up to {most:.1f} px" in note
    assert most > 10.0
    # The same lens in another form, and a calibration that differs by little.
    for lens in ((*LENS, 0.0), (LENS[0] + 1e-5, *LENS[1:])):
        assert md.load_scene(path, replace(CAMERA, distortion=lens)).camera_notes == ()


@pytest.mark.parametrize(
    ("timestamps", "readout_s", "words"),
    [
        (np.arange(9) / 30.0, 0.033, ()),
        (
            [0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0],
            0.0,
            ("frames 1, 3, 4, 5, 6 and 1 more have the timestamp of the frame before",),
        ),
        ([0.0, 0.1, 0.3, 0.2, 0.4], 0.0, ("the timestamps go back at frame 3",)),
        (np.arange(9) * 33_333_333.0, 0.02, ("3.33e+07 s apart", "nanoseconds")),
        (np.arange(9) * 33.3, 0.02, ("readout_s", "did not count", "33.3 s apart")),
        (np.arange(9) * 33.3, 0.0, ()),
        (np.arange(9) / 30.0, 0.33, ("readout_s", "0.33 s", "0.0333 s")),
        # A tenth above the time between frames is the error of an estimate.
        (np.arange(9) / 30.0, 0.0337, ()),
        (np.arange(9) / 30.0, 0.0366, ()),
        (np.arange(9) / 30.0, -0.0368, ("readout_s", "0.0368 s", "0.0333 s")),
        ([5.0], 0.02, ()),
    ],
)
def test_times_of_frames_that_cannot_be_right_are_told(timestamps, readout_s, words):
    frames = [SlamFrame(k, float(time), SlamStatus.TRACKED) for k, time in enumerate(timestamps)]
    notes = list(time_notes(frames, readout_s))
    assert len(notes) == bool(words)
    assert all(word in notes[0] for word in words)


def test_depth_images_that_do_not_belong_to_the_pixels_are_told():
    image, depth = np.zeros((CAMERA.height, CAMERA.width), np.uint8), np.ones((CAMERA.height, CAMERA.width), np.float32)
    for slam, n_told in ((Slam(CAMERA), 2), (Slam(CAMERA, with_depth=True), 0), (Slam(CAMERA, SlamOptions(False)), 0)):
        frames = [slam.process_frame(image, k, k / 30.0, depth) for k in range(2)]
        told = [note for note in run_notes(slam, frames, frames) if "not registered" in note]
        assert [note[:2] for note in told] == ["2 "] * bool(n_told)


def test_a_folder_and_a_point_cloud_are_no_maps_but_the_message_says_what_is(tmp_path, capsys):
    run = tmp_path / "scan"
    run.mkdir()
    saved_map(run / "map.h5", CAMERA)
    (run / "map.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    for given in (run, run / "map.ply"):
        with pytest.raises(MapError, match=rf"{given} is a .*give .*{run / 'map.h5'}"):
            md.load_scene(given, CAMERA)
    save_camera(tmp_path / "camera.yaml", CAMERA)
    (tmp_path / "film").mkdir()
    cv2.imwrite(str(tmp_path / "film" / "000.png"), np.zeros((480, 640, 3), np.uint8))
    command = ["slam", str(tmp_path / "film"), "--camera", str(tmp_path / "camera.yaml"), "--map", str(run)]
    assert cli.main([*command, "-o", str(tmp_path / "run")]) == 2
    assert f"{run} is a folder: give the map in it, {run / 'map.h5'}" in capsys.readouterr().err
    with pytest.raises(MapError, match=r"there is no map .*elsewhere"):
        md.load_scene(tmp_path / "elsewhere", CAMERA)


@pytest.mark.slow
@pytest.mark.parametrize(("baseline_px", "is_metric"), [(0.0, False), (60.0, True)])
def test_a_path_without_scale_has_no_error_without_alignment_of_scale(tmp_path, capsys, baseline_px, is_metric):
    times = np.arange(20.0) / 10.0
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, 3] = np.column_stack([np.cos(times), np.sin(times), 0.1 * times])
    truth, half = Trajectory(times, poses), poses.copy()
    half[:, :3, 3] *= 0.5
    run = tmp_path / "run"
    run.mkdir()
    save_trajectory(run / "trajectory.txt", Trajectory(times, half))
    save_trajectory(tmp_path / "alone.txt", Trajectory(times, half))
    save_trajectory(tmp_path / "truth.txt", truth)
    saved_map(run / "map.h5", CAMERA, baseline_px)
    # The best rigid motion leaves half of each point's distance from the path's centre.
    centred = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    left = 500.0 * np.sqrt(np.mean(np.sum(centred**2, axis=1)))
    for given, without_scale in ((run, is_metric), (run / "trajectory.txt", is_metric), (tmp_path / "alone.txt", True)):
        assert cli.main(["evaluate", str(given), "--trajectory", str(tmp_path / "truth.txt")]) == 0
        wrote, *notes, line = capsys.readouterr().out.splitlines()
        beside = tmp_path / "alone_evaluation" if given.stem == "alone" else run / "trajectory_evaluation"
        assert wrote == f"wrote {beside}.json and {beside.name}.png"
        assert beside.with_suffix(".json").is_file()
        assert beside.with_suffix(".png").is_file()
        figures = dict(part.split("=") for part in line.split())
        assert float(figures["ate_se3_mm"]) == pytest.approx(left if without_scale else np.nan, abs=0.01, nan_ok=True)
        assert (float(figures["ate_sim3_mm"]), float(figures["scale"])) == pytest.approx((0.0, 2.0), abs=1e-3)
        expected = "the true path is 2 times" if without_scale else "the scale of the run's map is unknown"
        assert [note.startswith(f"note: {expected}") for note in notes] == [True]
    assert (md.evaluate_trajectory(run, truth)["se3"] is None) != is_metric


def test_a_folder_of_image_folders_names_the_one_to_give(tmp_path):
    folder = tmp_path / "rbt_scene"
    for name, count in (("depth", 2), ("rgb", 3), ("notes", 0)):
        (folder / name).mkdir(parents=True)
        for number in range(count):
            cv2.imwrite(
                str(folder / name / f"{number:03}.png"), np.zeros((4, 4), np.uint16 if name == "depth" else np.uint8)
            )
    with pytest.raises(
        SourceError, match=r"depth \(2 images\), rgb \(3 images\): give .*rbt_scene/rgb.* rgb\.txt"
    ) as said:
        md.open_source(folder)
    assert "notes" not in str(said.value)
    assert len(md.open_source(folder / "rgb")) == 3
    with pytest.raises(SourceError, match=r"holds no images \([^)]*\)$"):
        md.open_source(folder / "notes")


@pytest.mark.parametrize(("length", "unit", "better"), [(85.0, "m", "mm"), (8.5e4, "mm", "mm"), (0.04, "mm", "m")])
def test_a_rigid_object_of_impossible_size_is_refused(tmp_path, length, unit, better):
    path = written_block(tmp_path / "cube.obj", length, length, length)
    with pytest.raises(StudyError, match=rf"cube\.obj measures .* m, which is hardly meant.* such as {better}\)"):
        build_rigid(path, unit, tmp_path / "cube.morph")
    assert not (tmp_path / "cube.morph").exists()


@pytest.mark.parametrize(("length", "is_warned"), [(0.085, True), (2.8, True), (3.0, False), (85.0, False)])
def test_a_rigid_object_of_unusual_size_is_warned_of(tmp_path, capsys, length, is_warned):
    # 5 mm is the diagonal of a cube of 2.89 mm.
    path = written_block(tmp_path / "cube.obj", length, length, length)
    assert cli.main(["build", "--rigid", str(path), "--unit", "mm", "-o", str(tmp_path / "cube.morph")]) == 0
    said = capsys.readouterr().err
    assert (
        f"measures {length:g} x {length:g} x {length:g} mm; if that is not so, 'mm' is not the unit" in said
    ) == is_warned
    assert ("warning" in said) == is_warned


@pytest.mark.parametrize(
    ("lengths", "unit", "size", "message"),
    [
        ((85.0, 85.0, 85.0), "m", 0.014, "measures 85 x 85 x 85 m, which is hardly meant"),
        ((1.0, 1.0, 1.0), "m", 0.004, r"1 x 1 x 1 m: cells of at most size = 4 mm .* some 1e\+08"),
        ((3.0, 3.0, 1e-4), "m", 0.001, r"3 x 3 x 0\.0001 m: cells of at most size = 1 mm"),
    ],
    ids=["impossible", "many", "many in a thin wall"],
)
@pytest.mark.parametrize("kind", ["obj", "step"])
def test_a_cell_size_that_would_take_for_ever_is_refused(tmp_path, kind, lengths, unit, size, message):
    path = tmp_path / f"block.{kind}"
    if kind == "obj":
        written_block(path, *lengths)
    else:
        occ.Box((0, 0, 0), tuple(1e3 * length for length in lengths)).WriteStep(str(path))
        unit = "mm"  # as STEP files state it
    with pytest.raises(StudyError, match=message):
        load_mesh(path, unit, size)


@pytest.mark.slow
@pytest.mark.parametrize("lengths", [(10.0, 10.0, 10.0), (40.0, 40.0, 1.0)])
def test_the_number_of_cells_is_foreseen_within_a_factor_of_two(tmp_path, monkeypatch, lengths):
    path, size = written_block(tmp_path / "block.obj", *lengths), 1.2e-3
    mesh = load_mesh(path, "mm", size)
    assert cell_volumes(mesh).sum() == pytest.approx(np.prod(lengths) * 1e-9)
    assert mesh.n_cells < MOST_CELLS
    where = "morph_dslam.meshing.netgen_meshing.MOST_CELLS"
    monkeypatch.setattr(where, mesh.n_cells // 2)
    with pytest.raises(StudyError, match=r"size = 1\.2 mm"):
        load_mesh(path, "mm", size)
    monkeypatch.setattr(where, 2 * mesh.n_cells)
    load_mesh(path, "mm", size)
