"""The command line: exit statuses, messages, and a quick start."""

import argparse
import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import pytest

from morph_dslam.cli import app as cli
from morph_dslam.cli.arguments import file_and_column, frame_range
from morph_dslam.cli.track import print_summary
from morph_dslam.errors import StreamError, StudyError
from morph_dslam.model import save_model
from morph_dslam.units import FACTORS
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import commands

#: Figures of a run that are printed at its end.
COUNTS = ("n_tracked", "n_frames", "n_hidden", "n_lost", "n_skipped", "median_ms", "p95_ms")


def test_coordinates_are_in_the_units_of_studies():
    taken = {name: [a.choices for a in parser._actions if a.dest == "unit"] for name, parser in commands().items()}
    assert [name for name, choices in taken.items() if choices] == ["build", "info", "inner"]
    for (choices,) in filter(None, taken.values()):
        assert set(choices) == set(FACTORS["length"])


def test_an_option_that_a_command_does_not_have_is_answered_with_the_one_it_is_like(capsys):
    for given, answer in (
        ("build study.toml -o x --worker 2 --outlines", "--outlines; `morph build --help` lists the options"),
        ("slam film.mp4 --camera c -o x --refine_camera", "--refine_camera (do you mean --refine-camera?)"),
    ):
        with pytest.raises(SystemExit) as end:
            cli.main(given.split())
        assert end.value.code == 2
        assert f"unrecognized arguments: {answer}" in capsys.readouterr().err


def test_commands_multiply_matrices_in_one_thread(tmp_path):
    program = """
from morph_dslam.cli import main
main(["info", "absent.morph"])
from threadpoolctl import threadpool_info
print(*(pool["num_threads"] for pool in threadpool_info() if pool["internal_api"] == "openblas"))
"""
    free = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, env=free)
    assert set(done.stdout.split()) == {"1"}


@pytest.mark.parametrize("command", ["track", "live"])
def test_section_on_the_side_of_the_minus_sign_is_a_value(refused, tmp_path, command):
    """As documented, "--section -x=12"; argparse alone would take "-x=12" for an option."""
    arguments = ("film", "--camera", "c.yaml", "--landmarks", "l.csv", "-o", tmp_path / "run")
    model = tmp_path / "absent.morph"
    assert "c.yaml" in refused(command, *arguments, "--model", model, "--section", "-x=12")


