"""A crack is found by the step that it makes in the residuals; smooth misfits, noise and rigid parts make none."""

import numpy as np
import pytest

from morph_dslam.tracking.displacement_jumps import JumpDetector, near_jumps

#: Half a width and half a height of a plate, metres; a pixel is as wide at it.
HALF, PX = np.array([0.05, 0.03]), 1e-4
FRAMES, BEGINS = 80, 50


@pytest.fixture
def plate():
    points = np.random.default_rng(7).uniform(-1.0, 1.0, (350, 2)) * HALF
    return np.column_stack([points, np.zeros(350)])


def detected(plate, residuals_of, used=None, seed=0, noise_px=0.3, agreeing=None):
    """The detector after a test in which the plate is stretched from left to right, and the frame of its first find."""
    noise, first = np.random.default_rng(seed), None
    detector = JumpDetector(plate, float(np.linalg.norm(np.ptp(plate, axis=0))))
    for frame in range(FRAMES):
        stretch = 0.4 * frame / FRAMES
        displacement = np.column_stack([stretch * (plate[:, 0] + HALF[0]), np.zeros((350, 2))])
        residuals = residuals_of(frame, plate / PX) + noise.normal(0.0, noise_px, (350, 2))
        counted = np.ones(350, dtype=bool) if used is None else used(frame)
        detector.learn(residuals, counted, counted if agreeing is None else agreeing(residuals), displacement, PX)
        if detector.jumps and first is None:
            first = frame
    return detector, first


def crack(frame, pixels):
    """Opens by 1 px a frame across x = 0 in the upper half, fading over the plate's width."""
    opening = max(frame - BEGINS, 0) * 0.5 * np.sign(pixels[:, 0]) * (pixels[:, 1] > 0.0)
    return np.column_stack([opening * np.exp(-np.abs(pixels[:, 0]) / 300.0), np.zeros(len(pixels))])


def opening(plate, length, stretch):
    """Displacement (n, 2), metres, by a crack of a length from the plate's upper edge at x = 0, beyond even stretch.

    That of half a crack in a large sheet of an incompressible material (Westergaard, J. Appl. Mech. 6, 1939), of which
    the sides part by up to four times the stretch times the length.
    """
    ahead, across = HALF[1] - plate[:, 1], np.abs(plate[:, 0]) + 1e-9
    z, kappa = ahead + 1j * across, 5.0 / 3.0
    root = np.sqrt(z - length) * np.sqrt(z + length)
    apart = 1.5 * stretch * (0.5 * (kappa + 1.0) * (root - z).imag - across * (z / root - 1.0).real)
    along = 1.5 * stretch * (0.5 * (kappa - 1.0) * (root - z).real - across * (z / root - 1.0).imag)
    return np.column_stack([np.sign(plate[:, 0]) * apart, -along])


#: Length of a notch, metres, by which a crack grows from its end a frame.
NOTCH, GROWTH = 0.008, 4e-5


def agree_to_4_px(residuals):
    return np.linalg.norm(residuals, axis=1) < 4.0


def smooth(frame, pixels):
    """Up to 20 px over the plate: a strain of 4 per cent and a bending that the model has not."""
    x, y = (pixels * PX / HALF.max())[:, :2].T
    return frame / FRAMES * np.column_stack([20.0 * x + 10.0 * x * y, 15.0 * x**2])


def test_a_crack_is_found_where_and_when_it_opens(plate):
    detector, first = detected(plate, crack)
    # Half a per cent of the diagonal is 5.8 px; five looks in turn take more frames.
    assert BEGINS + 6 <= first <= BEGINS + 16
    places = np.array([jump.place for jump in detector.jumps])
    assert np.abs(places[:, 0]).max() < 0.01
    assert places[:, 1].min() > -0.006
    largest = max(jump.size for jump in detector.jumps)
    # It is the growth since earlier frames of nearly the same shape, which show a part of the opening.
    assert 0.25 * (FRAMES - BEGINS) * PX < largest < (FRAMES - BEGINS) * PX
    near = near_jumps(detector.jumps, plate)
    assert near[np.linalg.norm(plate - [0.0, 0.015, 0.0], axis=1) < 0.003].all()
    assert not near[np.abs(plate[:, 0]) > 0.02].any()


