"""Files that cannot be written: which one it is is said, no half of it stays, and the program goes on."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from errno import ENOSPC
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.cli.app import main
from morph_dslam.errors import EvaluationError, IdentificationError, StudyError, TrackingError
from morph_dslam.evaluation.evaluate import evaluate
from morph_dslam.identification.report import write_identification
from morph_dslam.io.hdf5_writing import written_hdf5
from morph_dslam.io.writing import writing
from morph_dslam.model import load_model, save_model
from morph_dslam.tracking.frame_log import FrameLog
from morph_dslam.tracking.run_folder import RunFolder
from morph_dslam.tracking.run_results import RunResults
from tests.support.bent_sheet import bent_sheet_model
from tests.support.block_study import write_study
from tests.support.documents import PROJECT
from tests.support.full_disk import largest_file
from tests.support.run_folders import CAMERA, exact_truth, write_run
from tests.support.scenes import write_scene
from tests.unit.test_results import frame_result

#: Writes what does not fit, in groups whose table is written on closing, and then something that does.
FULL = """
import sys
from pathlib import Path
import numpy as np
from morph_dslam.io.hdf5_writing import written_hdf5
from tests.support.documents import PROJECT
from tests.support.full_disk import largest_file

try:
    with largest_file(100_000), written_hdf5(Path("large.h5")) as file:
        chunks = file.create_dataset("chunks", (50, 100, 100), "f8", chunks=(1, 100, 100), compression="gzip")
        for k in range(50):
            chunks[k] = np.random.default_rng(k).random((100, 100))
            file[f"group/{k}"] = np.arange(20.0)
except OSError as error:
    print(error)
with written_hdf5(Path("small.h5")) as file:
    file["values"] = np.arange(3)
"""


def test_a_full_disk_ends_no_program(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", FULL], cwd=tmp_path, capture_output=True, text=True, env={"PYTHONPATH": str(PROJECT)}
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "[Errno 27] File too large: 'large.h5.partial'\n"
    assert [path.name for path in tmp_path.iterdir()] == ["small.h5"]
    with h5py.File(tmp_path / "small.h5") as file:
        assert file["values"][()].tolist() == [0, 1, 2]


def test_a_file_has_one_writer(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    with written_hdf5(path, userblock_size=512) as file:
        file["first"] = 1.0
        with pytest.raises(BlockingIOError), written_hdf5(path):
            pass
    with h5py.File(path) as file:
        assert (file["first"][()], file.userblock_size) == (1.0, 512)


#: Has a file open, as another program, from its first line of output to its first one of input.
READER = """
import sys, h5py
with h5py.File(sys.argv[1]) as file:
    print(file["value"][()], flush=True)
    sys.stdin.readline()
    print(file["value"][()])
