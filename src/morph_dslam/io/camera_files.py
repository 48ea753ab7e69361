"""Camera files: a small YAML of intrinsics, and the calibrations of other programs.

The keys of our own are width, height, fx, fy, cx, cy, optionally distortion ([k1, k2, p1, p2, k3], OpenCV's order),
lens (radial-tangential, or fisheye with k1, k2, k3, k4) and readout_s (seconds, of a rolling shutter). Formats of other
programs are recognised by the keys that only they have, and translated to these; readout_s may be added to them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from pydantic import Field, FiniteFloat, ValidationError

from morph_dslam.camera import Camera, LensModel, StereoCamera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.colmap import read_cameras
from morph_dslam.io.sections import Section, explain
from morph_dslam.io.text import read_text

Mapping = dict[str, Any]
#: No focal length or principal point is meant by what is larger, pixels.
LARGEST_PX = 1e7
#: Image sides of more pixels are refused before memory is asked for them.
LARGEST_SIDE_PX = 65_535
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
_MATRIX_NAMES = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k", "M1")
_DISTORTION_NAMES = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D", "d", "D1")


class _CameraFile(Section):
    width: int = Field(gt=0, le=LARGEST_SIDE_PX)
    height: int = Field(gt=0, le=LARGEST_SIDE_PX)
    fx: float = Field(gt=0, lt=LARGEST_PX)
    fy: float = Field(gt=0, lt=LARGEST_PX)
    cx: float = Field(gt=-LARGEST_PX, lt=LARGEST_PX)
    cy: float = Field(gt=-LARGEST_PX, lt=LARGEST_PX)
    distortion: list[FiniteFloat] = Field(default_factory=list)
    lens: str = "radial-tangential"
    readout_s: FiniteFloat = 0.0


class _Loader(yaml.SafeLoader):
    """A safe loader that reads `!!opencv-matrix` as the mapping it holds."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict:
    assert isinstance(node, yaml.MappingNode)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def load_camera(path: str | Path) -> Camera:
    """Read a camera file, or a calibration by OpenCV, ROS, ORB-SLAM, Kalibr, EuRoC or COLMAP (cameras.txt).

    Parameters
    ----------
    path : the file; in one with several cameras, `file#name` chooses: `camchain.yaml#cam1`, `cameras.txt#2`. A folder
        in EuRoC's layout is its left camera, cam0, which maps of the pair are of

    Raises CameraError if the file is missing or malformed, lacks or misnames a value, has a camera or distortion model
    that is not known, does not say its image size, or holds several cameras of which none is chosen.
    """
    if Path(path).is_dir():
        path = _euroc_base(Path(path)) / "cam0" / "sensor.yaml"
    path, name = _split_name(Path(path))
    where = str(path) if name is None else f"{path}#{name}"
    if path.suffix == ".txt":
        return parse_camera(_choose(read_cameras(path), name, path), where)
    content = _read_yaml(path)
    chain = _camera_chain(content)
    if chain:
        content = _choose(chain, name, path)
    elif name is not None:
        raise CameraError(f"{path} holds one camera only: leave out #{name}")
    return _translated_camera(content, where)


def load_camera_or_pair(path: str | Path) -> Camera | StereoCamera:
    """Read a camera, or a stereo pair.

    A pair is a Kalibr camchain with cam0, to the left, and cam1, or EuRoC's `mav0` folder, or the folder that holds
    it. A camchain of which one camera is chosen, `camchain.yaml#cam0`, is that camera alone.

    Raises CameraError as of `load_camera`, or if a pair's file does not say where the cameras are.
    """
    path = Path(path)
    if path.is_dir():
        return _pair_of_euroc(path)
    if path.is_file() and path.suffix in (".yaml", ".yml"):
        content = _read_yaml(path)
        if isinstance(content, dict) and all(isinstance(content.get(c), dict) for c in ("cam0", "cam1")):
            (left, _), (right, right_from_left) = _cameras_of_kalibr(path, content, 2)
            return StereoCamera(left, right, right_from_left)
    return load_camera(path)


