"""YAML files that users bring, OpenCV's dialect included."""

from __future__ import annotations

from pathlib import Path

import yaml

from morph_dslam.errors import CameraError


class _Loader(yaml.SafeLoader):
    """A safe loader that reads `!!opencv-matrix` as the mapping it holds."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict:
    assert isinstance(node, yaml.MappingNode)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def read_opencv_yaml(path: Path) -> object:
    """The content of a YAML file, which may have OpenCV's header `%YAML:1.0` and its matrices.

    Raises
    ------
    CameraError
        If the file cannot be read or is not YAML.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise CameraError(f"cannot read the camera file {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CameraError(f"{path} is not a YAML file: {error}") from error
    lines = text.splitlines()
    if lines and lines[0].startswith("%YAML:"):
        # YAML writes this directive with a space, and a document that follows one begins with ---.
        lines = lines[1:]
    try:
        return yaml.load("\n".join(lines), Loader=_Loader)
    except yaml.YAMLError as error:
        raise CameraError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from error
