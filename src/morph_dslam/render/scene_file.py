"""Scene files: what is filmed, by which camera, along which paths; checked when read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator
from scipy.interpolate import CubicSpline

from morph_dslam.errors import SceneError
from morph_dslam.io.sections import Section, read_sections

Array = NDArray[np.float64]


def interpolate_key_frames(frames: Sequence[int] | NDArray, values: Array, wanted: NDArray) -> Array:
    """Values at the ``wanted`` frames on a cubic spline through the key frames.

    The spline rests at its ends: it starts and stops with no velocity, and holds its end values outside.

    Parameters
    ----------
    frames : (k,) strictly increasing frame numbers.
    values : (k, ...) values there.
    wanted : (T,) frames.

    Returns
    -------
    (T, ...).
    """
    if len(frames) == 1:
        return np.repeat(np.asarray(values, dtype=float), len(wanted), axis=0)
    spline = CubicSpline(frames, values, bc_type="clamped")
    return spline(np.clip(wanted, frames[0], frames[-1]))


Colour = tuple[
    Annotated[int, Field(ge=0, le=255)], Annotated[int, Field(ge=0, le=255)], Annotated[int, Field(ge=0, le=255)]
]
#: No number of a scene is meant where it is larger: a kilometre in millimetres, degrees, pixels, frames. What
#: is computed with those below cannot overflow.
LARGEST = 1_000_000
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Vector = tuple[Number, Number, Number]
FrameNumber = Annotated[int, Field(ge=0, le=LARGEST)]
Side = Annotated[float, Field(ge=1e-3, le=LARGEST)]
#: Standard deviation of a blur: OpenCV filters with a kernel some eight times as wide.
Blur = Annotated[float, Field(ge=0.0, le=100.0)]


class Surface(Section):
    """How the sheet looks.

    ``texture`` is an image file relative to the scene file, or a photograph packaged with scikit-image. It is
    cut to the sheet's proportions and printed on the ``printed_face`` ("top" looks along +z of the object),
    upright with x to the right, leaving a white border of ``border_mm``. The other face has ``back_colour``
    (red, green, blue).
    """

    texture: str
    printed_face: Literal["top", "bottom"] = "top"
    border_mm: float = Field(default=0.0, ge=0.0, le=LARGEST)
    back_colour: Colour = (226, 224, 218)


class Background(Section):
    """A photograph, out of focus by ``blur_px``, or a colour (red, green, blue) where no image is named."""

    image: str | None = None
    colour: Colour = (120, 124, 128)
    blur_px: Blur = 0.0


class _Light(Section):
    """A distant light in ``direction`` (towards it, in the frame of the poses), and ambient light (0-1)."""

    direction: Vector = (-0.4, -0.6, -1.0)
    ambient: float = Field(default=0.45, ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _has_direction(self) -> _Light:
        if max(map(abs, self.direction)) < 1e-6:
            raise ValueError("direction must not be zero")
        return self


class Sensor(Section):
    """Gaussian blur (standard deviation, pixels), then Gaussian noise (standard deviation, grey levels)."""

    blur_px: Blur = 0.0
    noise: float = Field(default=0.0, ge=0.0, le=255.0)


class ParameterKeyFrame(BaseModel):
    """``frame``, and the values of any of the model's parameters in the units in which it shows them."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, FiniteFloat]
    frame: FrameNumber


class PoseKeyFrame(Section):
    """Where the object is: in the camera frame (x right, y down, z ahead), or in the world if there is a
    ``camera_path``.

    The object turns about that frame's x axis first, then y, then z (degrees). Left out, the object is shown
    with its top face upright, (180, 0, 0), or stands in the world as in its own frame.
    """

    frame: FrameNumber
    position_mm: Vector
    rotation_deg: Vector | None = None


class CameraKeyFrame(Section):
    """Where the camera is in the world, and the point that it looks at; the world's z axis points up."""

    frame: FrameNumber
    position_mm: Vector
    target_mm: Vector


