"""Camera files: a small YAML of intrinsics, and the calibrations of other programs.

width: 640
height: 480
fx: 528.0
fy: 528.0
cx: 320.0
cy: 240.0
distortion: [k1, k2, p1, p2, k3]   # optional, OpenCV's order
lens: radial-tangential            # optional; fisheye for OpenCV's fisheye, with k1, k2, k3, k4
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import yaml
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import CameraError
from morph_dslam.io.camera_formats import translator_of
from morph_dslam.io.colmap import read_cameras
from morph_dslam.io.opencv_yaml import read_opencv_yaml
from morph_dslam.lens import LensModel

#: No focal length or principal point is meant by what is larger, pixels.
LARGEST_PX = 1e7
#: Image sides of more pixels are refused before memory is asked for them.
LARGEST_SIDE_PX = 65_535


class _CameraFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    width: int = Field(gt=0, le=LARGEST_SIDE_PX)
    height: int = Field(gt=0, le=LARGEST_SIDE_PX)
    fx: float = Field(gt=0, lt=LARGEST_PX)
    fy: float = Field(gt=0, lt=LARGEST_PX)
    cx: float = Field(gt=-LARGEST_PX, lt=LARGEST_PX)
    cy: float = Field(gt=-LARGEST_PX, lt=LARGEST_PX)
    distortion: list[FiniteFloat] = []
    lens: str = "radial-tangential"


def load_camera(path: Path) -> PinholeCamera:
    """Read a camera file, or a calibration by OpenCV, ROS, ORB-SLAM, Kalibr, EuRoC or COLMAP (cameras.txt).

    Parameters
    ----------
    path : the file. In one with several cameras, `file#name` chooses: `camchain.yaml#cam1`, `cameras.txt#2`.

    Raises
    ------
    CameraError
        If the file is missing or malformed, lacks or misnames a value, has a camera or distortion model that
        is not known, does not say its image size, or holds several cameras of which none is chosen.
    """
    path, name = _split_name(Path(path))
    where = str(path) if name is None else f"{path}#{name}"
    if path.suffix == ".txt":
        return parse_camera(_choose(read_cameras(path), name, path), where)
    content = read_opencv_yaml(path)
    chain = _camera_chain(content)
    if chain:
        content = _choose(chain, name, path)
    elif name is not None:
        raise CameraError(f"{path} holds one camera only: leave out #{name}")
    translate = translator_of(content) if isinstance(content, dict) else None
    return parse_camera(content if translate is None else translate(cast(dict, content), where), where)


def _split_name(path: Path) -> tuple[Path, str | None]:
    """The file and the name of the camera in it, None where none is given."""
    if path.exists() or "#" not in path.name:
        return path, None
    stem, _, name = path.name.rpartition("#")
    return path.with_name(stem), name


def _camera_chain(content: object) -> dict[str, dict]:
    """The cameras of a Kalibr camchain by name, none where the content is another's."""
    entries = content.items() if isinstance(content, dict) else ()
    return {
        str(name): value for name, value in entries if isinstance(value, dict) and "camera_model" in value
    }


def _choose(cameras: dict[str, dict], name: str | None, path: Path) -> dict:
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name not in cameras:
        names = ", ".join(cameras)
        raise CameraError(f"{path} holds the cameras {names}: choose one, {path}#{next(iter(cameras))} say")
    return cameras[name]


def parse_camera(content: object, where: str) -> PinholeCamera:
    """The camera that a mapping with the keys of a camera file describes; errors as of `load_camera`.

    ``where`` is where the mapping was written, and begins the message.
    """
    if not isinstance(content, dict):
        raise CameraError(f"{where} holds no camera: it needs width, height, fx, fy, cx, cy")
    try:
        values = _CameraFile.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise CameraError(
            f"{where}: {name}: {first['msg']}; a camera file has width, height, fx, fy, cx, cy "
            "and optionally distortion [k1, k2, p1, p2, k3] and lens"
        ) from error
    intrinsics = (values.width, values.height, values.fx, values.fy, values.cx, values.cy)
    try:
        return PinholeCamera(*intrinsics, tuple(values.distortion), cast(LensModel, values.lens))
    except CameraError as error:
        raise CameraError(f"{where}: {error}") from error


def save_camera(path: Path, camera: PinholeCamera) -> None:
    """Write a camera file that `load_camera` reads."""
    content = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    content["distortion"] = list(camera.distortion)
    if camera.distortion:
        content["lens"] = camera.lens_model
    path.write_text(yaml.safe_dump(content, sort_keys=False))
