"""Build a small sheet model, film it, track it, and compare with the truth; the results are left in demo/.

A model or a sequence that is already there is used again, unless the study or the scene has changed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from morph_dslam.extend import run_and_report_errors
from support import Recording, keep_model, keep_sequence, report, track_and_evaluate

HERE = Path(__file__).resolve().parent
OUTPUT = HERE.parents[1] / "demo"


def run(_: argparse.Namespace) -> None:
    model, sequence, folder = OUTPUT / "sheet.morph", OUTPUT / "sequence", OUTPUT / "run"
    print("1/3  the model: solve the sheet over its parameters and compress the solutions", flush=True)
    keep_model(HERE / "study.toml", model)
    print("2/3  the sequence: film the model bending both ways", flush=True)
    keep_sequence(HERE / "scene.toml", model, sequence)
    print("3/3  track it and compare with the truth", flush=True)
    recording = Recording(
        sequence / "frames", sequence / "camera.yaml", sequence / "landmarks.csv", sequence / "truth.npz"
    )
    report(track_and_evaluate(recording, model, folder), folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    return run_and_report_errors(run, parser.parse_args(), "what was built and filmed so far is kept")


if __name__ == "__main__":
    sys.exit(main())