class ExposureKeyFrame(Section):
    """By what the exposure multiplies grey values; what exceeds 255 saturates."""

    frame: FrameNumber
    gain: float = Field(ge=0.01, le=100.0)


class Rectangle(Section):
    """A textured rectangle: its centre and its whole edges to the right and down, world."""

    texture: str
    centre_mm: Vector
    right_mm: Vector
    down_mm: Vector


class Box(Section):
    """A textured box that stands upright, turned about the vertical."""

    texture: str
    centre_mm: Vector
    size_mm: tuple[Side, Side, Side]
    turn_deg: Number = 0.0


class Environment(Section):
    """What stands still around the object; textures are cut to the proportions of each face."""

    rectangles: list[Rectangle] = Field(default_factory=list)
    boxes: list[Box] = Field(default_factory=list)

    @model_validator(mode="after")
    def _has_something(self) -> Environment:
        if not self.rectangles and not self.boxes:
            raise ValueError("give it rectangles or boxes")
        return self


class DepthSensor(Section):
    """A depth camera in the place of the colour camera.

    ``noise_mm_at_1m`` is the standard deviation at 1 m and grows with the square of the distance. Within
    ``rim_px`` of a jump in depth, and beyond ``range_mm``, there is no depth.
    """

    noise_mm_at_1m: float = Field(default=1.4, ge=0.0, le=1000.0)
    rim_px: int = Field(default=2, ge=0, le=20)
    range_mm: float = Field(default=5000.0, gt=0.0, le=13000.0)


class _OccluderKeyFrame(Section):
    """Where the disc is in one frame."""

    frame: FrameNumber
    centre_px: tuple[Number, Number]


class Occluder(Section):
    """A disc of one colour (red, green, blue) in front of everything, moving over the image."""

    radius_px: float = Field(gt=0.0, le=LARGEST)
    colour: Colour = (196, 150, 122)
    path: list[_OccluderKeyFrame] = Field(min_length=1)


class Scene(Section):
    """A scene file; paths in it are relative to the file."""

    model: str
    camera: str | dict[str, Any]
    frames: int = Field(ge=1, le=LARGEST)
    fps: float = Field(default=30.0, ge=1e-3, le=LARGEST)
    seed: int = Field(default=0, ge=0)
    image_format: Literal["jpg", "png"] = "jpg"
    jpeg_quality: int = Field(default=95, ge=1, le=100)
    supersampling: int = Field(default=2, ge=1, le=4)
    surface: Surface
    background: Background = Background()
    light: _Light = _Light()
    sensor: Sensor = Sensor()
    parameters: list[ParameterKeyFrame] = Field(default_factory=list)
    pose: list[PoseKeyFrame] = Field(default_factory=list)
    camera_path: list[CameraKeyFrame] = Field(default_factory=list)
    exposure: list[ExposureKeyFrame] = Field(default_factory=list)
    environment: Environment | None = None
    depth_sensor: DepthSensor | None = None
    occluder: Occluder | None = None

    @model_validator(mode="after")
    def _something_is_placed(self) -> Scene:
        if not self.pose and not self.camera_path:
            raise ValueError("the key 'pose' is missing, or 'camera_path' where the camera moves")
        if self.environment and not self.camera_path:
            raise ValueError("an environment stands in the world: say with camera_path where the camera is")
        return self

    @model_validator(mode="after")
    def _key_frames_are_ordered(self) -> Scene:
        lists = {"parameters": self.parameters, "pose": self.pose, "camera_path": self.camera_path}
        lists |= {"exposure": self.exposure}
        if self.occluder:
            lists["occluder.path"] = self.occluder.path
        for name, keys in lists.items():
            numbers = [key.frame for key in keys]
            if sorted(set(numbers)) != numbers:
                raise ValueError(f"the key frames of {name} must have increasing frame numbers, not {numbers}")
        return self


def load_scene_file(path: str | Path) -> Scene:
    """Read and check a scene file.

    Raises
    ------
    SceneError
        If the file is missing, is not TOML, or a key is unknown, missing or has an impossible value.
    """
    path = Path(path)
    return read_sections(path, "scene file", Scene, SceneError)
