"""What is recognised in a folder that holds the inputs of a run, by the content of its files."""

import cv2
import numpy as np
import pytest

from morph_dslam.errors import SourceError
from morph_dslam.extend.tracking import find_inputs

PICTURE = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
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


@pytest.mark.parametrize("name", ["sheet.morph", "clicks.csv", "film/0.png", "place/registration.json"])
def test_hidden_files_are_none_of_the_inputs(tmp_path, name):
    """As copies of a drive leave them beside each file, and folders of other programs."""
    contents = {"sheet.morph": b"", "clicks.csv": LANDMARKS.encode(), "film/0.png": PICTURE}
    contents["place/registration.json"] = b'{"world_from_object": 1}'
    for hidden in (False, True):
        path = tmp_path / f"{'.' * hidden}{name}"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(contents[name])
    found = find_inputs(tmp_path)
    assert len((*found.models, *found.starts, *found.recordings)) == 1


def test_of_two_recordings_the_message_says_how_to_name_one(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(SourceError, match="give one of them in place of the folder"):
        _ = find_inputs(tmp_path).recording
    (tmp_path / "b").rename(tmp_path / "frames")
    assert find_inputs(tmp_path).recording == tmp_path / "frames"
