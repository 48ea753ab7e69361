"""Calibrations of stereo pairs: Kalibr camchains, and EuRoC's folders of two cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.calibration import load_camera, parse_camera
from morph_dslam.io.camera_formats import from_kalibr, numbers
from morph_dslam.io.opencv_yaml import read_opencv_yaml
from morph_dslam.stereo import StereoCamera

Array = NDArray[np.float64]


def load_stereo(path: Path) -> StereoCamera:
    """Read a stereo pair, cam0 to the left.

    Parameters
    ----------
    path : a Kalibr camchain with cam0 and cam1, or EuRoC's `mav0` folder, or the folder that holds it.

    Raises
    ------
    CameraError
        If a file is missing or malformed, or does not say where the cameras are.
    """
    path = Path(path)
    return _from_euroc(path) if path.is_dir() else _from_kalibr(path)


def load_camera_or_pair(path: Path) -> PinholeCamera | StereoCamera:
    """Read what `load_stereo` reads as a pair, anything else as `load_camera` does.

    A camchain of which one camera is chosen, `camchain.yaml#cam0`, is that camera alone.

    Raises
    ------
    CameraError
        As both do.
    """
    path = Path(path)
    if path.is_dir():
        return _from_euroc(path)
    if path.is_file() and path.suffix in (".yaml", ".yml"):
        content = read_opencv_yaml(path)
        if isinstance(content, dict) and all(isinstance(content.get(c), dict) for c in ("cam0", "cam1")):
            return _from_kalibr(path)
    return load_camera(path)


def load_rig(path: Path) -> list[tuple[PinholeCamera, RigidTransform]]:
    """Read all cameras of a Kalibr camchain, cam0 first, each with camera_from_cam0, metres.

    Raises
    ------
    CameraError
        If the file is missing or malformed, has fewer than two cameras, or does not say where one is.
    """
    chain = read_opencv_yaml(Path(path))
    chain = chain if isinstance(chain, dict) else {}
    count = sum(str(name).startswith("cam") for name in chain)
    if count < 2 or not all(isinstance(chain.get(f"cam{n}"), dict) for n in range(count)):
        raise CameraError(f"{path} is no rig: a Kalibr camchain of several cameras has cam0, cam1 and so on")
    cameras, pose = [], RigidTransform.identity()
    for number in range(count):
        what, entry = f"{path}#cam{number}", chain[f"cam{number}"]
        if number:
            pose = _transform(entry.get("T_cn_cnm1"), f"{what}: T_cn_cnm1") @ pose
        cameras.append((parse_camera(from_kalibr(entry, what), what), pose))
    return cameras


def _from_kalibr(path: Path) -> StereoCamera:
    chain = read_opencv_yaml(path)
    if not isinstance(chain, dict) or not all(isinstance(chain.get(c), dict) for c in ("cam0", "cam1")):
        raise CameraError(f"{path} holds no stereo pair: a Kalibr camchain has cam0 and cam1")
    left, right = (
        parse_camera(from_kalibr(chain[c], f"{path}#{c}"), f"{path}#{c}") for c in ("cam0", "cam1")
    )
    pose = _transform(chain["cam1"].get("T_cn_cnm1"), f"{path}#cam1: T_cn_cnm1")
    return StereoCamera(left, right, pose)


def _from_euroc(folder: Path) -> StereoCamera:
    base = folder / "mav0" if (folder / "mav0").is_dir() else folder
    cameras, poses = [], []
    for name in ("cam0", "cam1"):
        file = base / name / "sensor.yaml"
        content = read_opencv_yaml(file)
        if not isinstance(content, dict):
            raise CameraError(f"{file} holds no camera")
        cameras.append(parse_camera(from_kalibr(content, str(file)), str(file)))
        poses.append(_transform(content.get("T_BS"), f"{file}: T_BS"))
    return StereoCamera(cameras[0], cameras[1], poses[1].inverse @ poses[0])


def _transform(value: object, what: str) -> RigidTransform:
    """A rigid transform of sixteen numbers, row by row."""
    matrix = np.array(numbers(value, 16, what)).reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise CameraError(f"{what} holds a value that is not finite")
    u, singular, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(singular - 1.0).max() > 1e-3 or np.linalg.det(u @ vt) < 0.0:
        raise CameraError(f"{what} is not a rotation and a translation")
    return RigidTransform(u @ vt, matrix[:3, 3])