"""


def test_who_reads_a_file_goes_on_with_it_while_it_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    for value in (1, 2):
        with written_hdf5(path) as file:
            file["value"] = value
            if value == 2:
                reader = subprocess.Popen(
                    [sys.executable, "-c", READER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
                )
                assert reader.stdout is not None
                assert reader.stdout.readline() == "1\n"
    assert reader.communicate("\n")[0] == "1\n"
    assert reader.returncode == 0
    with h5py.File(path) as file:
        assert file["value"][()] == 2
    assert [each.name for each in tmp_path.iterdir()] == ["file.h5"]


def test_a_file_that_fails_leaves_the_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    with written_hdf5(path) as file:
        file["value"] = 1
    with pytest.raises(ZeroDivisionError), written_hdf5(path) as file:
        file["value"] = 1 / 0
    assert [each.name for each in tmp_path.iterdir()] == ["file.h5"]
    with h5py.File(path) as file:
        assert file["value"][()] == 1


def test_an_error_of_another_kind_is_not_taken_for_the_drives(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), written_hdf5(tmp_path / "file.h5") as file:
        file["value"] = 1 / 0
    assert not list(tmp_path.iterdir())


def test_the_file_is_named_where_the_system_names_none() -> None:
    here = Path("here")
    with pytest.raises(StudyError, match=r"^cannot write here: No space left on device$"), writing(StudyError, here):
        raise OSError(ENOSPC, "No space left on device")
    with pytest.raises(StudyError, match=r"^cannot write there: File exists$"), writing(StudyError, here):
        raise FileExistsError(17, "File exists", "there")


def test_a_command_ends_with_the_words_of_the_system(capsys) -> None:
    def action(arguments: argparse.Namespace) -> None:
        raise arguments.error

    full = OSError(ENOSPC, "No space left on device", "runs/a.csv")
    assert cli.run_and_report_errors(action, argparse.Namespace(error=full), "") == 2
    assert capsys.readouterr().err == "morph: runs/a.csv: No space left on device\n"
    with pytest.raises(OSError, match="a defect"):
        cli.run_and_report_errors(action, argparse.Namespace(error=OSError("a defect")), "")


def test_a_model_that_does_not_fit_leaves_the_old_one(tmp_path: Path) -> None:
    model, path = bent_sheet_model(9, 7), tmp_path / "sheet.morph"
    save_model(path, model)
    with pytest.raises(OSError, match=r"sheet\.morph\.partial"), largest_file(path.stat().st_size - 1):
        save_model(path, bent_sheet_model(12, 9))
    assert [file.name for file in tmp_path.iterdir()] == ["sheet.morph"]
    assert len(load_model(path).nodes) == len(model.nodes)


@pytest.mark.slow
def test_builds(tmp_path: Path, capsys) -> None:
    study, output = str(write_study(tmp_path)), tmp_path / "block.morph"
    with largest_file(1000):
        assert main(["build", study, "-o", str(output)]) == 2
    assert "block.morph.snapshots/" in capsys.readouterr().err.splitlines()[-1]
    assert {path.name for path in tmp_path.rglob("*")} == {"study.toml", "block.morph.snapshots", ".lock"}
    assert main(["build", study, "-o", str(output)]) == 0
    solved = len(list(tmp_path.rglob("*.npz")))
    capsys.readouterr()
    with largest_file(1000):
        assert main(["build", study, "-o", str(output)]) == 2
    assert f"cannot write {output}.partial: File too large" in capsys.readouterr().err
    assert (len(list(tmp_path.rglob("*.npz"))), list(tmp_path.rglob("*.partial"))) == (solved, [])
    (tmp_path / "other.morph.snapshots").write_text("")
    assert main(["build", study, "-o", str(tmp_path / "other.morph")]) == 2
    assert f"cannot write {tmp_path / 'other.morph.snapshots'}: File exists" in capsys.readouterr().err


def test_simulations(tmp_path: Path, capsys) -> None:
    scene, output = str(write_scene(tmp_path)), tmp_path / "sequence"
    with largest_file(3000):
        assert main(["simulate", scene, "-o", str(output)]) == 2
    assert f"morph: cannot write {output}" in capsys.readouterr().err
    assert not (output / "depth.h5").exists()
    assert main(["simulate", scene, "-o", str(output)]) == 0


def tracked_run(folder: Path, overwrite: bool = False) -> RunFolder:
    """A run of one frame that is not written yet."""
    results = RunResults(bent_sheet_model(22, 16), reference_frame=3)
    results.add(3, 0.0, frame_result([0.01, 0.1, 0.0], [1e-3, 0.05, 0.01], [False, False, False]))
    return RunFolder(folder, "sheet", results, CAMERA, overwrite=overwrite)


def test_runs(tmp_path: Path) -> None:
    tracked_run(tmp_path / "before").write()  # inner loops that are compiled are kept in files too
    run = tracked_run(tmp_path / "run")
    for size, name in ((2_000, "result.h5.partial"), (40_000, "model.morph.partial")):
        with pytest.raises(TrackingError, match=rf"cannot write .*{name}: File too large"), largest_file(size):
            run.write()
        assert not (tmp_path / "run" / name).exists()
        assert len((tmp_path / "run" / "frames.csv").read_text().splitlines()) == 2
    run.write()


def test_a_run_is_written_whole_though_the_earlier_one_is_open(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    tracked_run(folder).write()
    later = tracked_run(folder, overwrite=True)
    with h5py.File(folder / "result.h5") as earlier, h5py.File(folder / "model.morph"):
        later.results.add(4, 0.1, frame_result([0.02, 0.1, 0.0], [1e-3, 0.05, 0.01], [False, False, False]))
        later.write()
        assert earlier["frame"][()].tolist() == [3]
    with h5py.File(folder / "result.h5") as file:
        assert file["frame"][()].tolist() == [3, 4]
    assert json.loads((folder / "summary.json").read_text())["n_frames"] == 2
    assert not list(folder.glob("*.partial"))


def test_frame_logs(tmp_path: Path) -> None:
    run = tracked_run(tmp_path / "run")
    log = FrameLog(Path("/dev/full"), {"sheet": run})
    with pytest.raises(TrackingError, match="cannot write /dev/full: No space left on device"):
        log(SimpleNamespace())  # what it writes is the run's last frame


def test_what_a_run_that_was_killed_left_is_kept(tmp_path: Path) -> None:
    """Its log may be all there is: the folder has no result, so that the next run is not refused for that."""
    log, run = tmp_path / "frames.jsonl", tracked_run(tmp_path / "run")
    log.write_text('{"frame": 3}\n')
    with pytest.raises(TrackingError, match=r"frames\.jsonl holds an earlier run: .*move this one, .*--overwrite"):
        FrameLog(log, {"sheet": run})
    assert log.read_text() == '{"frame": 3}\n'
    again = RunFolder(tmp_path / "run", "sheet", run.results, CAMERA, overwrite=True)
    FrameLog(log, {"sheet": again})(SimpleNamespace())
    assert [json.loads(line)["status"] for line in log.read_text().splitlines()] == ["tracked"]


def test_evaluations(tmp_path: Path) -> None:
    np.savez(tmp_path / "truth.npz", **exact_truth(write_run(tmp_path / "run")))
    (tmp_path / "run" / "evaluation.json").mkdir()
    with pytest.raises(EvaluationError, match=r"cannot write .*evaluation\.json: Is a directory"):
        evaluate(tmp_path / "run", tmp_path / "truth.npz", 10)


def test_identifications(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("morph_dslam.identification.report.summarise", lambda found: {})
    with pytest.raises(IdentificationError, match=r"cannot write .*file: File exists"):
        write_identification(tmp_path / "file", SimpleNamespace(misfits=[]))
