"""Camera calibrations of other programs, translated to the keys of this project's camera files.

Each format is recognised by the keys that only it has. What a translator returns is checked by
`morph_dslam.io.calibration.parse_camera` like a camera file of our own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from morph_dslam.errors import CameraError

Mapping = dict[str, Any]

#: Names of distortion models in ROS, Kalibr and EuRoC files. A name with None stands for no distortion.
DISTORTION_MODELS = {
    "plumb_bob": "radial-tangential",
    "rational_polynomial": "radial-tangential",
    "radial-tangential": "radial-tangential",
    "radtan": "radial-tangential",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
    "none": None,
    "": None,
}


def numbers(value: object, count: int | None, what: str) -> list[float]:
    """A list of numbers, given as one, as rows, or as a matrix mapping with ``data``.

    Raises
    ------
    CameraError
        If it is none of these, or has another ``count``.
    """
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        value = [number for row in value for number in row]
    try:
        # YAML 1.1 takes 1e-05 for a text, because it has no point.
        values = [float(number) for number in value]  # type: ignore[union-attr]
    except (TypeError, ValueError):
        raise CameraError(f"{what} is not a list of numbers") from None
    if count is not None and len(values) != count:
        raise CameraError(f"{what} has {len(values)} values, not {count}")
    return values


def lens_keys(model: object, coefficients: list[float], what: str) -> Mapping:
    """The keys of a camera file for a named distortion model; raises CameraError if it is unknown."""
    name = str(model if model is not None else "").lower()
    if name not in DISTORTION_MODELS:
        known = ", ".join(key for key in DISTORTION_MODELS if key)
        raise CameraError(
            f"{what}: unknown distortion model '{model}'; known are {known}: calibrate with one"
        )
    lens = DISTORTION_MODELS[name]
    if lens is None and any(coefficients):
        raise CameraError(f"{what}: distortion coefficients are given, but no distortion model")
    if lens is None or (lens == "radial-tangential" and not any(coefficients)):
        return {}
    if lens == "radial-tangential":
        coefficients = _without_zero_tail(coefficients)
    return {"lens": lens, "distortion": coefficients}


def _without_zero_tail(coefficients: list[float]) -> list[float]:
    """The shortest form that OpenCV knows, 4, 5 or 8 coefficients, of a list padded with zeros."""
    for count in (4, 5, 8):
        if len(coefficients) >= count and not any(coefficients[count:]):
            return coefficients[:count]
    return coefficients


def _from_matrix(matrix: list[float], where: str) -> Mapping:
    """fx, fy, cx, cy of a row-major intrinsic matrix of nine numbers."""
    if any(matrix[i] != 0.0 for i in (1, 3, 6, 7)) or matrix[8] != 1.0:
        raise CameraError(
            f"{where}: the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1]: skew is not modelled"
        )
    return {"fx": matrix[0], "fy": matrix[4], "cx": matrix[2], "cy": matrix[5]}


def _first(content: Mapping, names: tuple[str, ...]) -> Any:
    return next((content[name] for name in names if name in content), None)


_MATRIX_NAMES = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k", "M1")
_DISTORTION_NAMES = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distCoeffs",
    "dist_coeffs",
    "D",
    "d",
    "D1",
)


def _size(content: Mapping, where: str) -> Mapping:
    width = _first(content, ("image_width", "image_Width", "width"))
    height = _first(content, ("image_height", "image_Height", "height"))
    size = content.get("image_size")
    if size is not None:
        width, height = numbers(size, 2, f"{where}: image_size")
    if width is None or height is None:
        raise CameraError(
            f"{where} does not say for what image size it is: add the lines image_width: and image_height:"
        )
    return {"width": width, "height": height}


def from_opencv_or_ros(content: Mapping, where: str) -> Mapping:
    """OpenCV's calibration YAML and ROS's camera_info, which share their names."""
    if "M2" in content or "K2" in content:
        raise CameraError(
            f"{where} is a stereo calibration without single cameras: give the file of one camera, with "
            "image_width, image_height, camera_matrix and distortion_coefficients"
        )
    matrix = numbers(_first(content, _MATRIX_NAMES), 9, f"{where}: camera matrix")
    values = _first(content, _DISTORTION_NAMES)
    coefficients = [] if values is None else numbers(values, None, f"{where}: distortion coefficients")
    model = content.get("distortion_model")
    if model is None:
        model = "fisheye" if content.get("fisheye_model") in (1, True) else "plumb_bob"
    return {
        **_size(content, where),
        **_from_matrix(matrix, where),
        **lens_keys(model, coefficients, where),
    }


def from_orb_slam(content: Mapping, where: str) -> Mapping:
    """The settings files of ORB-SLAM: `Camera.fx` in versions 1 and 2, `Camera1.fx` in version 3."""
    prefix = "Camera1" if "Camera1.fx" in content else "Camera"
    if f"{prefix}.fx" not in content:
        raise CameraError(f"{where}: {prefix}.fx is missing")
    size = [_first(content, (f"Camera.{name}", f"{prefix}.{name}")) for name in ("width", "height")]
    if None in size:
        raise CameraError(
            f"{where} does not say for what image size it is: add the lines Camera.width: and Camera.height:"
        )
    kind = str(content.get("Camera.type", "PinHole"))
    kinds = {"PinHole": "plumb_bob", "Pinhole": "plumb_bob", "Rectified": "none", "KannalaBrandt8": "fisheye"}
    if kind not in kinds:
        raise CameraError(f"{where}: unknown Camera.type '{kind}'; known are {', '.join(kinds)}")
    names = ("k1", "k2", "k3", "k4") if kind == "KannalaBrandt8" else ("k1", "k2", "p1", "p2", "k3")
    given = [content.get(f"{prefix}.{name}", 0.0) for name in names]
    coefficients = [] if kind == "Rectified" else numbers(given, len(names), f"{where}: {prefix}.k1 ...")
    values = {name: content.get(f"{prefix}.{name}") for name in ("fx", "fy", "cx", "cy")}
    values = {name: value for name, value in values.items() if value is not None}
    return {"width": size[0], "height": size[1], **values, **lens_keys(kinds[kind], coefficients, where)}


def from_kalibr(content: Mapping, where: str) -> Mapping:
    """One camera of a Kalibr camchain, or a EuRoC sensor.yaml, which has the same entries."""
    model = content.get("camera_model")
    if model != "pinhole":
        raise CameraError(
            f"{where}: unknown camera model '{model}'; calibrate with pinhole-radtan or pinhole-equi"
        )
    fx, fy, cx, cy = numbers(content.get("intrinsics"), 4, f"{where}: intrinsics")
    width, height = numbers(content.get("resolution"), 2, f"{where}: resolution")
    values = _first(content, ("distortion_coeffs", "distortion_coefficients"))
    coefficients = [] if values is None else numbers(values, None, f"{where}: distortion coefficients")
    lens = lens_keys(content.get("distortion_model"), coefficients, where)
    return {"width": int(width), "height": int(height), "fx": fx, "fy": fy, "cx": cx, "cy": cy, **lens}


def translator_of(content: Mapping) -> Callable[[Mapping, str], Mapping] | None:
    """The translator for a file with these keys, None for a camera file of our own."""
    keys = content.keys()
    if any(str(key).startswith(("Camera.", "Camera1.")) for key in keys):
        return from_orb_slam
    if "camera_model" in keys or "intrinsics" in keys:
        return from_kalibr
    if any(name in keys for name in _MATRIX_NAMES):
        return from_opencv_or_ros
    return None