def load_body_from_sensor(path: Path) -> RigidTransform:
    """Where a sensor of a EuRoC recording stands: T_BS of its `sensor.yaml`, metres.

    Raises CameraError if the file is missing or malformed, or does not say it.
    """
    content = _read_yaml(path)
    return _transform(content.get("T_BS") if isinstance(content, dict) else None, f"{path}: T_BS")


def load_rig(path: str | Path) -> list[tuple[Camera, RigidTransform]]:
    """Read all cameras of a Kalibr camchain, cam0 first, each with camera_from_cam0, metres.

    Raises CameraError if the file is missing or malformed, has fewer than two cameras, or does not say where one is.
    """
    chain = _read_yaml(Path(path))
    chain = chain if isinstance(chain, dict) else {}
    count = sum(str(name).startswith("cam") for name in chain)
    if count < 2 or not all(isinstance(chain.get(f"cam{n}"), dict) for n in range(count)):
        raise CameraError(f"{path} is no rig: a Kalibr camchain of several cameras has cam0, cam1 and so on")
    return _cameras_of_kalibr(Path(path), chain, count)


def parse_camera(content: object, where: str) -> Camera:
    """The camera that a mapping with the keys of a camera file describes; errors as of `load_camera`.

    ``where`` is where the mapping was written, and begins the message.
    """
    if not isinstance(content, dict):
        raise CameraError(f"{where} holds no camera: it needs width, height, fx, fy, cx, cy")
    try:
        values = _CameraFile.model_validate(content)
    except ValidationError as error:
        raise CameraError(
            f"{where}: {explain(_CameraFile, error, content)}; a camera file has width, height, fx, fy, cx, cy "
            "and optionally distortion [k1, k2, p1, p2, k3], lens and readout_s"
        ) from error
    intrinsics = (values.width, values.height, values.fx, values.fy, values.cx, values.cy)
    try:
        camera = Camera(*intrinsics, tuple(values.distortion), cast(LensModel, values.lens), values.readout_s)
    except CameraError as error:
        raise CameraError(f"{where}: {error}") from error
    camera.check_focal_length(where)
    return camera


def save_camera(path: str | Path, camera: Camera) -> None:
    """Write a camera file that `load_camera` reads."""
    path = Path(path)
    content = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    content["distortion"] = list(camera.distortion)
    if camera.distortion:
        content["lens"] = camera.lens_model
    if camera.readout_s:
        content["readout_s"] = camera.readout_s
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def save_rig(path: Path, cameras: Sequence[tuple[Camera, RigidTransform]]) -> None:
    """Write the Kalibr camchain of cameras, each with camera_from_cam0, that `load_rig` reads."""
    chain, before = {}, RigidTransform.identity()
    for number, (camera, pose) in enumerate(cameras):
        lens = "equidistant" if camera.lens_model == "fisheye" else "radtan"
        entry = {
            "camera_model": "pinhole",
            "intrinsics": camera.intrinsics.tolist(),
            "distortion_model": lens if camera.distortion else "none",
            "distortion_coeffs": list(camera.distortion),
            "resolution": [camera.width, camera.height],
        }
        if number:
            entry["T_cn_cnm1"] = (pose @ before.inverse).matrix.tolist()
        chain[f"cam{number}"], before = entry, pose
    path.write_text(yaml.safe_dump(chain, sort_keys=False), encoding="utf-8")


def _read_yaml(path: Path) -> object:
    """The content of a YAML file, which may have OpenCV's header `%YAML:1.0` and its matrices.

    Of several documents the first: `rostopic echo` writes the line that begins another one after each message.
    """
    lines = read_text(path, "camera file", CameraError).splitlines()
    if lines and lines[0].lstrip().startswith("<?xml"):
        raise CameraError(
            f"{path} is XML, which is not read as a camera file: save it as YAML, with cv::FileStorage to a name that "
            "ends with .yaml"
        )
    if lines and lines[0].startswith("%YAML:"):
        # YAML writes this directive with a space, and a document that follows one begins with ---.
        lines = lines[1:]
    try:
        return next(yaml.load_all("\n".join(lines), Loader=_Loader), None)
    except yaml.YAMLError as error:
        raise CameraError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from error


