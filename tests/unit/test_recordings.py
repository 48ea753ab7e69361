"""Recordings in the layouts of TUM RGB-D, EuRoC and 7-Scenes: images, depth in metres, stereo, timestamps."""

import cv2
import numpy as np
import pytest

from morph_dslam.errors import SourceError
from morph_dslam.sources import open_source
from tests.support.real_data import real_data


def save(path, value, size=(12, 16)):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((*size, 3), value, dtype=np.uint8))


def save_depth(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.asarray(values, dtype=np.uint16))


@pytest.fixture
def tum(tmp_path):
    times = ("1305031102.1753", "1305031102.2113", "1305031102.2433")
    for number, time in enumerate(times):
        save(tmp_path / "rgb" / f"{time}.png", 10 * number)
    (tmp_path / "rgb.txt").write_text(
        "# color images\n# timestamp filename\n" + "".join(f"{t} rgb/{t}.png\n" for t in times)
    )
    depth = np.full((12, 16), 7500)
    depth[0, 0] = 0
    save_depth(tmp_path / "depth" / "a.png", depth)
    save_depth(tmp_path / "depth" / "b.png", depth + 1)
    # 4 ms after the first image, 30 ms after the last; nothing close to the second.
    (tmp_path / "depth.txt").write_text("1305031102.1793 depth/a.png\n1305031102.2733 depth/b.png\n")
    return tmp_path


def test_tum_keeps_time_and_depth(tum):
    source = open_source(tum)
    frames = list(source)
    assert len(source) == 3
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.timestamp for frame in frames] == [1305031102.1753, 1305031102.2113, 1305031102.2433]
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 10, 20]
    depth = frames[0].depth
    assert depth.dtype == np.float32
    assert np.isnan(depth[0, 0])
    assert depth[1, 1] == pytest.approx(1.5)
    assert [frame.depth is None for frame in frames] == [False, True, True]
    assert source.fps == pytest.approx(1.0 / 0.034, rel=1e-3)
    assert [frame.index for frame in open_source(tum, 1, 1)] == [1]


def test_tum_without_depth_and_with_a_broken_list(tum):
    (tum / "depth.txt").unlink()
    assert next(iter(open_source(tum))).depth is None
    (tum / "rgb.txt").write_text("1305031102.1 rgb/a.png more\n")
    with pytest.raises(SourceError, match=r"rgb\.txt, line 1: .* is not a timestamp and a file"):
        open_source(tum)
    (tum / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(SourceError, match="holds no frames"):
        open_source(tum)


def test_depth_of_another_kind_or_size(tum):
    save(tum / "depth" / "a.png", 3)
    with pytest.raises(SourceError, match=r"frame 0: .*a\.png is not a depth image"):
        list(open_source(tum))
    save_depth(tum / "depth" / "a.png", np.ones((6, 8)))
    with pytest.raises(SourceError, match=r"frame 0: .*a\.png is 8x6 pixels, the frames before it are 16x12"):
        list(open_source(tum))


@pytest.fixture
def euroc(tmp_path):
    stamps = {"cam0": (1403636579763555584, 1403636579813555456), "cam1": (1403636579813555456,)}
    for camera, times in stamps.items():
        folder = tmp_path / "mav0" / camera
        for number, time in enumerate(times):
            save(folder / "data" / f"{time}.png", 50 * number + 100 * (camera == "cam1"))
        rows = "".join(f"{time},{time}.png\r\n" for time in times)
        (folder / "data.csv").write_text(f"#timestamp [ns],filename\r\n{rows}")
    return tmp_path


def test_euroc_pairs_left_and_right(euroc):
    for folder in (euroc, euroc / "mav0"):
        first, second = open_source(folder)
        assert first.timestamp == pytest.approx(1403636579.763555584, abs=3e-7, rel=0)
        assert second.timestamp - first.timestamp == pytest.approx(0.05, abs=1e-6)
        assert first.right is None
        assert (int(second.image[0, 0, 0]), int(second.right[0, 0, 0])) == (50, 100)
    (euroc / "mav0" / "cam0" / "data.csv").write_text("yesterday,a.png\n")
    with pytest.raises(SourceError, match=r"data\.csv, line 1: .* is not a timestamp in nanoseconds"):
        open_source(euroc)


def test_seven_scenes_by_number(tmp_path):
    for number in (3, 4):
        save(tmp_path / f"frame-{number:06}.color.png", number)
        (tmp_path / f"frame-{number:06}.pose.txt").write_text("1")
    save_depth(tmp_path / "frame-000004.depth.png", [[1500, 0, 65535, 2000] * 4] * 12)
    first, second = open_source(tmp_path)
    assert (first.index, first.timestamp, first.depth) == (3, 0.1, None)
    np.testing.assert_allclose(second.depth[0, :4], [1.5, np.nan, np.nan, 2.0])
    with pytest.raises(SourceError, match="frame 5 is not in"):
        open_source(tmp_path, 3, 5)


def test_the_real_seven_scenes_recording():
    source = open_source(real_data("7scenes_redkitchen"), 10, 11)
    with_depth, without = source
    assert with_depth.image.shape == (480, 640, 3)
    # A kitchen: depths between half a metre and five.
    assert 0.5 < np.nanmedian(with_depth.depth) < 5.0
    assert without.depth is None
