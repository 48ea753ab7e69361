"""Build a small sheet model, film it, track it, and compare with the truth; the results are left in demo/.

It starts from landmarks that are off by half a pixel, as careful clicks are, and corrects them by the sheet's outline.
A model or a sequence that is already there is used again, unless the study or the scene has changed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from morph_dslam.extend import run_and_report_errors
from support import Recording, clicked, keep_model, keep_sequence, report, track_and_evaluate

HERE = Path(__file__).resolve().parent
OUTPUT = HERE.parents[1] / "demo"
#: Standard deviation of a landmark's pixel coordinates, as of careful clicks.
CLICK_PX = 0.5


def run(_: argparse.Namespace) -> None:
    model, sequence, folder = OUTPUT / "sheet.morph", OUTPUT / "sequence", OUTPUT / "run"
    print("1/3  the model: solve the sheet over its parameters and compress the solutions", flush=True)
    keep_model(HERE / "study.toml", model)
    print("2/3  the sequence: film the model bending both ways", flush=True)
    keep_sequence(HERE / "scene.toml", model, sequence)
    print("3/3  track it and compare with the truth", flush=True)
    landmarks = clicked(sequence / "landmarks.csv", OUTPUT / "clicked.csv", CLICK_PX)
    recording = Recording(sequence / "frames", sequence / "camera.yaml", landmarks, sequence / "truth.npz", snap=True)
    report(track_and_evaluate(recording, model, folder), folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    return run_and_report_errors(run, parser.parse_args(), "what was built and filmed so far is kept")


if __name__ == "__main__":
    sys.exit(main())
