"""Motion blur is told from sharp pictures by pictures that are averaged over known paths."""

import cv2
import numpy as np
import pytest

from morph_dslam.tracking.motion_blur import LEAST_PATH_PX, blurred_paths
from morph_dslam.tracking.patches import normalize_contrast

#: Points all over a picture of 400 x 300 pixels.
POINTS = np.stack(np.meshgrid(np.linspace(60.0, 340.0, 8), np.linspace(60.0, 240.0, 6)), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def texture():
    """Random speckles (300, 400) about the mean 0, standard deviation 1."""
    speckles = cv2.GaussianBlur(np.random.default_rng(3).standard_normal((300, 400)), (0, 0), 2.0)
    return speckles / speckles.std()


def picture(texture, contrast=40.0, light=128.0, noise=2.0):
    grey = light + contrast * texture + noise * np.random.default_rng(4).standard_normal(texture.shape)
    return normalize_contrast(np.clip(grey, 0.0, 255.0).astype(np.uint8))


def smeared(texture, path):
    """The texture's mean while it moves from half a path (2,) before where it is to half a path after."""
    x, y = np.meshgrid(np.arange(400, dtype=np.float32), np.arange(300, dtype=np.float32))
    instants = np.linspace(-0.5, 0.5, 41)
    shifted = [
        cv2.remap(texture, x - np.float32(t * path[0]), y - np.float32(t * path[1]), cv2.INTER_CUBIC,
                  borderMode=cv2.BORDER_REFLECT)
        for t in instants
    ]  # fmt: skip
    return np.mean(shifted, axis=0)


def found(texture, frame, way):
    ways = np.broadcast_to(np.asarray(way, dtype=np.float64), POINTS.shape)
    return blurred_paths(picture(texture), frame, POINTS, POINTS, ways)


@pytest.mark.parametrize("way", [(16.0, 0.0), (-6.0, 9.0)])
@pytest.mark.parametrize("share", [0.75, 1.0])
@pytest.mark.parametrize("light", [{}, {"contrast": 18.0, "light": 70.0}, {"noise": 6.0}])
def test_the_path_is_that_over_which_the_picture_was_averaged(texture, way, share, light):
    path = share * np.array(way)
    paths = found(texture, picture(smeared(texture, path), **light), way)
    np.testing.assert_allclose(paths, np.broadcast_to(path, paths.shape), atol=0.26 * np.linalg.norm(way))


def test_only_motion_blurs_a_picture(texture):
    """Sharp ones do not, at any speed, in any light, out of focus, or as seen from farther off; nor do short paths."""
    for way in [(0.0, 0.0), (3.0, 2.0), (16.0, 0.0), (0.0, -40.0)]:
        assert found(texture, picture(texture), way) is None
        assert found(texture, picture(texture, contrast=15.0, light=60.0, noise=5.0), way) is None
        assert found(texture, picture(cv2.GaussianBlur(texture, (0, 0), 3.0)), way) is None
    assert found(texture, picture(smeared(texture, (0.0, 12.0))), (16.0, 0.0)) is None
    short = 0.75 * LEAST_PATH_PX
    assert found(texture, picture(smeared(texture, (short, 0.0))), (short, 0.0)) is None
    assert blurred_paths(picture(texture), picture(texture), *np.zeros((3, 0, 2))) is None