def test_a_crack_that_grows_from_a_notch_is_found_at_its_end(plate):
    """Its points soon do not support the estimate; they count, as they agree with their neighbours."""

    def grows(frame, pixels):
        stretch, length = 0.4 * frame / FRAMES, NOTCH + max(frame - BEGINS, 0) * GROWTH
        found = (opening(plate, length, stretch) - opening(plate, NOTCH, stretch)) / PX
        return found + smooth(frame, pixels) / 4.0

    detector, first = detected(plate, grows, agreeing=agree_to_4_px)
    assert first is not None
    assert first > BEGINS + 5
    places = np.array([jump.place for jump in detector.jumps])
    end = np.array([0.0, HALF[1] - NOTCH, 0.0])
    assert np.linalg.norm(places - end, axis=1).max() < 0.012


@pytest.mark.parametrize("share", [-0.1, 0.1])
def test_a_notch_that_opens_otherwise_than_the_models_is_no_crack(plate, share):
    def opens(frame, pixels):  # with the square of the stretch, as of another law
        stretch = 0.4 * frame / FRAMES
        return share * stretch / 0.4 * opening(plate, NOTCH, stretch) / PX

    assert detected(plate, opens, agreeing=lambda residuals: np.linalg.norm(residuals, axis=1) < 8.0)[1] is None


def test_a_crack_is_found_beside_a_smooth_misfit(plate):
    detector, first = detected(plate, lambda frame, pixels: crack(frame, pixels) + smooth(frame, pixels))
    assert BEGINS + 6 <= first <= BEGINS + 20
    assert all(abs(jump.place[0]) < 0.01 for jump in detector.jumps)


@pytest.mark.parametrize("seed", range(5))
def test_a_smooth_misfit_noise_and_outliers_are_no_crack(plate, seed):
    wrong = np.random.default_rng(100 + seed)

    def with_outliers(frame, pixels):
        found = smooth(frame, pixels)
        found[wrong.choice(len(pixels), 15, replace=False)] += wrong.normal(0.0, 15.0, (15, 2))
        return found

    assert detected(plate, with_outliers, seed=seed)[1] is None


def test_a_step_that_follows_the_deformation_is_no_crack(plate):
    # A notch that the model draws a little too short opens in proportion from the beginning.
    def notch(frame, pixels):
        return np.column_stack([0.05 * frame * np.sign(pixels[:, 0]) * (pixels[:, 1] > 0.0), np.zeros(len(pixels))])

    assert detected(plate, notch)[1] is None


def test_folds_that_turn_otherwise_than_the_models_are_no_crack(plate):
    # Two ridges 1 mm wide, 4 mm apart, each about its own middle: a plane and a step in the gap would fit them as well.
    offsets = np.random.default_rng(5).uniform(-5e-4, 5e-4, 350)
    plate[:, 0] = 2e-3 * np.sign(plate[:, 0]) + offsets

    def turned(frame, pixels):
        late = min(max(frame - BEGINS, 0) / 5.0, 1.0)
        return np.column_stack([0.2 * late * offsets / PX, np.zeros(len(pixels))])

    # 2 px across a ridge would be extrapolated to 8 px across the gap.
    assert detected(plate, turned, noise_px=0.1)[1] is None


def test_points_that_do_not_count_say_nothing(plate):
    def away_from_the_crack(frame):
        return np.abs(plate[:, 0]) > 0.008

    assert detected(plate, crack, away_from_the_crack)[1] is None


def test_a_few_points_are_not_looked_at():
    detector = JumpDetector(np.random.default_rng(1).uniform(-1.0, 1.0, (9, 3)), 2.0)
    every = np.ones(9, dtype=bool)
    detector.learn(np.full((9, 2), np.nan), every, every, np.zeros((9, 3)), 1e-3)
    assert detector.jumps == ()
