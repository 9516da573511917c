"""What COLMAP's model files hold, as far as it is needed: the same for text and binary files."""

from dataclasses import dataclass
from pathlib import Path

from extrap_train.data.picture_files import MAX_PIXELS
from extrap_train.errors import InputError
from extrap_train.geometry.colmap import CAMERA_MODELS, OTHER_MODELS, lens_from_parameters
from extrap_train.geometry.lens import Lens

PARAMETERS = {model.number: len(model.parameters) for model in CAMERA_MODELS} | {
    number: count for number, (_, count) in OTHER_MODELS.items()
}
"""How many there are, by the number of the camera model."""
_NAMES = {number: name for number, (name, _) in OTHER_MODELS.items()}


@dataclass(frozen=True)
class ModelCamera:
    """An entry of `cameras.txt` or `cameras.bin`, which may be of any model."""

    number: int
    model: str | int
    """Its name, or its number as a binary file has it."""
    height: int
    width: int
    parameters: tuple[float, ...]

    def lens(self, file: Path) -> Lens:
        """InputError where the model cannot be undone or the entry makes no sense."""
        for model in CAMERA_MODELS:
            if self.model in (model.name, model.number):
                break
        else:
            name = _NAMES.get(self.model, self.model) if isinstance(self.model, int) else self.model
            raise InputError(
                f"{file}: camera {self.number} is of the model {name}, and only "
                f"{', '.join(m.name for m in CAMERA_MODELS)} can be undone; run COLMAP's "
                "image_undistorter first"
            )
        count = len(self.parameters)
        sized = self.height > 0 and self.width > 0 and self.height * self.width <= MAX_PIXELS
        if count != len(model.parameters) or not sized:
            raise InputError(
                f"{file}: camera {self.number} ({model.name}) has {count} parameters and size "
                f"{self.height} x {self.width}, expected {len(model.parameters)} of them; export "
                "the model again"
            )
        named = dict(zip(model.parameters, self.parameters, strict=True))
        return lens_from_parameters(named, model.fisheye)


@dataclass(frozen=True)
class ModelImage:
    """An entry of `images.txt` or `images.bin`."""

    name: str
    camera: int
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
