"""The command line: exit statuses, messages, and a quick start."""

import os
import subprocess
import sys

import pytest

from morph_dslam.cli import app as cli
from morph_dslam.cli.arguments import frame_range
from morph_dslam.errors import StudyError
from morph_dslam.model import save_model
from tests.support.bent_sheet import bent_sheet_model


def refused(capsys, *arguments):
    """The one message of a command that must end with status 2 and no traceback."""
    assert cli.main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("morph: ")
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.mark.parametrize("command", ["track", "live"])
def test_section_on_the_side_of_the_minus_sign_is_a_value(capsys, tmp_path, command):
    """As documented, "--section -x=12"; argparse alone would take "-x=12" for an option."""
    arguments = ("film", "--camera", "c.yaml", "--landmarks", "l.csv", "-o", tmp_path / "run")
    model = tmp_path / "absent.morph"
    assert "c.yaml" in refused(capsys, command, *arguments, "--model", model, "--section", "-x=12")


def test_help_and_version_need_no_heavy_import():
    program = (
        "import sys; from morph_dslam.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        "heavy = {'numba', 'ngsolve', 'cv2', 'matplotlib', 'scipy', 'h5py'} & sys.modules.keys()\n"
        "assert not heavy, heavy"
    )
    for option in ("--help", "--version"):
        done = subprocess.run([sys.executable, "-c", program, option], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "morph" in done.stdout


def test_the_installed_command_exits_2_without_a_traceback():
    program = "import sys; from morph_dslam.cli import main; sys.exit(main(['info', 'absent.morph']))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("morph: there is no model file absent.morph")
    assert "Traceback" not in done.stderr


def test_output_that_nobody_reads_any_more_ends_quietly(tmp_path):
    """As in `morph info sheet.morph | head -1`: no traceback, and the status that a shell gives SIGPIPE."""
    save_model(tmp_path / "sheet.morph", bent_sheet_model(9, 7))
    program = "import sys; from morph_dslam.cli import main; sys.exit(main(['info', 'sheet.morph']))"
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, stdout=write, stderr=subprocess.PIPE, text=True
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_broken_pipe_elsewhere_is_not_hidden(monkeypatch):
    def fail(arguments):
        raise BrokenPipeError

    monkeypatch.setattr("morph_dslam.cli.info.run", fail)
    with pytest.raises(BrokenPipeError):
        cli.main(["info", "model.morph"])


@pytest.mark.parametrize("arguments", [[], ["dance"], ["info"], ["evaluate", "run"], ["info", "a", "--wrong"]])
def test_wrong_usage_exits_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 2
    assert "usage: morph" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [(StudyError("mend it so"), 2, "morph: mend it so"), (KeyboardInterrupt(), 130, "interrupted; nothing was")],
)
def test_errors_and_interrupts_become_statuses(monkeypatch, capsys, error, status, message):
    def fail(arguments):
        raise error

    monkeypatch.setattr("morph_dslam.cli.info.run", fail)
    assert cli.main(["info", "model.morph"]) == status
    assert message in capsys.readouterr().err


def test_defects_are_not_hidden(monkeypatch):
    def fail(arguments):
        raise ZeroDivisionError

    monkeypatch.setattr("morph_dslam.cli.info.run", fail)
    with pytest.raises(ZeroDivisionError):
        cli.main(["info", "model.morph"])


@pytest.mark.parametrize(
    ("text", "expected"), [("9-100", (9, 100)), ("9-", (9, None)), ("-100", (None, 100)), ("9", (9, 9))]
)
def test_frame_ranges(text, expected):
    assert frame_range(text) == expected


@pytest.mark.parametrize("text", ["", "-", "a-b", "9-8", "1-2-3"])
def test_wrong_frame_ranges(text, capsys):
    command = ["track", "video.mp4", "--model", "m", "--camera", "c", "--landmarks", "l", "-o", "r"]
    with pytest.raises(SystemExit):
        cli.main([*command, f"--range={text}"])
    assert "is not a range of frames such as 9-100" in capsys.readouterr().err


def test_info_says_what_a_model_holds(tmp_path, capsys):
    model = bent_sheet_model(7, 5)
    model.certificate.update({"displacement": {"mean_mm": 0.21, "n_held_out": 32}, "compression_percent": 98.7})
    model.provenance.update({"morph_dslam": "0.1.0", "study": "name = 'x'\n" * 50})
    save_model(tmp_path / "sheet.morph", model)
    assert cli.main(["info", str(tmp_path / "sheet.morph")]) == 0
    words = " ".join(capsys.readouterr().out.split())
    for fact in (
        "nodes 35",
        "triangles 48",
        "extent 420 x 297 x 0 mm",
        "arch -60 to 60 mm, default 0; height of the arch",
        "twist -20 to 20 deg",
        "displacement 9",
        "displacement 0.210 – – – mm",
        "held-out solves 32",
        "compression of the displacement 98.70 %",
        "morph dslam 0.1.0",
    ):
        assert fact in words
    assert "name = 'x'" not in words


def test_info_refuses_a_model_cut_in_half(tmp_path, capsys):
    path = tmp_path / "sheet.morph"
    save_model(path, bent_sheet_model(7, 5))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "is damaged or cut short" in refused(capsys, "info", path)
