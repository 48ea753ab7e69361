"""Objects whose texture is followed beside depth images, registered by clicks that are off.

The registration's error is alike in all of the texture's points, and depths do not have it.
"""

from __future__ import annotations

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.sources import Frame
from morph_dslam.tracking import views
from morph_dslam.tracking.depth import DEPTH_WINDOW
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.systematic_errors import SystematicErrors
from tests.integration.test_outline_beside_texture import CAMERA as BEFORE_BLOCK, SpottedFilm, state as block_state
from tests.support.bent_sheet import bent_sheet_model
from tests.support.clicked import clicked
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state

#: Of a depth image, as the tracker takes it by default: metres at 1 m, alike within so many pixels.
SIGMA_AT_1M, ALIKE_PX = 2.0e-3, 3
#: Deviation of what all depths are off by together, a share.
SCALE_STD = 0.01


class Scene:
    """A film with exact states, and what a depth camera measures beside it.

    Parameters
    ----------
    kind : "sheet" or "block".
    factor : that all depths are too large by.
    """

    def __init__(self, kind, seed, factor=1.0):
        self.film = SheetFilm(bent_sheet_model(43, 31), seed=seed) if kind == "sheet" else SpottedFilm(300, seed)
        self.camera, self._state = (CAMERA, sheet_state) if kind == "sheet" else (BEFORE_BLOCK, block_state)
        self.model, self._factor, self.rng = self.film.model, factor, np.random.default_rng(1000 + seed)

    def state(self, time):
        return self._state(0.4 * time if self._state is sheet_state else time)

    def frame(self, time):
        state, camera, model = self.state(time), self.camera, self.model
        nodes = state.camera_from_object.apply(model.positions(state.parameters))
        exact = rasterise(camera.project(nodes), nodes[:, 2], model.triangles, camera.height, camera.width).depth
        exact = np.where(np.isfinite(exact), exact, 1.5)
        noise = self.rng.standard_normal((camera.height // ALIKE_PX + 2, camera.width // ALIKE_PX + 2))
        noise = np.kron(noise, np.ones((ALIKE_PX, ALIKE_PX)))[1 : camera.height + 1, 1 : camera.width + 1]
        depth = self._factor * (exact + SIGMA_AT_1M * exact**2 * noise)
        return Frame(0, float(time), self.film.frame(state), depth.astype(np.float32))

    def off(self, found, time):
        """Errors of the parameters over half of their ranges."""
        return (found.parameters - self.state(time).parameters) / (0.5 * (self.model.upper - self.model.lower))

    def tracked(self, known, frames, **options):
        """Errors (f, d) of the parameters, those in deviations, and those along the sight line in deviations (f,)."""
        options = md.TrackerOptions(least_inliers=16, new_views=False, **options)
        tracker = md.Tracker(self.model, self.camera, known, options, reference=frames[0].image)
        off, sizes, along = [], [], []
        for frame in frames:
            found = tracker.track(frame if options.use_depth else frame.image).estimate
            assert found is not None
            off.append(self.off(found.state, frame.timestamp))
            ranges = 0.5 * (self.model.upper - self.model.lower)
            sizes.append(np.abs(off[-1]) * ranges / found.parameter_std)
            distances = [s.camera_from_object.translation[2] for s in (found.state, self.state(frame.timestamp))]
            along.append(abs(distances[0] - distances[1]) / found.pose_std[5])
        return np.array(off), np.array(sizes), np.array(along)


def test_depths_make_good_what_clicks_were_off_by():
    """The clicks have the skew off by a twentieth of its range and more, depths tell it several times as exactly."""
    scene = Scene("sheet", 1)
    frames = [scene.frame(time) for time in (0.0, 0.1)]
    known = clicked(scene.model, CAMERA, scene.state(0.0), scene.rng)
    off, sizes, _ = scene.tracked(known, frames, use_depth=True)
    by_clicks = np.abs(scene.off(known.state, 0.0))
    assert by_clicks.max() > 0.05
    assert np.abs(off).max() < 0.3 * by_clicks.max()
    assert sizes.max() < 3.0


def test_points_are_looked_for_where_they_are_and_not_where_the_correction_has_them(monkeypatch):
    """They were looked for as far off as the correction moves them, 1.4 pixels here."""
    scene, off = Scene("sheet", 1), []
    frames = [scene.frame(time) for time in np.linspace(0.0, 0.375, 4)]
    known = clicked(scene.model, CAMERA, scene.state(0.0), scene.rng, 3.0)
    options = md.TrackerOptions(least_inliers=16, new_views=False, use_depth=True)
    tracker = md.Tracker(scene.model, CAMERA, known, options, reference=frames[0].image)
    correct = FrameEstimation.correct

    def looking(self, picture, state, offsets, prior):
        found = correct(self, picture, state, offsets, prior)
        if offsets is not None:
            away = (tracker.reference.projected(state) + offsets - found.measurement.recorded)[found.inliers]
            off.append(np.sqrt(np.mean(np.sum(away**2, axis=1))))
        return found

    monkeypatch.setattr(FrameEstimation, "correct", looking)
    for frame in frames:
        tracker.track(frame)
    assert tracker.last_correction is not None
    shift = np.sqrt(np.mean(np.sum(tracker.last_correction.shift**2, axis=1)))
    assert shift > 0.8
    assert max(off[1:]) < 0.3 * shift


def test_depths_that_tell_nothing_of_the_clicks_are_corrected_by_what_an_outline_tells(monkeypatch):
    """Clicks have put the points elsewhere on the surface, where it has another depth: four deviations of a depth."""
    monkeypatch.setattr(SystematicErrors, "told_by_depths", False)  # as where frames with depths have made the view
    scene = Scene("block", 0)
    frame = scene.frame(0.0)
    known = clicked(scene.model, scene.camera, scene.state(0.0), scene.rng, 2.0)
    options = md.TrackerOptions(least_inliers=16, new_views=False, use_depth=True, use_outline=True)
    tracker = md.Tracker(scene.model, scene.camera, known, options, reference=frame.image)
    tracker.track(frame)
    assert tracker.last_measured is not None
    depths, correction = tracker.last_measured.depths, tracker.last_correction
    assert depths is not None
    assert correction is not None
    assert correction.nearer is not None
    measured = depths.depths.copy()
    measured[: len(correction.nearer)] += correction.nearer
    exact = tracker.last_measured.points.in_camera(scene.state(0.0))[:, 2]
    rows = depths.weights > 0.0
    sigma = SIGMA_AT_1M * exact[rows] ** 2 * ALIKE_PX / DEPTH_WINDOW
    off, before = (np.sqrt(np.mean(((given - exact)[rows] / sigma) ** 2)) for given in (depths.depths, measured))
    assert before > 4.0
    assert off < 1.6


def test_a_distance_by_depths_stays_as_uncertain_as_these_are():
    """The depths of further frames are too large by the same factor, and confirm what the registration has of it."""
    scene = Scene("sheet", 2, 1.0 + SCALE_STD)
    frames = [scene.frame(time) for time in (0.0, 0.1)]
    known = clicked(scene.model, CAMERA, scene.state(0.0), scene.rng, depth=frames[0].depth)
    _, _, along = scene.tracked(known, frames, use_depth=True)
    by_registration = abs(
        known.state.camera_from_object.translation[2] - scene.state(0.0).camera_from_object.translation[2]
    )
    by_registration /= np.sqrt(known.covariance[-1, -1])
    # Were the depths of each frame another measurement of their scale, it would be many deviations off.
    assert by_registration < 3.0
    assert along == pytest.approx([by_registration] * 2, abs=1.0)


@pytest.mark.slow
def test_a_distance_by_depths_stays_as_it_is_in_views_that_frames_became(monkeypatch):
    """The states in which frames became views are off with the depths' scale, and these do not correct them again."""
    made: dict[int, list[tuple[float, float]]] = {}
    is_first = False
    monkeypatch.setattr(views, "choose_view", lambda shares, errors, active: None if is_first else active)
    for seed in range(100, 108):
        scene = Scene("sheet", seed, 1.0 + SCALE_STD * np.random.default_rng(seed).standard_normal())
        frames = [scene.frame(time) for time in np.linspace(0.0, 0.25, 12)]
        known = clicked(scene.model, CAMERA, scene.state(0.0), scene.rng, 0.7, depth=frames[0].depth)
        options, last = md.TrackerOptions(least_inliers=16, use_depth=True), {}
        tracker = md.Tracker(scene.model, CAMERA, known, options, reference=frames[0].image)
        for number, frame in enumerate(frames):
            is_first = number < 6  # a view is made of every third of these
            found = tracker.track(frame)
            assert found.estimate is not None
            states = found.estimate.state, scene.state(frame.timestamp)
            distances = [state.camera_from_object.translation[2] for state in states]
            last[found.view] = distances[0] - distances[1], found.estimate.pose_std[5]
        for view, pair in last.items():
            made.setdefault(view, []).append(pair)
    first, *others = (np.array(made[view]) for view in range(3))
    for of_view in others:
        assert np.sqrt(np.mean(of_view[:, 0] ** 2)) < 1.3 * np.sqrt(np.mean(first[:, 0] ** 2))
        assert np.median(of_view[:, 1] / first[:, 1]) > 0.9
        assert 0.4 < np.sqrt(np.mean((of_view[:, 0] / of_view[:, 1]) ** 2)) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "px"), [("sheet", 0.5), ("block", 1.0)])
