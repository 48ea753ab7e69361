"""Landmark files."""

import numpy as np
import pytest

from morph_dslam.errors import RegistrationError
from morph_dslam.io.landmarks import Landmarks, load_landmarks, save_landmarks

HEADER = "x_mm,y_mm,z_mm,u_px,v_px\n"


def test_written_landmarks_are_read_back_in_metres(tmp_path):
    path = tmp_path / "landmarks.csv"
    save_landmarks(path, Landmarks(np.array([[-0.21, 0.1485, 0.002]]), np.array([[172.125, 74.25]])))
    assert path.read_text() == HEADER + "-210,148.5,2,172.1250,74.2500\n"
    read = load_landmarks(path)
    np.testing.assert_allclose(read.points, [[-0.21, 0.1485, 0.002]])
    np.testing.assert_allclose(read.pixels, [[172.125, 74.25]])


def test_spreadsheet_habits_are_accepted(tmp_path):
    path = tmp_path / "landmarks.csv"
    path.write_text("\ufeffx_mm, y_mm, z_mm, u_px, v_px\r\n1,2,3,4,5\r\n\r\n", encoding="utf-8")
    np.testing.assert_allclose(load_landmarks(path).points, [[0.001, 0.002, 0.003]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("a,b\n1,2\n", "first line of a landmark file is x_mm"),
        ("", "first line"),
        (HEADER + "1,2,3,4\n", "landmark 1 is '1,2,3,4'; give 5 numbers"),
        (HEADER + "1,2,3,4,5\n1,2,x,4,5\n", "landmark 2 is"),
        (HEADER + "1,2,nan,4,5\n", "landmark 1 is"),
    ],
)
def test_wrong_files_are_refused(tmp_path, content, message):
    path = tmp_path / "landmarks.csv"
    path.write_text(content)
    with pytest.raises(RegistrationError, match=message):
        load_landmarks(path)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(RegistrationError, match=r"nothing\.csv"):
        load_landmarks(tmp_path / "nothing.csv")
