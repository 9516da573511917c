"""What COLMAP's model files hold, as far as it is needed: the same for text and binary files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from extrap_train.errors import InputError
from extrap_train.geometry.colmap import CAMERA_MODELS, CameraModel, lens_from_parameters
from extrap_train.geometry.lens import Lens


@dataclass(frozen=True)
class ModelCamera:
    """An entry of `cameras.txt` or `cameras.bin`."""

    number: int
    height: int
    width: int
    lens: Lens


@dataclass(frozen=True)
class ModelImage:
    """An entry of `images.txt` or `images.bin`."""

    name: str
    camera: int
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]


def find_camera_model(key: str | int, file: Path) -> CameraModel:
    """A camera model by its name or number; raises InputError for those that cannot be undone."""
    for model in CAMERA_MODELS:
        if key in (model.name, model.number):
            return model
    raise InputError(
        f"{file}: camera model {key} is none of {', '.join(m.name for m in CAMERA_MODELS)}; "
        "run COLMAP's image_undistorter first"
    )


def make_camera(
    number: int, model: CameraModel, height: int, width: int, values: Sequence[float], file: Path
) -> ModelCamera:
    """A camera from its parameters in the model's order."""
    if len(values) != len(model.parameters) or height <= 0 or width <= 0:
        raise InputError(
            f"{file}: camera {number} ({model.name}) has {len(values)} parameters and size "
            f"{height} x {width}, expected {len(model.parameters)} of them; export the model again"
        )
    named = dict(zip(model.parameters, values, strict=True))
    return ModelCamera(number, height, width, lens_from_parameters(named, model.fisheye))
