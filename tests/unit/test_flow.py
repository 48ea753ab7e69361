"""Flow, features, patches and the rendered appearance on images whose motion and light are known."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.tracking.binding import View, view_of
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.measurement import (
    ReferenceAppearance,
    Rendering,
    compare_with_rendering,
    draw_textured,
    pack_texture,
)
from morph_dslam.tracking.patches import (
    FLOW_WINDOW,
    NEUTRAL,
    compare_patches,
    detect_orb,
    follow,
    interior,
    match_descriptors,
    normalize_contrast,
    patch_correlation,
    spread_corners,
    strongest_corners,
)
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, printed_texture, sheet_state


@pytest.fixture(scope="module")
def image():
    return printed_texture(480, 640, seed=4)


def test_flattening_removes_slow_shading(image):
    rows = np.linspace(0.0, 40.0, 480)[:, None]
    shaded = np.clip(image.astype(float) * 0.8 + rows, 0, 255).astype(np.uint8)
    plain = normalize_contrast((image * 0.8).astype(np.uint8)).astype(int)
    difference = normalize_contrast(shaded).astype(int) - plain
    assert np.abs(difference[20:-20, 20:-20]).max() <= 2


def test_followed_points_move_by_the_shift(image):
    normalized = normalize_contrast(image, 31)
    points = spread_corners(normalized, np.pad(np.full((400, 560), 255, np.uint8), 40), 150)
    found, ok = follow(normalized, normalize_contrast(shifted(image, 7.25, -4.5), 31), points, points)
    assert ok.mean() > 0.95
    np.testing.assert_allclose(np.median(found - points, axis=0), [7.25, -4.5], atol=0.06)
    assert np.percentile(np.abs(found[ok] - points[ok] - [7.25, -4.5]), 95) < 0.15


def test_following_no_points_is_allowed(image):
    found, ok = follow(image, image, np.empty((0, 2)), np.empty((0, 2)))
    assert found.shape == (0, 2)
    assert ok.shape == (0,)


def test_corners_are_spread_over_the_mask_and_stay_in_it(image):
    mask = np.zeros((480, 640), np.uint8)
    mask[100:400, 100:500] = 255
    corners = spread_corners(normalize_contrast(image, 31), mask, 200)
    assert 120 <= len(corners) <= 200
    assert (corners >= [99.5, 99.5]).all()
    assert (corners <= [499.5, 399.5]).all()
    quarters = np.histogram2d(corners[:, 0], corners[:, 1], bins=[[100, 300, 500], [100, 250, 400]])[0]
    assert quarters.min() > 0.15 * len(corners)


def test_interior_keeps_away_from_the_outline_and_the_border():
    covered = np.zeros((50, 60), dtype=bool)
    covered[:30, 10:40] = True
    mask = interior(covered, 5) > 0
    expected = np.zeros_like(covered)
    expected[5:25, 15:35] = True
    np.testing.assert_array_equal(mask, expected)


def test_matched_features_follow_a_turned_image(image):
    matrix = cv2.getRotationMatrix2D((320, 240), 25.0, 0.9)
    turned = cv2.warpAffine(image, matrix, (640, 480))
    pixels, descriptors = detect_orb(image, 600)
    other_pixels, other = detect_orb(turned, 600)
    mine, theirs = match_descriptors(descriptors, other)
    expected = pixels[mine] @ matrix[:, :2].T + matrix[:, 2]
    good = np.linalg.norm(other_pixels[theirs] - expected, axis=1) < 3.0
    assert good.sum() > 60
    assert good.mean() > 0.8


def test_no_features_give_no_matches():
    pixels, descriptors = detect_orb(np.full((100, 100), 128, np.uint8), 100)
    assert pixels.shape == (0, 2)
    assert [len(rows) for rows in match_descriptors(descriptors, descriptors)] == [0, 0]


def test_rendering_looks_like_the_frame_it_predicts():
    """The reference view rendered in another state agrees with a film frame of that state."""
    model = bent_sheet_model()
    film = SheetFilm(model)
    first, second = sheet_state(0.0), sheet_state(0.15)
    normalized = normalize_contrast(film.frame(first, noise=0.0)[..., 0], 31)
    appearance = ReferenceAppearance(model, CAMERA, [normalized], [view_of(model, CAMERA, first)])
    rendering = appearance.render(view_of(model, CAMERA, second))
    actual = normalize_contrast(film.frame(second, noise=0.0)[..., 0], 31)
    inside = interior(np.isfinite(rendering.depth), 20) > 0
    assert inside.sum() > 50_000
    assert np.corrcoef(rendering.image[inside], actual[inside])[0, 1] > 0.97
    assert (rendering.image[~np.isfinite(rendering.depth)] == NEUTRAL).all()


def test_a_coarse_oblique_plane_is_rendered_by_its_homography():
    """A sheet of two triangles, turned by 55 and by 35 degrees: its texture moves by the homography of its corners."""
    model = bent_sheet_model(2, 2)
    rest, views = model.positions(model.default), []
    centre = rest.mean(axis=0)
    for turn, place in ((0.96, [0.0, 0.0, 0.6]), (0.61, [0.05, -0.03, 0.7])):
        nodes = (rest - centre) @ rotation_exp(np.array([0.2, turn, 0.0])).T + place
        views.append(View(nodes, CAMERA.project(nodes)))
    picture = cv2.GaussianBlur(printed_texture(480, 640, seed=4), (0, 0), 3.0)
    appearance = ReferenceAppearance(model, CAMERA, [picture], views[:1])
    first, second = (view.pixels.astype(np.float32) for view in views)
    moved = cv2.warpPerspective(picture, cv2.getPerspectiveTransform(first, second), (640, 480))
    for view, expected in zip(views, (picture, moved), strict=True):
        rendering = appearance.render(view)
        inside = interior(np.isfinite(rendering.depth), 3) > 0
        assert inside.sum() > 20_000
        # OpenCV interpolates between 32 places of a pixel.
        assert np.abs(rendering.image.astype(int) - expected)[inside].max() <= 2


def draw_in_two_passes(pixels, depths, triangles, coordinates, texture, closed, image, depth, triangle_ids):
    buffers = rasterise(pixels, depths, triangles, *depth.shape, closed=closed)
    nearest = buffers.depth < depth
    corners = np.arange(3 * len(triangles)).reshape(-1, 3)
    image[nearest] = render_textured(buffers, corners, coordinates[:, :, :2].reshape(-1, 2), texture)[nearest]
    depth[nearest], triangle_ids[nearest] = buffers.depth[nearest], buffers.triangle_ids[nearest]


@pytest.mark.parametrize("closed", [False, True])
def test_drawing_in_one_pass_equals_drawing_in_two(closed):
    model = bent_sheet_model(22, 16)
    # As smooth as places in it are rounded.
    texture = cv2.GaussianBlur(printed_texture(480, 640, seed=4), (0, 0), 3.0)
    view, other = (view_of(model, CAMERA, sheet_state(bend)) for bend in (0.0, 0.15))
    # A picture taken from far away: all depths are the same.
    pictures, places = [], np.pad(view.pixels, ((0, 0), (0, 1)), constant_values=1.0)[model.triangles]
    for draw, kept in ((draw_textured, pack_texture(texture)), (draw_in_two_passes, texture)):
        image, depth = np.full((480, 640), NEUTRAL, np.float32), np.full((480, 640), np.inf, np.float32)
        # Something is drawn there already, nearer than the right half.
        depth[:, 320:400] = 0.01
        depths = np.ascontiguousarray(other.nodes[:, 2])
        ids = np.full((480, 640), -1, np.int32)
        draw(other.pixels, depths, model.triangles, places, kept, closed, image, depth, ids)
        pictures.append((image, depth, ids))
    (image, depth, ids), (expected, expected_depth, expected_ids) = pictures
    # Where two triangles meet, either may be the nearer one.
    assert np.mean(ids != expected_ids) < 1e-3
    np.testing.assert_allclose(depth, expected_depth, rtol=1e-6)
    drawn = np.isfinite(depth) & (depth > 0.01)
    assert drawn[:, 320:400].sum() == 0
    assert closed or drawn.sum() > 30_000
    # Whole grey levels there, of weights in single precision.
    assert np.abs(image - expected).max() <= 0.6


def test_a_place_that_is_no_number_has_the_grey_of_the_border():
    """As a triangle may have that the reference camera sees edge-on."""
    texture, coordinates = pack_texture(np.full((37, 53), 90, np.uint8)), np.full((1, 3, 3), np.nan)
    grey, depth, ids = np.zeros((40, 40), np.float32), np.full((40, 40), np.inf, np.float32), np.full((40, 40), -1)
    corners = np.array([[5.0, 5.0], [35.0, 6.0], [12.0, 33.0]])
    draw_textured(
        corners, np.ones(3), np.arange(3)[None], coordinates, texture, False, grey, depth, ids.astype(np.int32)
    )
    assert np.isfinite(depth).sum() > 300
    assert (grey[np.isfinite(depth)] == 90.0).all()


@pytest.mark.parametrize("off_px", [0.01, 0.04])
def test_places_do_not_depend_on_where_the_reference_view_is_rendered(off_px):
    """A frame that is the reference picture, compared with that picture rendered hundredths of a pixel beside it."""
    model, state = bent_sheet_model(22, 16), sheet_state(0.0)
    picture = cv2.GaussianBlur(printed_texture(480, 640, seed=4), (0, 0), 3.0)
    appearance = ReferenceAppearance(model, CAMERA, [picture], [view_of(model, CAMERA, state)])
    rotation, place = state.camera_from_object.rotation, state.camera_from_object.translation
    aside = RigidTransform(rotation, place + np.array([off_px * place[2] / CAMERA.fx, 0.0, 0.0]))
    rendering = appearance.render(view_of(model, CAMERA, State(state.parameters, aside)))
    true = spread_corners(picture, interior(np.isfinite(rendering.depth), 16), 100)
    found = compare_with_rendering(picture, rendering, true + np.array([off_px, 0.0]), np.ones(len(true), dtype=bool))
    assert found.valid.sum() > 50
    # All would be off by as much as the rendering if grey levels were whole numbers; the frame is interpolated, too.
    assert np.abs((found.pixels - true)[found.valid].mean(axis=0)).max() < 0.2 * off_px


@pytest.mark.parametrize("drift_px", [-6.0, -15.0, 6.0])
def test_points_that_a_rolling_shutter_moves_out_of_the_picture_are_not_in_sight(drift_px):
    """Rows that are read later show all of a picture aside: where its windows are in, and only there, it is found."""
    rng = np.random.default_rng(0)
    picture = gaussian_filter(rng.normal(size=(200, 300)), 2.0)
    picture = np.clip(128.0 + 60.0 * picture / picture.std(), 0.0, 255.0)
    rendering = Rendering(
        picture.astype(np.float32),
        picture.astype(np.uint8),
        np.ones((200, 300), np.float32),
        np.zeros((200, 300), np.int32),
    )
    places = np.column_stack([rng.uniform([9.0, 250.0], [40.0, 290.0], (100, 2)).ravel(), rng.uniform(20, 180, 200)])
    frame, drift = np.roll(picture, int(drift_px), axis=1).astype(np.uint8), np.tile([drift_px, 0.0], (200, 1))
    found = compare_with_rendering(frame, rendering, places, np.ones(200, dtype=bool), None, drift)
    shown = places[:, 0] + drift_px
    assert not found.visible[(shown < 4.0) | (shown > 295.0)].any()
    assert found.visible[(shown > 12.0) & (shown < 287.0)].all()
    assert found.valid.sum() > 0.95 * found.visible.sum()


def test_rendering_an_object_outside_the_image_is_empty():
    model = bent_sheet_model(22, 16)
    state = sheet_state(0.0)
    normalized = np.full((480, 640), 90, np.uint8)
    appearance = ReferenceAppearance(model, CAMERA, [normalized], [view_of(model, CAMERA, state)])
    for position in ([9.0, 0.0, 0.6], [0.0, 0.0, -0.6]):
        away = State(state.parameters, RigidTransform(state.camera_from_object.rotation, np.array(position)))
        rendering = appearance.render(view_of(model, CAMERA, away))
        assert (rendering.image == NEUTRAL).all()
        assert np.isinf(rendering.depth).all()


SHIFT = np.array([0.3, -0.2])


@pytest.fixture(scope="module")
def soft():
    """A print as a camera sees it, a little blurred: what is sharper cannot be moved by parts of a pixel."""
    return cv2.GaussianBlur(printed_texture(480, 640, seed=4), (0, 0), 1.0)


def shifted(image, x, y):
    moved = shift(image.astype(float), (y, x), order=3, mode="nearest")
    return np.clip(np.rint(moved), 0, 255).astype(np.uint8)


def spread_points(normalized, count=300):
    return spread_corners(normalized, np.pad(np.full((400, 560), 255, np.uint8), 40), count)


def test_light_that_slopes_over_the_windows_does_not_move_what_is_found(soft):
    """A shadow's edge, softer than the windows are wide, falls on an image that moves by a known shift."""
    dull = (60 + 0.5 * soft.astype(float)).astype(np.uint8)
    points = spread_points(dull)
    columns = np.arange(640.0)
    shadow = 15.0 * np.sin(2.0 * np.pi * columns / 80.0)[None, :]
    target = np.clip(0.8 * shifted(dull, *SHIFT).astype(float) + 20.0 + shadow, 0, 255).astype(np.uint8)
    found, ok = follow(dull, target, points, points)
    places, correlation, spread = compare_patches(dull, target, points, found, 7)
    good = ok & (correlation > 0.6) & np.isfinite(spread)
    good &= np.linalg.norm(found - points - SHIFT, axis=1) < 0.8
    assert good.sum() > 100
    before, after = (np.abs(at - points - SHIFT)[good] for at in (found, places))
    assert np.median(before) > 0.1
    assert np.median(after) < 0.2 * np.median(before)


