"""One capture by what a person typed as `scene=`."""

from pathlib import Path

from extrap_train.data.co3d import read_sequence
from extrap_train.data.colmap_model import find_model, read_model
from extrap_train.data.posed import TRANSFORMS, read_transforms
from extrap_train.data.sequences import Sequence
from extrap_train.errors import InputError

CO3D_SCHEME = "co3d:"
KNOWN_FORMS = (
    "co3d:ROOT/category/sequence, a folder with a transforms.json, or a folder with a COLMAP model "
    "(sparse/0 beside images)"
)


def open_scene(spec: str) -> Sequence:
    """The capture that `spec` names; raises InputError that lists the known forms otherwise."""
    if spec.startswith(CO3D_SCHEME):
        return _open_co3d(spec)
    folder = Path(spec).expanduser()
    if not folder.is_dir():
        raise InputError(f"scene {spec!r}: no such folder; give {KNOWN_FORMS}")
    if (folder / TRANSFORMS).is_file():
        return read_transforms(folder)
    model = find_model(folder)
    if model is None:
        raise InputError(f"scene {spec!r}: holds neither kind of camera file; give {KNOWN_FORMS}")
    return read_model(model, _images_folder(folder, model), folder.resolve().name)


def _open_co3d(spec: str) -> Sequence:
    path = Path(spec.removeprefix(CO3D_SCHEME)).expanduser()
    if len(path.parts) < 3:
        raise InputError(f"scene {spec!r}: is not co3d:ROOT/category/sequence; give all three")
    return read_sequence(path.parent.parent, path.parent.name, path.name)


def _images_folder(folder: Path, model: Path) -> Path:
    """The nearest `images` from the model upwards, two folders at most: sparse/0 lies that deep."""
    candidates = [folder, model, *model.resolve().parents[:2]]
    for candidate in candidates:
        if (candidate / "images").is_dir():
            return candidate / "images"
    raise InputError(f"{model}: has no folder `images` beside it; put the pictures there")
