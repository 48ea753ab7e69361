"""Saving a map of the rigid scene, and loading it for another run with the same camera."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import MapError
from morph_dslam.online.slam.rigid_map import POINT_ARRAYS, Keyframe, RigidMap

FORMAT, VERSION = "morph-dslam map", 2

KEYFRAME_ARRAYS = (
    "flat",
    "camera_from_world",
    "point_ids",
    "pixels",
    "right",
    "described_ids",
    "descriptors",
)


def save_map(path: Path, rigid_map: RigidMap, camera: PinholeCamera) -> None:
    """Write points, keyframes with their flattened images, and the camera that they are of, as HDF5."""
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "usual_rms_px": rigid_map.usual_rms_px})
        file.attrs["baseline_px"] = rigid_map.baseline_px
        file.attrs.update({"intrinsics": camera.intrinsics, "size": (camera.width, camera.height)})
        kept = rigid_map.kept_keyframes
        # Keyframes that were taken out are left out; points that were refer to nothing.
        renumbered = np.zeros(len(rigid_map.keyframes), dtype=np.int64)
        renumbered[kept] = np.arange(len(kept))
        for name in POINT_ARRAYS:
            array = getattr(rigid_map, name)
            file[f"points/{name}"] = renumbered[array] if name.endswith("keyframe") else array
        for number, keyframe in enumerate(rigid_map.keyframes[k] for k in kept):
            group = file.create_group(f"keyframes/{number:06d}")
            group.attrs.update({"index": keyframe.index, "timestamp": keyframe.timestamp})
            for name in KEYFRAME_ARRAYS:
                packed = {"compression": "gzip", "compression_opts": 1} if name == "flat" else {}
                group.create_dataset(name, data=getattr(keyframe, name), **packed)


def load_map(path: Path, camera: PinholeCamera) -> RigidMap:
    """Read a map.

    Raises
    ------
    MapError
        If it is missing, damaged, empty, of another version, or of a camera with other intrinsics.
    """
    if not path.is_file():
        raise MapError(f"there is no map {path}")
    try:
        with h5py.File(path, "r") as file:
            return _read(path, file, camera)
    except (OSError, KeyError) as error:
        raise MapError(f"{path} is no map of `morph slam`, or damaged: {error}") from error


def _read(path: Path, file: h5py.File, camera: PinholeCamera) -> RigidMap:
    if file.attrs.get("format") != FORMAT:
        raise MapError(f"{path} is no map of `morph slam`; give the map.h5 of a run folder")
    if file.attrs["version"] != VERSION:
        raise MapError(f"{path} has version {file.attrs['version']}; this release reads {VERSION}: map again")
    intrinsics, size = np.asarray(file.attrs["intrinsics"]), tuple(np.asarray(file.attrs["size"]).tolist())
    if size != (camera.width, camera.height) or not np.allclose(intrinsics, camera.intrinsics, rtol=1e-6):
        raise MapError(
            f"{path} was made with fx, fy, cx, cy = {', '.join(f'{x:.2f}' for x in intrinsics)} at "
            f"{size[0]}x{size[1]} pixels: use the camera file it was made with"
        )
    keyframes = file.get("keyframes")
    if not isinstance(keyframes, h5py.Group):
        raise MapError(f"{path} is empty: the run that wrote it never began a map")
    rigid_map = RigidMap(float(np.asarray(file.attrs["baseline_px"])))
    rigid_map.usual_rms_px = float(np.asarray(file.attrs["usual_rms_px"]))
    for name in POINT_ARRAYS:
        setattr(rigid_map, name, np.asarray(file[f"points/{name}"]))
    rigid_map.merged_into = np.arange(len(rigid_map.state))
    for name in keyframes:
        arrays = [np.asarray(keyframes[f"{name}/{array}"]) for array in KEYFRAME_ARRAYS]
        index, timestamp = (np.asarray(keyframes[name].attrs[key]).item() for key in ("index", "timestamp"))
        rigid_map.keyframes.append(Keyframe(index, timestamp, *arrays))
    return rigid_map