def test_texture_beside_depth_does_no_harm(kind, px):
    """Root mean square errors over registrations, beside those of either alone.

    Depths count at the texture's points, of which there are half as many as a registration compares, or less: a frame
    that is registered by its depth is as much more exact.
    """
    found, sizes = {"depth": [], "texture": [], "both": []}, []
    for seed in range(1, 4):
        scene = Scene(kind, seed, 1.0 + SCALE_STD * np.random.default_rng(seed).standard_normal())
        frames = [scene.frame(time) for time in np.linspace(0.0, 0.6, 4)]
        known = clicked(scene.model, scene.camera, scene.state(0.0), scene.rng, px)
        found["texture"].append(scene.tracked(known, frames)[0])
        off, in_deviations, along = scene.tracked(known, frames, use_depth=True)
        found["both"].append(off)
        sizes += [in_deviations.ravel(), along]
        for frame in frames:
            there = scene.state(frame.timestamp)
            alone = clicked(scene.model, scene.camera, there, scene.rng, px, depth=frame.depth)
            found["depth"].append(scene.off(alone.state, frame.timestamp)[None])
    rms = {name: np.sqrt(np.mean(np.concatenate(rows) ** 2, axis=0)) for name, rows in found.items()}
    assert np.all(rms["both"] < 0.4 * rms["texture"])
    assert np.all(rms["both"] < 2.0 * rms["depth"])
    assert 1.0 < np.quantile(np.concatenate(sizes), 0.95) < 2.6
