"""The studio's pictures of the pages, made anew where its pages have changed: `make docs` calls this.

A browser goes through all steps as the tests do. Without Chromium, or where the pages are those of the pictures
(their checksum is in `images/studio_pages.txt`), nothing is done. `--anew` makes them all the same.
"""

import hashlib
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT))

from tests.support.chromium import find_chromium  # noqa: E402
from tests.support.studio_walk import walk  # noqa: E402

IMAGES = PROJECT / "docs/images"
STAMP = IMAGES / "studio_pages.txt"
#: Pictures of steps, by their names in the walk.
PICTURES = {"5_start": "studio_start.jpg", "2_study": "studio_study.jpg", "6_track": "studio_track.jpg"}
#: A picture of which less than this share of pixels has changed, by so many levels, stays: clocks show other times.
CHANGED, LEVELS = 0.002, 40


def checksum() -> str:
    """Of what the pictures show: the pages, and the way through them."""
    pages = sorted((PROJECT / "src/morph_dslam/studio/static").iterdir())
    found = hashlib.sha256()
    for path in (*pages, PROJECT / "tests/support/studio_walk.py", PROJECT / "tests/support/studio.py"):
        found.update(path.read_bytes())
    return found.hexdigest()


def differs(new: np.ndarray, path: Path) -> bool:
    """Whether a picture shows something else than the file."""
    old = cv2.imread(str(path)) if path.is_file() else None
    if old is None or old.shape != new.shape:
        return True
    return (cv2.absdiff(old, new).max(axis=2) > LEVELS).mean() > CHANGED


def main() -> None:
    """Make the pictures anew where that is needed and possible."""
    wanted = checksum()
    if STAMP.is_file() and STAMP.read_text().strip() == wanted and "--anew" not in sys.argv:
        return
    if find_chromium() is None:
        print("the studio's pictures stay as they are: Chromium, which draws them, is not installed")
        return
    print("the studio's pages have changed: a browser goes through them for their pictures (a minute or two)")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        problems, _ = walk(folder, folder)
        if problems:
            raise SystemExit(f"the studio's page complains: {problems}")
        for shot, picture in PICTURES.items():
            new = cv2.imread(str(folder / f"{shot}.png"))
            if differs(new, IMAGES / picture):
                cv2.imwrite(str(IMAGES / picture), new, [cv2.IMWRITE_JPEG_QUALITY, 90])
                print(f"wrote docs/images/{picture}")
    STAMP.write_text(f"{wanted}\n")


if __name__ == "__main__":
    main()
