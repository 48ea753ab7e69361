"""Films in which a part of the picture moves, or all looks alike: the map must not follow it."""

import numpy as np
import pytest

from morph_dslam.geometry import fit_similarity
from morph_dslam.slam.output import trajectory_of
from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import CAMERA, SHEET_NODES, RoomFilm, checkerboard, hand_held, room_with_sheet

N_FRAMES = 120


def sheet_film(seed, move):
    """A sheet over 40 % of the picture, displaced by ``move(frame)`` (3,) metres."""
    film, path = RoomFilm(seed=seed, scene=room_with_sheet), hand_held(N_FRAMES, seed, reach=0.3)
    middle = [0.0, 0.0, 1.65]
    rest = (film.nodes[-SHEET_NODES:] - middle) * [1.35, 1.35, 1.0] + middle
    images = []
    for index, place in enumerate(path):
        film.nodes[-SHEET_NODES:] = rest + move(index)
        images.append(film.frame(place))
    return images, path


def sways(index):
    """From the 30th frame on it sways by 15 cm, and comes by its old place at full speed."""
    return np.array([0.15 * np.sin(0.1 * max(index - 30, 0)), 0.0, 0.0])


def creeps(index):
    """From the 30th frame on it slides by 3 mm, one pixel, a frame, for two seconds."""
    return np.array([0.003 * min(max(index - 30, 0), 60), 0.0, 0.0])


def followed_and_found_again(images, path):
    """Median error in parts of the path, and the miss of the last of ten frames seen again after a second."""
    slam = Slam(CAMERA)
    film = [*images, *[np.full_like(images[0], 3)] * 30, *images[:-11:-1]]
    frames = [slam.process_frame(image, index, index / 30.0) for index, image in enumerate(film)]
    slam.refine_map()
    found = [f for f in frames[:N_FRAMES] if slam.is_placed(f)]
    assert {f.status for f in frames[found[0].index : N_FRAMES]} == {"tracked"}
    estimate, truth = trajectory_of(slam, found).positions, np.array([path[f.index][:3, 3] for f in found])
    to_truth = fit_similarity(estimate, truth)
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    last = to_truth.apply(trajectory_of(slam, frames[-1:]).positions)[0]
    errors = np.linalg.norm(to_truth.apply(estimate) - truth, axis=1)
    return np.median(errors) / length, np.linalg.norm(last - path[-10][:3, 3])


@pytest.mark.parametrize(("seed", "move"), [(10, sways), (30, creeps)])
def test_a_sheet_that_moves_does_not_draw_the_map_along(seed, move):
    error, miss = followed_and_found_again(*sheet_film(seed, move))
    assert error < 0.003
    assert miss < 0.03


def test_a_few_wrong_points_do_not_bend_the_map_of_a_checkerboard():
    film, path = RoomFilm(seed=14, scene=checkerboard), hand_held(N_FRAMES, 14)
    error, miss = followed_and_found_again([film.frame(place) for place in path], path)
    assert error < 0.003
    assert miss < 0.03
