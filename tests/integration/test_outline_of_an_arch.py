"""An arched sheet, registered by clicks that are a pixel off, whose outline is off by more than a pixel."""

from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.tracking.state import State, pose_increment
from tests.support.clicked import clicked
from tests.support.scenes import write_scene

N_REGISTRATIONS = 8
STILL = (
    "[sensor]\nnoise = 1.0\n[[parameters]]\nframe = 0\narch = 20.0\nskew = 0.2\ntwist = 4.0\n"
    "[[pose]]\nframe = 0\nposition_mm = [0.0, 80.0, 640.0]\nrotation_deg = [190.0, 8.0, 0.0]\n"
)


def still_film(folder, frames, readout_s=0.0):
    """A simulated recording of the arch, which stands still, and the state that it is in."""
    camera = "camera = { width = 640, height = 480, fx = 520.0, fy = 520.0, cx = 320.0, cy = 240.0"
    camera += f", readout_s = {readout_s} }}\n" if readout_s else " }\n"
    film = md.SimulatedSequence(write_scene(folder, top=f"frames = {frames}\n", tail=STILL, camera=camera))
    return film, State(film.parameters[0], film.camera_from_object[0])


@pytest.mark.slow
def test_deviations_hold_what_a_rough_outline_has_the_registration_off_by(tmp_path):
    """Over registrations the errors have the size that is stated, and are no larger than by texture alone."""
    film, there = still_film(tmp_path, 2)
    model, (first, second) = film.model, list(film)
    nodes = there.camera_from_object.apply(model.positions(there.parameters))
    relative, away = [], {True: [], False: []}
    for seed in range(N_REGISTRATIONS):
        known = clicked(model, film.camera, there, np.random.default_rng(seed))
        for use_outline, rows in away.items():
            options = md.TrackerOptions(use_outline=use_outline, new_views=False)
            tracker = md.Tracker(model, film.camera, known, options, reference=first.image)
            tracker.track(first)
            estimate = tracker.track(second).estimate
            pose = estimate.state.camera_from_object
            rows.append(pose.apply(model.positions(estimate.state.parameters)) - nodes)
            if use_outline:
                relative.append((estimate.state.parameters - there.parameters) / estimate.parameter_std)
                relative.append(pose_increment(there.camera_from_object, pose) / estimate.pose_std)
    assert np.sqrt(np.mean(np.square(np.concatenate(relative)))) < 1.4
    assert np.sqrt(np.mean(np.square(away[True]))) < 1.1 * np.sqrt(np.mean(np.square(away[False])))


def test_what_an_outline_corrects_is_no_motion_before_a_rolling_shutter(tmp_path):
    """An arch that stands still is found where it is found by a camera that records all rows at once."""
    film, there = still_film(tmp_path, 3, readout_s=0.03)
    frames, found = list(film), []
    known = clicked(film.model, film.camera, there, np.random.default_rng(1))
    for camera in (film.camera, replace(film.camera, readout_s=0.0)):
        options = md.TrackerOptions(use_outline=True, new_views=False)
        tracker = md.Tracker(film.model, camera, known, options, reference=frames[0].image)
        result = [tracker.track(frame) for frame in frames][-1]
        nodes = film.model.positions(result.estimate.state.parameters)
        found.append(camera.project(result.pose.apply(nodes)))
        by_clicks = camera.project(known.state.camera_from_object.apply(film.model.positions(known.state.parameters)))
    assert np.abs(found[0] - by_clicks).max() > 1.0, "the outline corrects something"
    assert np.abs(found[0] - found[1]).max() < 0.1
