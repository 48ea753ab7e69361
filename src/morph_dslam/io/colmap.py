"""COLMAP's text model: its cameras. (Its images, as a trajectory, are read by `io.trajectory`.)"""

from __future__ import annotations

from pathlib import Path

from morph_dslam.errors import CameraError

#: Where each of COLMAP's models keeps its values; fx and fy are one value in those that begin with f.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}

#: COLMAP puts pixel (0, 0) at the corner of the first pixel, we put it at its centre.
PIXEL_CENTRE = 0.5


def read_cameras(path: Path) -> dict[str, dict]:
    """The cameras of a cameras.txt by their ids, as the keys of our camera files.

    Raises
    ------
    CameraError
        If the file cannot be read, has no camera, or one of an unknown model or with wrong values.
    """
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise CameraError(f"cannot read the camera file {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CameraError(f"{path} is not a text file: save the COLMAP model as text") from error
    cameras = {}
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.startswith("#"):
            words = line.split()
            cameras[words[0]] = _camera(words, f"{path}, line {number}")
    if not cameras:
        raise CameraError(f"{path} holds no camera: a line is ID MODEL WIDTH HEIGHT PARAMETERS")
    return cameras


def _camera(words: list[str], where: str) -> dict:
    if len(words) < 4:
        raise CameraError(f"{where}: a camera is ID MODEL WIDTH HEIGHT PARAMETERS")
    model = words[1]
    if model not in MODELS:
        raise CameraError(f"{where}: unknown camera model '{model}'; known are {', '.join(MODELS)}")
    names = MODELS[model]
    try:
        width, height = int(words[2]), int(words[3])
        values = dict(zip(names, [float(word) for word in words[4:]], strict=True))
    except ValueError as error:
        raise CameraError(
            f"{where}: {model} has width, height, then {', '.join(names)}, all numbers"
        ) from error
    focal = values.get("f")
    camera = {
        "width": width,
        "height": height,
        "fx": focal if focal is not None else values["fx"],
        "fy": focal if focal is not None else values["fy"],
        "cx": values["cx"] - PIXEL_CENTRE,
        "cy": values["cy"] - PIXEL_CENTRE,
    }
    return camera | _lens(model, values)


def _lens(model: str, values: dict[str, float]) -> dict:
    if model.endswith("FISHEYE"):
        return {"lens": "fisheye", "distortion": [values.get(f"k{i}", 0.0) for i in range(1, 5)]}
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = [values.get(name, 0.0) for name in order]
    if not any(coefficients):
        return {}
    return {"distortion": coefficients if model == "FULL_OPENCV" else coefficients[:4]}
