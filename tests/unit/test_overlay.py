"""The overlay: colours where the surface is, nothing changed where it is not."""

import matplotlib
import numpy as np
import pytest

from morph_dslam.render.overlay import BarPlace, Panel, draw_overlay, paint_surface
from morph_dslam.render.shading import colour_bar, colour_table, flat_colour_bar, lambert, text_patch, vertex_normals
from tests.support.bent_sheet import LENGTH, bent_sheet_model

PIXELS = np.array([[20.0, 40.0], [119.0, 40.0], [119.0, 139.0], [20.0, 139.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
GREY = np.full((240, 320, 3), 90, dtype=np.uint8)


def overlay(values, **options):
    return draw_overlay(
        GREY, PIXELS, np.ones(4), TRIANGLES, np.asarray(values), (0.0, 2.0), label="stress [MPa]", **options
    )


@pytest.mark.parametrize(("value", "position"), [(-1.0, 0.0), (0.5, 0.25), (2.0, 1.0), (9.0, 1.0)])
def test_opaque_surface_has_the_colour_of_its_value(value, position):
    image = overlay([value] * 4, alpha=1.0, colour_map="viridis")
    expected = np.array(matplotlib.colormaps["viridis"](position)[:3])[::-1] * 255
    assert np.abs(image[60:120, 40:100].astype(float) - expected).max() <= 3


def test_a_surface_without_a_value_is_grey():
    image = overlay([1.0, np.nan, np.nan, 1.0], alpha=1.0)
    assert np.ptp(image[60:120, 40:100].astype(int), axis=2).max() == 0


def test_transparency_mixes_and_brightness_dims():
    opaque = overlay([1.0] * 4, alpha=1.0)[90, 70].astype(float)
    mixed = overlay([1.0] * 4, alpha=0.25, brightness=np.array([0.0, 1.0, 1.0, 0.0]))[90, 70]
    np.testing.assert_allclose(mixed, 0.75 * 90 + 0.25 * 50 / 99 * opaque, atol=1.0)


def test_the_rest_of_the_image_and_the_input_stay():
    image = overlay([1.0] * 4)
    assert (image[150:200, 10:150] == 90).all()
    assert (image[:, :18] == 90).all()
    assert (GREY == 90).all()


def test_colours_follow_the_node_values_across_the_surface():
    image = overlay([0.0, 2.0, 2.0, 0.0], alpha=1.0, colour_map="gray")
    row = image[90, 25:115, 0].astype(float)
    # A table of 256 entries may be one entry off, and matplotlib cuts its greys down to whole levels.
    np.testing.assert_allclose(row, (np.arange(25, 115) - 20) / 99 * 255, atol=2.0)


def test_colour_bar_runs_from_high_at_the_top_to_low_at_the_bottom():
    bar = colour_bar(200, 0.0, 2.0, "stress [MPa]", "turbo", 0.4)
    table = colour_table("turbo")
    top, bottom = (np.argwhere((bar == colour).all(axis=2)) for colour in (table[255], table[0]))
    assert top[:, 0].max() < 20
    assert bottom[:, 0].min() > 180


def test_the_bar_ends_in_a_point_where_values_are_above_the_range():
    """It is half as wide halfway to its tip, and of the last colour; without such values nothing is beyond its end."""
    last = colour_table("turbo")[255]
    plain, pointed = (colour_bar(400, 0.0, 2.0, "stress [MPa]", "turbo", 1.0, above) for above in (False, True))
    widths = [(bar == last).all(axis=2).sum(axis=1) for bar in (plain, pointed)]
    assert widths[0][:28].max() == 0
    assert widths[1][:7].max() == 0
    assert widths[1][18] == pytest.approx(0.5 * widths[0].max(), abs=2)
    flat = [flat_colour_bar(400, 0.0, 2.0, "stress [MPa]", "turbo", 1.0, above) for above in (False, True)]
    assert flat[0].shape == flat[1].shape
    ends = [np.flatnonzero((bar == last).all(axis=2).any(axis=0)).max() for bar in flat]
    assert ends[1] > ends[0] + 10


def test_values_above_the_range_are_shown_by_the_bar():
    """The last colour is seen above the bar's end in one picture only."""
    last, corner = colour_table("turbo")[255], (slice(0, 20), slice(100, None))
    within, beyond = (draw_overlay(
        np.zeros((240, 320, 3), np.uint8), np.array([[20.0, 60], [90, 60], [90, 200], [20, 200]]), np.ones(4),
        TRIANGLES, np.array([0.0, 1.0, value, 0.0]), (0.0, 1.0), label="stress [MPa]",
    ) for value in (1.0, 3.0))  # fmt: skip
    assert np.abs(within.astype(int) - beyond).max() > 0
    assert (np.abs(beyond[corner].astype(int) - last).max(axis=2) < 60).sum() > (
        np.abs(within[corner].astype(int) - last).max(axis=2) < 60
    ).sum()


def test_the_colour_bar_makes_room_for_the_object_and_does_not_jump():
    place, upright, flat = BarPlace(), np.zeros((140, 60, 3), dtype=np.uint8), np.zeros((20, 160, 3), dtype=np.uint8)
    panels, found = [Panel(upright, 5, 255), Panel(upright, 5, 5), Panel(flat, 215, 155)], []
    for left, right in ((100, 200), (100, 310), (70, 310), (30, 310), (5, 310), (20, 120), (200, 310)):
        picture = np.zeros((240, 320, 3), dtype=np.uint8)
        corners = np.array([[left, 20.0], [right, 20.0], [right, 200.0], [left, 200.0]])
        painted = paint_surface(picture, corners, np.ones(4), TRIANGLES, np.zeros(4), np.zeros((256, 3)))
        found.append(place.choose(painted, panels).left)
    # In the middle; on the right, twice; on both sides; below it then stays.
    assert found == [255, 5, 5, 155, 155, 155, 155]


def test_surface_out_of_sight_and_flat_range_still_draw():
    lost = draw_overlay(
        GREY, np.full((4, 2), np.nan), -np.ones(4), TRIANGLES, np.zeros(4), (0.0, 0.0), label="stress [MPa]"
    )
    assert (lost[:, :200] == 90).all()


def test_overlay_on_a_tiny_image():
    image = np.zeros((40, 30, 3), dtype=np.uint8)
    result = draw_overlay(
        image, PIXELS, np.ones(4), TRIANGLES, np.ones(4), (0, 2), label="x", caption="frame 1 tracked"
    )
    assert result.shape == image.shape


def test_normals_of_an_arch_are_those_of_its_surface():
    model = bent_sheet_model(83, 5)
    x = model.nodes[:, 0]
    height = 0.04 * (1 - (2 * x / LENGTH) ** 2)
    points = np.column_stack([x, model.nodes[:, 1], height])
    slope = -0.04 * 8 * x / LENGTH**2
    expected = np.column_stack([-slope, np.zeros_like(x), np.ones_like(x)]) / np.sqrt(1 + slope**2)[:, None]
    inner = np.abs(x) < 0.49 * LENGTH
    found = vertex_normals(points, model.triangles)
    np.testing.assert_allclose(found[inner], expected[inner], atol=2e-3)


def test_only_the_part_of_the_image_with_the_surface_is_painted():
    """A square that leaves the image at the left: found where its corners are, cut at the border."""
    image = GREY.copy()
    shifted = PIXELS - np.array([60.0, 0.0])
    painted = paint_surface(image, shifted, np.ones(4), TRIANGLES, np.full(4, 255.0), colour_table("turbo"))
    assert painted.box() == (40, 139, 0, 59)
    changed = (image != GREY).any(axis=2)
    assert changed.sum() == painted.covered.sum() == 100 * 60
    assert changed[40:140, :60].all()


def test_lambert_is_two_sided():
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    np.testing.assert_allclose(lambert(normals, np.array([0, 0, 5.0]), 0.3), [1.0, 1.0, 0.3, 0.3 + 0.7 * 0.8])


def test_a_text_that_is_too_long_for_a_picture_goes_on_in_further_lines():
    text = "frame 124: lost: too few points of the object agree on one place, 12 of 200 where 20 are needed"
    line, wrapped = text_patch(text, 0.4), text_patch(text, 0.4, 200)
    assert line.shape[1] > 400
    assert wrapped.shape[1] <= 200
    assert wrapped.shape[0] >= 3 * line.shape[0]
    # All of it is there: as much that is light.
    light = [int((patch > 128).sum()) for patch in (line, wrapped)]
    assert light[1] == pytest.approx(light[0], rel=0.05)