def _split_name(path: Path) -> tuple[Path, str | None]:
    """The file and the name of the camera in it, None where none is given."""
    if path.exists() or "#" not in path.name:
        return path, None
    stem, _, name = path.name.rpartition("#")
    return path.with_name(stem), name


def _camera_chain(content: object) -> dict[str, dict]:
    """The cameras of a Kalibr camchain by name, none where the content is another's."""
    entries = content.items() if isinstance(content, dict) else ()
    return {str(name): value for name, value in entries if isinstance(value, dict) and "camera_model" in value}


def _choose(cameras: dict[str, dict], name: str | None, path: Path) -> dict:
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name not in cameras:
        names = ", ".join(cameras)
        raise CameraError(f"{path} holds the cameras {names}: choose one, {path}#{next(iter(cameras))} say")
    return cameras[name]


def _cameras_of_kalibr(path: Path, chain: Mapping, count: int) -> list[tuple[Camera, RigidTransform]]:
    """Cameras of a camchain, each with camera_from_cam0."""
    cameras, pose = [], RigidTransform.identity()
    for number in range(count):
        where, entry = f"{path}#cam{number}", chain[f"cam{number}"]
        if number:
            pose = _transform(entry.get("T_cn_cnm1"), f"{where}: T_cn_cnm1") @ pose
        cameras.append((_translated_camera(entry, where), pose))
    return cameras


def _euroc_base(folder: Path) -> Path:
    """The folder in EuRoC's layout that holds those of the sensors: ``folder``, or `mav0` in it.

    Raises CameraError if there is no cam0 in it.
    """
    base = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if not (base / "cam0").is_dir():
        raise CameraError(
            f"{folder} is a folder, and not in EuRoC's layout, whose camera is in cam0/sensor.yaml: give a camera file"
        )
    return base


def _pair_of_euroc(folder: Path) -> StereoCamera:
    base = _euroc_base(folder)
    if not (base / "cam1" / "sensor.yaml").is_file():
        raise CameraError(
            f"{folder} holds no stereo pair: there is no {base / 'cam1' / 'sensor.yaml'}; for one camera give "
            f"{base / 'cam0' / 'sensor.yaml'}"
        )
    cameras, poses = [], []
    for name in ("cam0", "cam1"):
        file = base / name / "sensor.yaml"
        cameras.append(load_camera(file))
        poses.append(load_body_from_sensor(file))
    return StereoCamera(cameras[0], cameras[1], poses[1].inverse @ poses[0])


def _transform(value: object, what: str) -> RigidTransform:
    """A rigid transform of sixteen numbers, row by row."""
    matrix = np.array(_numbers(value, 16, what)).reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise CameraError(f"{what} holds a value that is not finite")
    u, singular, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(singular - 1.0).max() > 1e-3 or np.linalg.det(u @ vt) < 0.0:
        raise CameraError(f"{what} is not a rotation and a translation")
    return RigidTransform(u @ vt, matrix[:3, 3])


def _translated_camera(content: object, where: str) -> Camera:
    """The camera of a file of our own or of another program; errors as of `load_camera`."""
    translate = _translator_of(content) if isinstance(content, dict) else None
    if translate is not None:
        given = cast(dict, content)
        # Other programs have no key for the readout time: ours may be added to their files.
        content = translate(given, where) | {key: given[key] for key in ("readout_s",) if key in given}
    return parse_camera(content, where)