def test_without_a_change_of_light_the_places_stay_as_they_are_found(soft):
    points = spread_points(soft)
    found, ok = follow(soft, shifted(soft, *SHIFT), points, points)
    places, _, spread = compare_patches(soft, shifted(soft, *SHIFT), points, found, 7)
    good = ok & np.isfinite(spread)
    assert good.mean() > 0.9
    assert np.median(np.abs(places - points - SHIFT)[good]) < 0.02


def test_the_spread_of_a_patch_is_how_far_off_points_are_found(soft):
    """Points are followed into images with more and more noise; in each the errors are as told."""
    normalized = normalize_contrast(soft, 31)
    points, half = spread_points(normalized), FLOW_WINDOW // 2
    errors, told = [], []
    for noise in (2.0, 8.0, 16.0):
        rng = np.random.default_rng(int(noise))
        noisy = np.clip(soft + noise * rng.standard_normal(soft.shape), 0, 255).astype(np.uint8)
        target = normalize_contrast(noisy, 31)
        found, ok = follow(normalized, target, points, points)
        close = ok & (np.linalg.norm(found - points, axis=1) < 2.0)
        places, _, spread = compare_patches(normalized, target, points[close], found[close], half)
        known = np.isfinite(spread)
        errors.append(np.sqrt(np.mean((places - points[close])[known] ** 2)))
        told.append(np.sqrt(np.mean(spread[known] ** 2)))
    assert errors[2] > 4.0 * errors[0]
    np.testing.assert_allclose(told, errors, rtol=0.3)


