"""Camera files: a small YAML of intrinsics.

width: 640
height: 480
fx: 528.0
fy: 528.0
cx: 320.0
cy: 240.0
distortion: [k1, k2, p1, p2, k3]   # optional, OpenCV's order
"""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import CameraError


class _CameraFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0, allow_inf_nan=False)
    fy: float = Field(gt=0, allow_inf_nan=False)
    cx: float = Field(allow_inf_nan=False)
    cy: float = Field(allow_inf_nan=False)
    distortion: list[FiniteFloat] = []


def load_camera(path: Path) -> PinholeCamera:
    """Read a camera file.

    Raises
    ------
    CameraError
        If the file is missing, is not YAML, or lacks or misnames a value.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise CameraError(f"cannot read the camera file {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CameraError(f"{path} is not a YAML file: {error}") from error
    return parse_camera(content, str(path))


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
            "and optionally distortion [k1, k2, p1, p2, k3]"
        ) from error
    if len(values.distortion) not in (0, 4, 5):
        raise CameraError(f"{where}: distortion has {len(values.distortion)} values; give 4 or 5, or none")
    return PinholeCamera(
        values.width, values.height, values.fx, values.fy, values.cx, values.cy, tuple(values.distortion)
    )


def save_camera(path: Path, camera: PinholeCamera) -> None:
    """Write a camera file that `load_camera` reads."""
    content = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    content["distortion"] = list(camera.distortion)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