def _translator_of(content: Mapping) -> Callable[[Mapping, str], Mapping] | None:
    """The translator for a file with these keys, None for a camera file of our own."""
    keys = content.keys()
    if any(str(key).startswith(("Camera.", "Camera1.")) for key in keys):
        return _from_orb_slam
    if "camera_model" in keys or "intrinsics" in keys:
        return _from_kalibr
    if any(name in keys for name in _MATRIX_NAMES):
        return _from_opencv_or_ros
    return None


def _from_opencv_or_ros(content: Mapping, where: str) -> Mapping:
    """OpenCV's calibration YAML and ROS's camera_info, which share their names."""
    if "M2" in content or "K2" in content:
        raise CameraError(
            f"{where} is a stereo calibration without single cameras: give the file of one camera, with "
            "image_width, image_height, camera_matrix and distortion_coefficients"
        )
    matrix = _numbers(_first(content, _MATRIX_NAMES), 9, f"{where}: camera matrix")
    if any(matrix[i] != 0.0 for i in (1, 3, 6, 7)) or matrix[8] != 1.0:
        raise CameraError(f"{where}: the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1]: skew is not modelled")
    values = _first(content, _DISTORTION_NAMES)
    coefficients = [] if values is None else _numbers(values, None, f"{where}: distortion coefficients")
    model = content.get("distortion_model")
    if model is None:
        model = "fisheye" if content.get("fisheye_model") in (1, True) else "plumb_bob"
    width = _first(content, ("image_width", "image_Width", "width"))
    height = _first(content, ("image_height", "image_Height", "height"))
    if content.get("image_size") is not None:
        width, height = _numbers(content["image_size"], 2, f"{where}: image_size")
    _check_size(width, height, where, "image_width: and image_height:")
    intrinsics = {"fx": matrix[0], "fy": matrix[4], "cx": matrix[2], "cy": matrix[5]}
    full = {"width": width, "height": height, **intrinsics}
    return _of_read_out(full, content, where) | _lens_keys(model, coefficients, where)


def _of_read_out(full: Mapping, content: Mapping, where: str) -> Mapping:
    """The intrinsics of the pixels that a camera_info says were read out, from those of the full image.

    ROS keeps size and matrix those of the full resolution where the camera cut its images (``roi``) or merged pixels
    (``binning_x``, ``binning_y``). Binning by 0 is none, and a region of zeros is the full image.
    """
    roi = content.get("roi") or {}
    if not isinstance(roi, dict):
        raise CameraError(f"{where}: roi is not x_offset, y_offset, height and width")
    keys = ("x_offset", "y_offset", "width", "height")
    region = np.array(_numbers([roi.get(key, 0) for key in keys], 4, f"{where}: roi"))
    binning = np.array(_numbers([content.get(f"binning_{axis}", 0) for axis in "xy"], 2, f"{where}: binning"))
    if not region.any() and np.isin(binning, (0.0, 1.0)).all():
        return full
    size = np.array(_numbers([full["width"], full["height"]], 2, f"{where}: image size"))
    offset, kept = (region[:2], region[2:]) if region.any() else (np.zeros(2), size)
    numbers, binning = np.concatenate([region, binning, size]), np.maximum(binning, 1.0)
    are_counts = bool((np.isfinite(numbers) & (numbers >= 0.0) & (numbers == np.floor(numbers))).all())
    if not are_counts or (kept < binning).any() or (offset + kept > size).any():
        given = [", ".join(f"{number:g}" for number in numbers) for numbers in (region, binning)]
        raise CameraError(
            f"{where}: roi with x_offset, y_offset, width, height = {given[0]} and binning {given[1]} leave no whole "
            f"pixels of an image of {size[0]:g}x{size[1]:g}, the full size: correct them, or take them out of the file "
            "for full images"
        )
    (width, height), focal = kept // binning, np.array([full["fx"], full["fy"]]) / binning
    # The centre of the first merged pixel is in the middle of those it was merged from.
    centre = (np.array([full["cx"], full["cy"]]) - offset + 0.5) / binning - 0.5
    values = (int(width), int(height), *focal.tolist(), *centre.tolist())
    return dict(zip(("width", "height", "fx", "fy", "cx", "cy"), values, strict=True))