def test_a_window_that_is_covered_in_part_is_told_by_its_spread(soft):
    """A disc moves over the image: its rim shifts what is found in the windows that straddle it."""
    normalized = normalize_contrast(soft, 31)
    points = spread_points(normalized, 800)
    covered = soft.copy()
    cv2.circle(covered, (320, 240), 90, 150, -1, cv2.LINE_AA)
    target = normalize_contrast(covered, 31)
    found, ok = follow(normalized, target, points, points)
    places, correlation, spread = compare_patches(normalized, target, points, found, 7)
    far = np.linalg.norm(points - [320.0, 240.0], axis=1)
    off = np.linalg.norm(places - points, axis=1)
    passed = ok & (correlation > 0.6) & np.isfinite(spread)
    rim, free = passed & (far < 100.0), passed & (far > 130.0)
    assert rim.sum() > 5
    assert np.median(off[rim]) > 5.0 * np.median(off[free])
    assert np.median(spread[rim]) > 5.0 * np.median(spread[free])


def test_correlation_ignores_gain_and_offset_and_sees_difference(soft):
    centre = np.array([[320.0, 240.0], [100.0, 100.0]])
    darker = (0.5 * soft + 20).astype(np.uint8)
    assert patch_correlation(soft, darker, centre, centre, 7).min() > 0.99
    assert patch_correlation(soft, soft, centre, centre + 35.0, 7).max() < 0.6
    assert patch_correlation(soft, soft, centre, np.array([[-3.0, 5.0], [639.0, 5.0]]), 7).tolist() == [-1, -1]


@pytest.mark.parametrize(("most", "distance"), [(60, 3.0), (500, 15.2)])
def test_the_strongest_corners_are_those_of_opencv(most, distance):
    image = printed_texture(300, 260)
    mask = np.zeros_like(image)
    mask[20:270, 10:200] = 255
    expected = cv2.goodFeaturesToTrack(image, most, 0.005, distance, mask=mask).reshape(-1, 2)
    assert np.array_equal(strongest_corners(image, mask, most, 0.005, distance), expected)
    assert strongest_corners(np.full_like(image, 90), mask, most, 0.005, distance).shape == (0, 2)
