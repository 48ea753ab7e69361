"""Points measured again in all keyframes, on a tilted plane whose images follow from a formula."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.slam.least_squares_matching import measure_again, moved_along
from morph_dslam.slam.result import SlamFrame, SlamStatus
from morph_dslam.slam.rigid_map import GOOD, Followed, Keyframe, RigidMap

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
INTRINSICS = np.array([FOCAL, FOCAL, 160.0, 120.0])
#: The plane z = 2 + 0.5 x; lengths in units of its distance.
SLOPE = 0.5
CENTRES = ((-0.7, 0.1, 0.0), (-0.3, -0.1, 0.1), (0.0, 0.0, 0.0), (0.4, 0.15, -0.1), (0.8, -0.05, 0.1))


def cameras():
    """camera_from_world (4, 4), all looking at the middle of the plane, turned about their axes by up to 24 degrees."""
    result = []
    for number, centre in enumerate(np.array(CENTRES)):
        forward = np.array([0.0, 0.0, 2.0]) - centre
        sideways = np.cross([0.0, 1.0, 0.0], forward)
        axes = np.array([axis / np.linalg.norm(axis) for axis in (sideways, np.cross(forward, sideways), forward)])
        camera = np.eye(4)
        camera[:3, :3] = Rotation.from_rotvec([0.0, 0.0, np.radians(6.0 * number)]).as_matrix() @ axes
        camera[:3, 3] = -camera[:3, :3] @ centre
        result.append(camera)
    return result


def on_plane(camera, pixels):
    """Where the rays of pixels (n, 2) meet the plane: x and y (n, 2)."""
    rays = np.column_stack([(pixels - INTRINSICS[2:]) / FOCAL, np.ones(len(pixels))]) @ camera[:3, :3]
    centre = -camera[:3, :3].T @ camera[:3, 3]
    along = (2.0 + SLOPE * centre[0] - centre[2]) / (rays[:, 2] - SLOPE * rays[:, 0])
    return (centre + along[:, None] * rays)[:, :2]


def seen(camera, places):
    """Pixels (n, 2) of places (n, 2) on the plane."""
    world = np.column_stack([places, 2.0 + SLOPE * places[:, 0]])
    local = world @ camera[:3, :3].T + camera[:3, 3]
    return FOCAL * local[:, :2] / local[:, 2:] + INTRINSICS[2:]


def image(camera, gain, rng):
    """What a camera shows of a plane painted with waves, with noise."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    places = on_plane(camera, np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    waves = np.random.default_rng(3)
    grey = np.zeros(len(places))
    for frequency in waves.uniform(20.0, 90.0, 24):
        direction, phase = waves.uniform(0.0, 2.0 * np.pi, 2)
        grey += np.sin(frequency * (places @ [np.cos(direction), np.sin(direction)]) + phase)
    grey = 128.0 + gain * 14.0 * grey + rng.normal(0.0, 2.0, len(grey))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH)


def scene(covered=None):
    """A map of the plane whose pixels are off by up to about 1.5; of keyframe ``covered`` another image is shown."""
    rng, rigid_map = np.random.default_rng(1), RigidMap()
    grid = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 8), np.linspace(-0.3, 0.3, 6)), axis=-1).reshape(-1, 2)
    world = np.column_stack([grid, 2.0 + SLOPE * grid[:, 0]])
    rigid_map.add_points(world, seen(cameras()[0], grid), 0, GOOD)
    for number, camera in enumerate(cameras()):
        pixels = seen(camera, grid) + rng.normal(0.0, 0.6, (len(grid), 2))
        shown = image(camera, 1.0 - 0.1 * number, rng)
        if number == covered:
            shown = rng.integers(0, 255, shown.shape).astype(np.uint8)
        rigid_map.add_keyframe(Keyframe(number, number / 30.0, shown, camera, np.arange(len(grid)), pixels))
    return rigid_map


def scatter_px(rigid_map):
    """How far the keyframes' pixels of each point are apart on the plane, root mean square, pixels there."""
    places = np.full((len(rigid_map.keyframes), len(rigid_map.state), 2), np.nan)
    for row, keyframe in enumerate(rigid_map.keyframes):
        places[row, keyframe.point_ids] = on_plane(keyframe.camera_from_world, keyframe.pixels)
    return FOCAL / 2.0 * np.sqrt(np.nanmean(np.nanvar(places, axis=0).sum(axis=1)))


def test_points_are_at_one_place_in_all_views():
    rigid_map = scene()
    before = scatter_px(rigid_map)
    measure_again(rigid_map, INTRINSICS)
    n_kept = sum(len(keyframe.point_ids) for keyframe in rigid_map.keyframes)
    assert before > 0.6
    assert n_kept > 0.95 * len(rigid_map.keyframes) * len(rigid_map.state)
    assert scatter_px(rigid_map) < 0.05


def test_the_pixels_that_patches_are_cut_out_at_are_those_of_their_keyframes():
    rigid_map = scene()
    measure_again(rigid_map, INTRINSICS)
    newest = rigid_map.keyframes[-1]
    rows, is_seen = newest.rows_of(np.arange(len(rigid_map.state)))
    assert (rigid_map.template_keyframe == 4).all()
    assert is_seen.mean() > 0.9
    assert np.array_equal(rigid_map.template_pixels[is_seen], newest.pixels[rows[is_seen]])


@pytest.mark.parametrize("covered", [0, 4])
def test_what_shows_something_else_is_taken_out(covered):
    rigid_map = scene(covered)
    measure_again(rigid_map, INTRINSICS)
    counts = [len(keyframe.point_ids) / len(rigid_map.state) for keyframe in rigid_map.keyframes]
    assert counts[covered] < 0.4
    assert np.delete(counts, covered).min() > 0.6


def test_points_that_two_views_alone_show_stay():
    rigid_map = scene(1)
    del rigid_map.keyframes[2:]
    rigid_map.template_keyframe[:], before = 1, rigid_map.keyframes[1].pixels.copy()
    measure_again(rigid_map, INTRINSICS)
    assert np.array_equal(rigid_map.keyframes[1].pixels, before)


def test_frames_follow_the_newest_keyframe_that_shows_a_point():
    first, second = np.array([[1.0, 0.0], [2.0, 0.0]]), np.array([[0.0, 3.0]])
    moves = {0: (np.array([0, 1]), first), 2: (np.array([1]), second)}
    at = Followed(np.array([0, 1, 2]), np.zeros((3, 2)), np.zeros(3))
    frames = [
        SlamFrame(k, k / 30.0, SlamStatus.TRACKED, points=at, keyframe=number) for k, number in enumerate((0, 1, 2))
    ]
    moved = [frame.points for frame in moved_along(frames, moves, 3)]
    assert [points.pixels.tolist() for points in moved[:2]] == [[[1, 0], [2, 0], [0, 0]]] * 2
    assert moved[2].pixels.tolist() == [[1, 0], [0, 3], [0, 0]]
    # A column in the right image moves as the pixel does: the distance stays.
    assert moved[2].right.tolist() == [1, 0, 0]