def _from_orb_slam(content: Mapping, where: str) -> Mapping:
    """The settings files of ORB-SLAM: `Camera.fx` in versions 1 and 2, `Camera1.fx` in version 3."""
    prefix = "Camera1" if "Camera1.fx" in content else "Camera"
    if f"{prefix}.fx" not in content:
        raise CameraError(f"{where}: {prefix}.fx is missing")
    width, height = (_first(content, (f"Camera.{name}", f"{prefix}.{name}")) for name in ("width", "height"))
    _check_size(width, height, where, "Camera.width: and Camera.height:")
    kind = str(content.get("Camera.type", "PinHole"))
    kinds = {"PinHole": "plumb_bob", "Pinhole": "plumb_bob", "Rectified": "none", "KannalaBrandt8": "fisheye"}
    if kind not in kinds:
        raise CameraError(f"{where}: unknown Camera.type '{kind}'; known are {', '.join(kinds)}")
    names = ("k1", "k2", "k3", "k4") if kind == "KannalaBrandt8" else ("k1", "k2", "p1", "p2", "k3")
    given = [content.get(f"{prefix}.{name}", 0.0) for name in names]
    coefficients = [] if kind == "Rectified" else _numbers(given, len(names), f"{where}: {prefix}.k1 ...")
    values = {name: content.get(f"{prefix}.{name}") for name in ("fx", "fy", "cx", "cy")}
    values = {name: value for name, value in values.items() if value is not None}
    return {"width": width, "height": height, **values, **_lens_keys(kinds[kind], coefficients, where)}


def _from_kalibr(content: Mapping, where: str) -> Mapping:
    """One camera of a Kalibr camchain, or a EuRoC sensor.yaml, which has the same entries."""
    model = content.get("camera_model")
    if model != "pinhole":
        raise CameraError(f"{where}: unknown camera model '{model}'; calibrate with pinhole-radtan or pinhole-equi")
    fx, fy, cx, cy = _numbers(content.get("intrinsics"), 4, f"{where}: intrinsics")
    width, height = _numbers(content.get("resolution"), 2, f"{where}: resolution")
    values = _first(content, ("distortion_coeffs", "distortion_coefficients"))
    coefficients = [] if values is None else _numbers(values, None, f"{where}: distortion coefficients")
    lens = _lens_keys(content.get("distortion_model"), coefficients, where)
    return {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **lens}


def _check_size(width: object, height: object, where: str, lines: str) -> None:
    if width is None or height is None:
        raise CameraError(f"{where} does not say for what image size it is: add the lines {lines}")


def _numbers(value: object, count: int | None, what: str) -> list[float]:
    """A list of numbers, given as one, as rows, or as a matrix mapping with ``data``; CameraError if it is none."""
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


def _first(content: Mapping, names: tuple[str, ...]) -> Any:
    return next((content[name] for name in names if name in content), None)


def _lens_keys(model: object, coefficients: list[float], what: str) -> Mapping:
    """The keys of a camera file for a named distortion model; raises CameraError if it is unknown."""
    name = str(model if model is not None else "").lower()
    if name not in DISTORTION_MODELS:
        known = ", ".join(key for key in DISTORTION_MODELS if key)
        raise CameraError(f"{what}: unknown distortion model '{model}'; known are {known}: calibrate with one")
    lens = DISTORTION_MODELS[name]
    if lens is None and any(coefficients):
        raise CameraError(f"{what}: distortion coefficients are given, but no distortion model")
    if lens is None or (lens == "radial-tangential" and not any(coefficients)):
        return {}
    if lens == "radial-tangential":
        # Lists padded with zeros: the shortest form that OpenCV knows.
        counts = (count for count in (4, 5, 8) if len(coefficients) >= count and not any(coefficients[count:]))
        coefficients = coefficients[: next(counts, None)]
    return {"lens": lens, "distortion": coefficients}
