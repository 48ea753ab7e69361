"""Edges of known places in pictures of known blur: 8 x 8 rays a pixel, through a Gaussian lens, with noise."""

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from morph_dslam.tracking.blurred_edges import NARROW, SMOOTH, fit_edge
from morph_dslam.tracking.edge_profiles import BLUR_PX, SIDE_PX, search_outline

FINE, SIZE, MIDDLE = 8, 64, 31.5
#: Along an edge, pixels, and the pictures' number.
ALONG, N_PICTURES = np.linspace(-7.0, 7.0, 8), 10


def lit_cylinder(away, to_light, radius=40.0, ambient=0.5):
    """Lambert's brightness ``away`` pixels inside of the contour of a cylinder, for a light (outwards, to the eye)."""
    outwards = 1.0 - np.clip(away, 0.0, radius) / radius
    cosine = outwards * to_light[0] + np.sqrt(1.0 - outwards**2) * to_light[1]
    return 150.0 * (ambient + (1.0 - ambient) * np.clip(cosine, 0.0, 1.0))


#: Grey levels by the distance inside of the edge, and the width of what is seen.
SEEN = {
    "flat": (lambda away: np.where(away > 0.0, 150.0, 65.0), np.inf),
    "lit from beside": (lambda away: np.where(away > 0.0, lit_cylinder(away, (0.6, 0.8)), 65.0), np.inf),
    "lit from the camera": (lambda away: np.where(away > 0.0, lit_cylinder(away, (0.0, 1.0)), 200.0), np.inf),
    "rim as bright as the ground": (
        lambda away: np.where(away > 0.0, lit_cylinder(away, (0.0, 1.0), 40, 0), 60),
        np.inf,
    ),
    "strip of 3 px": (lambda away: np.where((away > 0.0) & (away < 3.0), 150.0, 65.0), 3.0),
    "strip of 4 px": (lambda away: np.where((away > 0.0) & (away < 4.0), 150.0, 65.0), 4.0),
    "strip of 6 px": (lambda away: np.where((away > 0.0) & (away < 6.0), 150.0, 65.0), 6.0),
}


def pictures(grey, blur, rng):
    """Pictures side by side (h, w), each with an edge in some direction; pixels on the edges and outward normals."""
    places = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5 - MIDDLE
    parts, pixels, normals = [], [], []
    for number, angle in enumerate(rng.uniform(0.0, 2.0 * np.pi, N_PICTURES)):
        normal, off = np.array([np.cos(angle), np.sin(angle)]), rng.uniform(-0.5, 0.5)
        fine = grey(off - normal[0] * places[None, :] - normal[1] * places[:, None]).astype(np.float32)
        fine = cv2.GaussianBlur(fine, (0, 0), blur * FINE, borderType=cv2.BORDER_REPLICATE)
        parts.append(cv2.resize(fine, (SIZE, SIZE), interpolation=cv2.INTER_AREA))
        across = np.array([-normal[1], normal[0]])
        pixels.append([MIDDLE + SIZE * number, MIDDLE] + ALONG[:, None] * across + off * normal)
        normals.append(np.tile(normal, (len(ALONG), 1)))
    image = np.hstack(parts) + rng.standard_normal((SIZE, SIZE * N_PICTURES))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), np.concatenate(pixels), np.concatenate(normals)


@pytest.mark.parametrize("blur", [0.4, 0.6, 1.0])
@pytest.mark.parametrize("seen", SEEN)
def test_an_edge_is_found_where_it_is_however_blurred_and_lit(seen, blur):
    """With one blur for all pictures, flat ones came out 0.08, 0.19 and 0.75 px outwards, strips up to 0.2 px."""
    grey, width = SEEN[seen]
    rng = np.random.default_rng(5)
    image, pixels, normals = pictures(grey, blur, rng)
    off = rng.uniform(-1.0, 1.0, len(pixels))
    known = np.full((len(pixels), 2, SIDE_PX), np.nan)
    turns_away, widths = np.full(len(pixels), np.isinf(width)), np.full(len(pixels), width + 0.3)
    found_blur = BLUR_PX
    for _ in range(4):
        starts = pixels + off[:, None] * normals
        found, found_blur = search_outline(image, starts, normals, turns_away, widths, known, 8, found_blur)
    errors = found + off
    assert np.isfinite(errors).mean() > 0.5
    assert abs(np.nanmedian(errors)) < 0.04
    # A pixel adds the variance of its own width to the lens'.
    assert found_blur == pytest.approx(np.sqrt(blur**2 + 1.0 / 12.0), abs=0.08)


@pytest.mark.parametrize("kind", [SMOOTH, NARROW], ids=["smooth", "narrow"])
def test_the_place_scatters_as_stated_and_the_residuals_tell_the_blur(kind):
    """Blurred steps in closed form with noise of two grey levels, fitted with a blur that is a tenth of a pixel off."""
    rng, pixels, blur, width = np.random.default_rng(1), np.arange(17.0), 0.8, 4.0
    found, variances, downwards, curved = [], [], 0.0, 0.0
    for place in rng.uniform(9.0, 10.0, 400):
        share = ndtr((place - pixels) / blur)
        if kind == NARROW:
            share -= ndtr((place - width - pixels) / blur)
        values = 60.0 + 100.0 * share + 2.0 * rng.standard_normal(17)
        off = rng.uniform(-0.15, 0.15)
        at, variance, _, _ = fit_edge(kind, values, place + off, width, blur, np.zeros(17))
        found.append(at - place)
        variances.append(variance)
        _, _, gradient, curvature = fit_edge(kind, values, place + off, width, blur - 0.1, np.zeros(17))
        downwards, curved = downwards + gradient, curved + curvature
    assert abs(np.mean(found)) < 4.0 * np.std(found) / np.sqrt(len(found))
    assert np.std(found) / np.sqrt(np.mean(variances)) == pytest.approx(1.0, abs=0.15)
    assert downwards / curved == pytest.approx(0.1, abs=0.03)
