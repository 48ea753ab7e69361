"""The evaluation command: what it writes, and the line it ends with."""

import json
import re

import numpy as np
import pytest

from morph_dslam.cli.app import main
from tests.support.run_folders import exact_truth, write_run


@pytest.fixture
def run_and_truth(tmp_path):
    run = tmp_path / "run"
    model = write_run(run, ["tracked", "tracked", "lost", "tracked", "tracked", "tracked"])
    truth = exact_truth(model)
    truth["points_mm"] = truth["points_mm"] + np.array([0.0, 3.0, 4.0])
    np.savez(tmp_path / "truth.npz", **truth)
    flags = {"flags": ["the object may be <outside> the model"], "n_recovered": 3, "versions": {"numpy": "9.9"}}
    (run / "summary.json").write_text(json.dumps(flags))
    return run, tmp_path / "truth.npz"


def test_evaluate_writes_figures_pictures_and_report_and_ends_with_the_result(run_and_truth, capsys):
    run, truth = run_and_truth
    assert main(["evaluate", str(run), "--points", str(truth), "--bind-frame", "10"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == ("mean_mm=5.000 median_mm=5.000 p95_mm=5.000 tracked=5/6 median_ms=9.00 p95_ms=9.00")
    assert any("not tracked" in line and "[12]" in line for line in lines)
    figures = json.loads((run / "evaluation.json").read_text())
    assert figures["mean_mm"] == pytest.approx(5.0, abs=1e-3)
    assert figures["truth_frames_not_tracked"] == [12]
    for name in ("evaluation.png", "error_map.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    page = (run / "report.html").read_text()
    assert "5.000 mm" in page
    assert "too few points" in page
    assert '<p class="warning">the object may be &lt;outside&gt; the model</p>' in page
    assert "<tr><td>n recovered</td><td>3</td></tr>" in page
    assert page.index("n recovered") < page.index("9.9")
    assert page.count("data:image/png;base64,") == 2
    assert not re.search(r'(src|href)="(http|/)', page)  # self-contained


@pytest.mark.parametrize(
    ("frame", "message"), [("12", "frame 12 was not tracked (too few points)"), ("77", "the truth has no frame 77")]
)
def test_a_frame_that_cannot_bind_is_one_message(run_and_truth, capsys, frame, message):
    run, truth = run_and_truth
    assert main(["evaluate", str(run), "--points", str(truth), "--bind-frame", frame]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert not (run / "evaluation.json").exists()
