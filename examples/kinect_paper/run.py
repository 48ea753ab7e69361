"""Track a real recording of a sheet of paper bent by two hands, and compare it with depth measurements.

The recording (Varol, Salzmann, Fua and Urtasun, CVPR 2012) is not part of the project: a folder with the
images `rgb/001.jpg` to `rgb/100.jpg` and the measured points `ground_truth.npz` (docs/evaluation.md). The
sheet's model is built once, from study.toml, and kept in output/. A recording of the same layout may bring
its own camera.yaml and landmarks.csv.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from morph_dslam.extend import frame_range, run_and_report_errors
from support import Recording, check_recording, data_folder, keep_model, report, track_and_evaluate

HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"
#: The frame in which landmarks.csv was annotated; the sheet is nearly flat there.
REFERENCE_FRAME = 9


def own_or_example(data: Path, name: str) -> Path:
    """The recording's own file, or else the example's."""
    return data / name if (data / name).is_file() else HERE / name


def run(arguments: argparse.Namespace) -> None:
    model, folder = OUTPUT / "sheet.morph", OUTPUT / "run"
    recording = Recording(
        frames=arguments.data / "rgb",
        camera=own_or_example(arguments.data, "camera.yaml"),
        landmarks=own_or_example(arguments.data, "landmarks.csv"),
        truth=arguments.data / "ground_truth.npz",
        range=arguments.frames,
        reference_frame=REFERENCE_FRAME,
        refine_reference=True,
        use_outline=True,
        use_discrepancy=True,
    )
    check_recording(recording)
    keep_model(HERE / "study.toml", model)
    report(track_and_evaluate(recording, model, folder), folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=data_folder("kinect_paper"), help="folder of the recording (%(default)s)"
    )
    parser.add_argument("--frames", type=frame_range, default=(9, 100), help="frames to track (9-100)")
    return run_and_report_errors(run, parser.parse_args(), "what was built and tracked so far is kept")


if __name__ == "__main__":
    sys.exit(main())
