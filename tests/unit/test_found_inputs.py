"""What is recognised in a folder that holds the inputs of a run, by the content of its files."""

import cv2
import numpy as np
import pytest

from morph_dslam.errors import SourceError
from morph_dslam.extend.tracking import find_inputs

LANDMARKS = "x_mm,y_mm,z_mm,u_px,v_px\n1,2,3,4,5\n"


def test_a_table_is_one_of_landmarks_by_its_header_alone(tmp_path):
    """Hints in the keyframes of a map have a column more, and are no start of a run; spreadsheets begin with a mark."""
    (tmp_path / "hints.csv").write_text("frame,x_mm,y_mm,z_mm,u_px,v_px\n7,1,2,3,4,5\n")
    assert find_inputs(tmp_path).starts == ()
    (tmp_path / "clicks.csv").write_text(LANDMARKS, encoding="utf-8-sig")
    assert find_inputs(tmp_path).start == ("landmarks", tmp_path / "clicks.csv")


@pytest.mark.parametrize("section", ["mesh", "sheet", "shell", "external"])
def test_every_kind_of_study_is_found(tmp_path, section):
    (tmp_path / "study.toml").write_text(f'name = "part"\n[{section}]\n')
    assert find_inputs(tmp_path).studies == (tmp_path / "study.toml",)


def test_of_two_recordings_the_message_says_how_to_name_one(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(SourceError, match="give one of them in place of the folder"):
        _ = find_inputs(tmp_path).recording
    (tmp_path / "b").rename(tmp_path / "frames")
    assert find_inputs(tmp_path).recording == tmp_path / "frames"