def test_help_and_version_need_no_heavy_import():
    program = (
        "import sys; from morph_dslam.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        "heavy = {'numba', 'ngsolve', 'netgen', 'cv2', 'matplotlib', 'scipy', 'h5py'} & sys.modules.keys()\n"
        "assert not heavy, heavy"
    )
    for option in ("--help", "--version"):
        done = subprocess.run([sys.executable, "-c", program, option], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "morph" in done.stdout


def test_a_summary_or_a_missing_file_needs_nothing_that_builds_or_draws(tmp_path):
    save_model(tmp_path / "sheet.morph", bent_sheet_model(9, 7))
    program = (
        "import sys; from morph_dslam.cli import main\n"
        "words = '--camera c.yaml --model absent.morph --landmarks l.csv -o run'.split()\n"
        "commands = ['info', 'sheet.morph'], ['info', 'absent.morph'], ['track', 'film', *words]\n"
        "print(*(main(command) for command in commands))\n"
        "print(*{'ngsolve', 'netgen', 'matplotlib', 'scipy.stats', 'scipy.signal'} & sys.modules.keys())\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-2:] == ["0 2 2", ""]


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


@pytest.mark.parametrize("arguments", [[], ["dance"], ["info"], ["evaluate", "run"], ["info", "a", "--wrong"]])
def test_wrong_usage_exits_2(arguments, refused):
    assert ": error: " in refused(*arguments)


def lost_interrupt():
    """What Python makes of an interrupt that compiled code went on after."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    return error


def info_that_raises(monkeypatch, error):
    def fail(arguments):
        raise error

    monkeypatch.setattr("morph_dslam.cli.info.run", fail)
    return cli.main(["info", "model.morph"])


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (StudyError("mend it so"), 2, "morph: mend it so"),
        (KeyboardInterrupt(), 130, "interrupted; nothing was"),
        (lost_interrupt(), 130, "interrupted; nothing was"),
    ],
)
def test_errors_and_interrupts_become_statuses(monkeypatch, capsys, error, status, message):
    assert info_that_raises(monkeypatch, error) == status
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("command", ["track", "live"])
@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (KeyboardInterrupt(), 130, "morph: interrupted; nothing was tracked yet"),
        (lost_interrupt(), 130, "morph: interrupted; nothing was tracked yet"),
        (StreamError("the port is taken"), 2, "morph: the port is taken"),
    ],
)
def test_a_run_that_did_not_begin_leaves_no_empty_folder(
    monkeypatch, tmp_path, capsys, command, error, status, message
):
    def ended(options, tell):
        options.output.mkdir()
        raise error

    monkeypatch.setattr("morph_dslam.track", ended, raising=False)
    words = ["film", "--camera", "c", "--landmarks", "l", "--model", "m", "-o", str(tmp_path / "run")]
    assert cli.main([command, *words]) == status
    assert capsys.readouterr().err.strip() == message
    assert not (tmp_path / "run").exists()


def test_an_interrupt_after_a_result_says_that_it_is_kept(monkeypatch, tmp_path, capsys):
    def ended(options, tell):
        options.output.mkdir()
        (options.output / "summary.json").touch()
        tell(
            options.output, {"flags": [], "one_over_the_sequence": [], "largest_forces": []} | dict.fromkeys(COUNTS, 1)
        )
        raise KeyboardInterrupt

    monkeypatch.setattr("morph_dslam.track", ended, raising=False)
    words = ["film", "--camera", "c", "--landmarks", "l", "--model", "m", "-o", str(tmp_path / "run")]
    assert cli.main(["track", *words]) == 130
    assert "interrupted; the frames tracked so far are kept in the run folder" in capsys.readouterr().err
    assert (tmp_path / "run" / "summary.json").exists()


def test_a_force_that_no_frame_tells_from_zero_is_not_printed_as_one(tmp_path, capsys):
    clear = {"on": "z_min", "force_N": 74.2, "standard_deviation_N": 5.0, "frame": 19, "not_counted": []}
    clear |= {"at_bound": [], "differs_from_zero": True}
    forces = [clear, clear | {"at_bound": ["push"]}]
    forces += [clear | {"on": "x_min", "force_N": 120.0, "standard_deviation_N": 330.0, "differs_from_zero": False}]
    print_summary(
        tmp_path, {"flags": [], "one_over_the_sequence": [], "largest_forces": forces} | dict.fromkeys(COUNTS, 1)
    )
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("largest")] == [
        "largest force, z_min: 74.2 ± 5 N in frame 19",
        "largest force, z_min: 74.2 ± 5 N in frame 19, with 'push' at an end of its range: the object may be beyond, "
        "and the force another",
        "largest force, x_min: no frame tells a force apart from zero; the largest is 120 ± 330 N in frame 19",
    ]


@pytest.mark.parametrize("command", ["track", "live"])
def test_help_shows_arguments_in_groups(command, capsys):
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    shown = capsys.readouterr().out
    titles = ("objects and frames:", "where the object is:", "what is measured:", "what stands still:")
    places = [shown.index(f"\n{title}") for title in (*titles, "forces and material:", "picture and output:")]
    assert places == sorted(places)
    assert ("--refine" in shown) == (command == "track")


@pytest.mark.parametrize("still", [True, False])
def test_refining_what_one_pose_is_estimated_with_anyway_is_said_to_change_nothing(tmp_path, capsys, still):
    """The files are absent, which is found afterwards."""
    files = ["--model", "a.morph", "--camera", "c.yaml", "--landmarks", "l.csv", "-o", str(tmp_path / "run")]
    assert cli.main(["track", str(tmp_path / "frames"), *files, "--refine", *(["--still"] if still else [])]) != 0
    assert ("--refine changes nothing" in capsys.readouterr().out) == still


@pytest.mark.parametrize("defect", [ZeroDivisionError, BrokenPipeError, SystemError])
def test_defects_are_not_hidden(monkeypatch, defect):
    with pytest.raises(defect):
        info_that_raises(monkeypatch, defect)


@pytest.mark.parametrize(
    ("text", "expected"), [("9-100", (9, 100)), ("9-", (9, None)), ("-100", (None, 100)), ("9", (9, 9))]
)
def test_frame_ranges(text, expected):
    assert frame_range(text) == expected


@pytest.mark.parametrize("text", ["", "-", "a-b", "9-8", "1-2-3"])
def test_wrong_frame_ranges(text, refused):
    command = ["track", "video.mp4", "--model", "m", "--camera", "c", "--landmarks", "l", "-o", "r"]
    assert "is not a range of frames such as 9-100" in refused(*command, f"--range={text}")


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_until_a_module_is_imported(number, capsys, tmp_path, monkeypatch):
    """Compiled modules turn it into errors of their own, as this one does."""
    (tmp_path / "interrupted_module.py").write_text(
        "import signal\n"
        "try:\n"
        f"    signal.raise_signal({int(number)})\n"
        "except KeyboardInterrupt as error:\n"
        "    raise ImportError('initialization failed') from error\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "interrupted_module", raising=False)
    imported = []

    def action(_):
        imported.append(import_module("interrupted_module"))
        time.sleep(30.0)
        imported.append("not interrupted")

    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    assert cli.run_and_report_errors(action, argparse.Namespace(), "one module is imported") == 130
    assert len(imported) == 1
    assert capsys.readouterr().err == "\nmorph: interrupted; one module is imported\n"
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_waits_for_what_compiled_code_calls_back():
    """Code that numba compiled takes no notice of errors of numba's own functions that it calls."""

    class Interrupting:
        def __reduce__(self):
            signal.raise_signal(signal.SIGINT)
            return str, ()

    called = []

    def action(_):
        from numba.core.serialize import dumps

        called.append(dumps(Interrupting()))
        time.sleep(30.0)
        called.append("not interrupted")

    assert cli.run_and_report_errors(action, argparse.Namespace(), "") == 130
    assert len(called) == 1


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_not_lost_where_errors_cannot_be_raised(number, capsys):
    """As where an object is deleted; Cython code does the same."""

    class Deleted:
        def __del__(self):
            signal.raise_signal(number)

    gone_on = []

    def action(_):
        Deleted()
        gone_on.append("behind it")
        time.sleep(30.0)
        gone_on.append("not interrupted")

    hooks = sys.unraisablehook, sys.excepthook
    assert cli.run_and_report_errors(action, argparse.Namespace(), "it went on") == 130
    assert gone_on == ["behind it"]
    assert capsys.readouterr().err == "\nmorph: interrupted; it went on\n"
    assert (sys.unraisablehook, sys.excepthook) == hooks


def test_progress_in_a_log_is_a_line_in_ten_seconds():
    code = "from morph_dslam.cli import main\ntry: main(['dance'])\nexcept SystemExit: pass\n"
    code += "import tqdm; print(tqdm.tqdm([]).mininterval)"
    known = {name: value for name, value in os.environ.items() if not name.startswith("TQDM_")}
    for given, interval in (({}, 10.0), ({"TQDM_MININTERVAL": "3"}, 3.0)):
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=known | given, check=True
        )
        assert float(run.stdout) == interval


def test_a_column_is_told_from_a_path_by_the_file_that_is_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("run_12:30:00.csv", "curve.csv"):
        Path(name).touch()
    for text, found in (
        ("run_12:30:00.csv", ("run_12:30:00.csv", None)),
        ("run_12:30:00.csv:force_N", ("run_12:30:00.csv", "force_N")),
        ("curve.csv:force [N/mm]", ("curve.csv", "force [N/mm]")),
        ("curve.csv:a:b", ("curve.csv", "a:b")),
        ("none.csv:force", ("none.csv", "force")),
        ("C:\\curve.csv", ("C:\\curve.csv", None)),
        ("c" * 5000, ("c" * 5000, None)),
        ("c" * 5000 + ":force", ("c" * 5000, "force")),
    ):
        assert file_and_column(text) == (Path(found[0]), found[1])
