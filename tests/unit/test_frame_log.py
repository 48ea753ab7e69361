"""Which files the frame log of a run may replace."""

import json

import pytest

from morph_dslam.tracking.frame_log import FrameLog
from morph_dslam.tracking.run_folder import RunFolder
from morph_dslam.tracking.run_results import RunResults
from tests.support.rendered_sequence import CAMERA
from tests.support.streamed import held_block_model, tracked_frame, tracked_result

LINE = '{"frame": 3, "timestamp": 0.1, "status": "tracked"}\n'
NAMED = ("--landmarks", "--model", "--camera")


@pytest.fixture
def command(tmp_path):
    """A run whose files are there, but empty, with another object; what comes next is the name of its log."""
    for name in ("film.mp4", "landmarks", "model", "camera", "box.morph", "box.csv", "3.csv", "body.toml"):
        (tmp_path / name).touch()
    inputs = [word for name in NAMED for word in (name, tmp_path / name[2:])]
    also = ["--also", "box", tmp_path / "box.morph", tmp_path / "box.csv"]
    more = ["--reregister-at", f"3={tmp_path / '3.csv'}"]
    return ["track", tmp_path / "film.mp4", *inputs, *also, *more, "-o", tmp_path / "run", "--frame-log"]


@pytest.mark.parametrize("name", ["film.mp4", "landmarks", "model", "camera", "box.morph", "box.csv", "3.csv"])
def test_an_input_is_never_emptied(name, command, tmp_path, refused):
    """Under another name too; were it empty, it would still be the wrong file."""
    (tmp_path / "log").symlink_to(tmp_path / name)
    (tmp_path / name).write_text(LINE)
    assert "log is an input of this command" in refused(*command, tmp_path / "log")
    assert (tmp_path / name).read_text() == LINE
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"frame,timestamp_s,status\n0,0.0,tracked\n",
        b"\x89PNG\r\n\x1a\n\xff\xd8",
        b'{"frames": 3}\n',
        b"[3]\n",
        b"\n" + LINE.encode(),
    ],
)
def test_a_file_that_is_no_log_is_never_emptied(content, command, tmp_path, refused):
    other = tmp_path / "frames.csv"
    other.write_bytes(content)
    message = refused(*command, other)
    assert f"the frame log {other} is there and holds something else" in message
    assert "name another file" in message
    assert other.read_bytes() == content


@pytest.mark.parametrize("content", [None, "", LINE, 2 * LINE])
def test_a_log_begins_anew(content, command, tmp_path, refused):
    """The next that is wrong is the film."""
    log = tmp_path / "log.jsonl"
    if content is not None:
        log.write_text(content)
    assert "log.jsonl" not in refused(*command, log)


def test_an_earlier_log_is_there_until_the_first_frame_and_each_pass_begins_anew(tmp_path):
    path, model = tmp_path / "log.jsonl", held_block_model()
    path.write_text(LINE)
    folder = RunFolder(tmp_path / "run", "block", RunResults(model, reference_frame=0), CAMERA, overwrite=True)
    log = FrameLog(path, {"block": folder})
    assert path.read_text() == LINE

    def take(number):
        tracked = tracked_frame(number, 0.1 * number, block=tracked_result(model, 0.1, 0.002))
        folder(tracked)
        log(tracked)
        return [json.loads(line)["frame"] for line in path.read_text().splitlines()]

    assert [take(7), take(8)] == [[7], [7, 8]]
    log.start_again()
    assert take(7) == [7]
