"""A sheet shaken before a camera whose rows are recorded one after the other: with the readout time, and without."""

from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.tracking.state import State
from tests.support.scenes import write_scene

READOUT_S = 0.03


def key_frames(n_frames):
    """Still for three frames, then to and fro by 20 mm at 1.2 Hz, upright faster than sideways."""
    for frame in range(n_frames):
        time = max(frame - 2, 0) / 30.0
        shake = 20.0 * min(1.0, 4.0 * time) * np.sin(2.0 * np.pi * np.array([1.0, 1.2]) * time)
        yield (
            f"[[parameters]]\nframe = {frame}\narch = {20.0 + 15.0 * np.sin(3.0 * time):.4f}\nskew = 0.2\ntwist = 4.0\n"
            f"[[pose]]\nframe = {frame}\nposition_mm = [{shake[0]:.4f}, {shake[1] + 80.0:.4f}, 640]\n"
            f"rotation_deg = [{190.0 + 0.2 * shake[1]:.4f}, 8, {0.3 * shake[0]:.4f}]\n"
        )


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    folder, n_frames = tmp_path_factory.mktemp("shaken"), 30
    camera = "camera = { width = 640, height = 480, fx = 520.0, fy = 520.0, cx = 320.0, cy = 240.0, "
    scene = write_scene(
        folder,
        top=f"frames = {n_frames}\n",
        tail="[sensor]\nnoise = 1.0\n" + "".join(key_frames(n_frames)),
        camera=camera + f"readout_s = {READOUT_S} }}\n",
    )
    sequence = md.SimulatedSequence(scene)
    return sequence, list(sequence)


def tracked(film, camera, **options):
    """Root mean square distance (f,) of the nodes from where they are at the middle row's instant, mm; the results."""
    sequence, frames = film
    model = sequence.model
    start = md.Registration(model, State(sequence.parameters[0], sequence.camera_from_object[0]))
    tracker = md.Tracker(model, camera, start, md.TrackerOptions(**options))
    results = [tracker.track(frame) for frame in frames]
    errors = []
    for result, parameters, pose in zip(results, sequence.parameters, sequence.camera_from_object, strict=True):
        found = result.pose.apply(model.positions(result.estimate.state.parameters))
        errors.append(1e3 * np.linalg.norm(found - pose.apply(model.positions(parameters)), axis=1))
    return np.sqrt(np.mean(np.square(errors), axis=1)), results


@pytest.mark.parametrize("outline", [False, True])
def test_a_shaken_sheet_is_where_the_middle_row_has_it(film, outline):
    camera = film[0].camera
    right, _ = tracked(film, camera, use_outline=outline)
    without, _ = tracked(film, replace(camera, readout_s=0.0), use_outline=outline)
    # The motion ends with the last frame, whose rows the simulation does not carry on.
    assert np.median(without[8:-2]) > 1.0
    assert np.median(right[8:-2]) < 0.15
    assert right[:-2].max() < 0.6


def test_it_is_drawn_where_its_rows_show_it(film):
    """The middle of the sheet, against its true path in the image by central differences."""
    sequence, _ = film
    model, camera, results = sequence.model, sequence.camera, tracked(film, sequence.camera)[1]
    middle = int(np.argmin(np.linalg.norm(model.nodes - model.nodes.mean(axis=0), axis=1)))

    def pixels(parameters, poses):
        return np.array(
            [camera.project(p.apply(model.positions(m))[[middle]])[0] for m, p in zip(parameters, poses, strict=True)]
        )

    true = pixels(sequence.parameters, sequence.camera_from_object)
    states = [result.shown_state for result in results]
    drawn = pixels([s.parameters for s in states], [s.camera_from_object for s in states])
    velocity = 0.5 * (true[2:] - true[:-2]) * sequence.fps
    seconds = READOUT_S * (drawn[1:-1, 1:] - 0.5 * (camera.height - 1)) / camera.height
    missed, moved = drawn[1:-1] - (true[1:-1] + seconds * velocity), seconds * velocity
    assert np.abs(moved[8:-1]).max() > 0.6
    assert np.abs(missed[8:-1]).max() < 0.2
