"""One capture by what a person typed as `scene=`."""

from dataclasses import replace
from pathlib import Path

from extrap_train.config import MatcherConfig, SyntheticConfig
from extrap_train.data import uco3d
from extrap_train.data.archives import is_archive, unpack_archive
from extrap_train.data.camera_check import CO3D_POSES, find_pose_fault
from extrap_train.data.co3d import FRAME_ANNOTATIONS, read_sequence
from extrap_train.data.colmap import find_model, read_model
from extrap_train.data.estimated_poses import find_pictures, read_unposed
from extrap_train.data.keyframes import read_video
from extrap_train.data.metashape import find_metashape_cameras, read_metashape
from extrap_train.data.polycam import find_keyframe_cameras, read_polycam
from extrap_train.data.realitycapture import find_camera_table, read_realitycapture
from extrap_train.data.record3d import find_metadata, read_record3d
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.synthetic.capture import synthetic_sequence
from extrap_train.data.transforms_json import TRANSFORMS, read_transforms
from extrap_train.data.video_files import is_video
from extrap_train.errors import InputError
from extrap_train.views import stack_poses

CO3D_SCHEME = "co3d:"
UCO3D_SCHEME = "uco3d:"
SYNTHETIC_SCHEME = "synthetic:"
KNOWN_FORMS = (
    "co3d:ROOT/category/sequence, uco3d:ROOT/supercategory/category/sequence, a folder with a "
    "transforms.json, a COLMAP model (sparse/0 beside images) or an export of Polycam, Record3D, "
    "Metashape (XML) or RealityCapture (CSV), a folder of photographs, a .zip or .r3d of such a "
    "folder, a video, or synthetic:category/0003"
)

_CAMERA_FILES = (
    TRANSFORMS,
    *(f"{name}.{kind}" for name in ("cameras", "images") for kind in ("bin", "txt")),
    *(f"transforms_{part}.json" for part in ("train", "val", "test")),
    *("poses_bounds.npy", "cameras.xml", "cameras.csv", "cameras.json", "cameras.npz"),
)


def open_scene(
    spec: str,
    synthetic: SyntheticConfig | None = None,
    poses: MatcherConfig | None = None,
    *,
    needs_depth: bool = False,
) -> FrameSequence:
    """The capture that `spec` names; raises InputError that lists the known forms otherwise.

    `synthetic` says how many frames, of what size and from which seed a synthetic capture has; its
    defaults are those of `data=synthetic`. `poses` says whose matches place photographs that have
    no cameras; by default SIFT's. Those bring no depth either: with `needs_depth` they are refused
    before their cameras are estimated, which may take minutes.
    """
    if spec.startswith(SYNTHETIC_SCHEME):
        return _open_synthetic(spec, synthetic or SyntheticConfig())
    if spec.startswith(CO3D_SCHEME):
        return _open_co3d(spec)
    if spec.startswith(UCO3D_SCHEME):
        return _open_uco3d(spec)
    path = _expand_home(spec)
    if is_archive(path):
        unpacked = unpack_archive(path)
        return replace(_open_folder(unpacked, spec, poses, needs_depth), name=path.stem)
    if path.is_file():
        if not is_video(path):
            raise InputError(
                f"scene {spec!r}: is not a video (MP4, MOV, AVI, Matroska or WebM), nor a .zip or "
                f".r3d; if it belongs to a capture, give the folder: {path.absolute().parent}"
            )
        _refuse_without_depth(spec, needs_depth)
        return read_video(path, poses)
    if path.is_dir():
        return _open_folder(path, spec, poses, needs_depth)
    raise InputError(f"scene {spec!r}: no such file or folder; give {KNOWN_FORMS}")


def _open_folder(
    folder: Path, spec: str, poses: MatcherConfig | None, needs_depth: bool
) -> FrameSequence:
    if (folder / TRANSFORMS).is_file():
        return read_transforms(folder)
    name = folder.resolve().name
    if model := find_model(folder):
        return read_model(model, _images_folder(folder, model), name)
    if cameras := find_keyframe_cameras(folder):
        return read_polycam(cameras, name)
    if metadata := find_metadata(folder):
        return read_record3d(metadata, name)
    if cameras := find_metashape_cameras(folder):
        return read_metashape(cameras, name)
    if table := find_camera_table(folder):
        return read_realitycapture(table, name)
    if file := _camera_like_file(folder):
        raise InputError(
            f"scene {spec!r}: {file} describes cameras, but not in a form that is read "
            "here, or files that belong to it are missing; restore them, or remove it to have "
            f"cameras estimated; known are {KNOWN_FORMS}"
        )
    for place in (folder, folder / "images"):
        if pictures := find_pictures(place):
            _refuse_without_depth(spec, needs_depth)
            return read_unposed(place, pictures, name, poses)
    raise InputError(f"scene {spec!r}: holds no camera file and no photographs; give {KNOWN_FORMS}")


def _refuse_without_depth(spec: str, needs_depth: bool) -> None:
    if needs_depth:
        raise InputError(
            f"scene {spec!r}: photographs without cameras bring no depth, which depth=dataset "
            "reads; give depth=stereo"
        )


def _camera_like_file(folder: Path) -> Path | None:
    """A file that is part of a description of cameras, where none is complete."""
    if (annotations := folder.parent / FRAME_ANNOTATIONS).is_file():
        return annotations
    places = [
        folder,
        *(path for name in ("sparse", "colmap") for path in folder.glob(f"{name}/**")),
    ]
    files = (path for place in places for path in sorted(place.glob("*")))
    return next((path for path in files if path.name.lower() in _CAMERA_FILES), None)


def scene_address(spec: str) -> str:
    """What `spec` names as it is named from any folder: paths are absolute, through no links."""
    if spec.startswith(SYNTHETIC_SCHEME):
        return spec
    scheme = next((s for s in (CO3D_SCHEME, UCO3D_SCHEME) if spec.startswith(s)), "")
    return f"{scheme}{_expand_home(spec.removeprefix(scheme)).resolve()}"


def _expand_home(spec: str) -> Path:
    """`~` and `~NAME` as a home folder, if there is one of that name."""
    try:
        return Path(spec).expanduser()
    except RuntimeError:  # a folder's own name begins with ~
        return Path(spec)


def _open_co3d(spec: str) -> FrameSequence:
    path = _expand_home(spec.removeprefix(CO3D_SCHEME))
    if len(path.parts) < 3:
        raise InputError(f"scene {spec!r}: is not co3d:ROOT/category/sequence; give all three")
    return _with_sound_poses(read_sequence(path.parent.parent, path.parent.name, path.name), spec)


def _open_uco3d(spec: str) -> FrameSequence:
    path = _expand_home(spec.removeprefix(UCO3D_SCHEME))
    root = next((above for above in path.parents if (above / uco3d.METADATA).is_file()), None)
    if root is None:
        raise InputError(
            f"scene {spec!r}: no {uco3d.METADATA} in a folder above; give uco3d:ROOT/supercategory/"
            "category/sequence"
        )
    return _with_sound_poses(uco3d.read_sequence(root, path.name), spec)


def _with_sound_poses(sequence: FrameSequence, spec: str) -> FrameSequence:
    cameras = stack_poses([frame.camera for frame in sequence.frames])
    if fault := find_pose_fault(cameras, CO3D_POSES):
        raise InputError(f"scene {spec!r}: {fault}")
    return sequence


def _open_synthetic(spec: str, options: SyntheticConfig) -> FrameSequence:
    category, _, number = spec.removeprefix(SYNTHETIC_SCHEME).partition("/")
    if not (number.isascii() and number.isdigit()):
        raise InputError(f"scene {spec!r}: is not synthetic:category/NUMBER, as hydrant/0003")
    return synthetic_sequence(category, int(number), options)


def _images_folder(folder: Path, model: Path) -> Path:
    """The nearest `images` from the model upwards, two folders at most: sparse/0 lies that deep."""
    candidates = [folder, model, *model.resolve().parents[:2]]
    for candidate in candidates:
        if (candidate / "images").is_dir():
            return candidate / "images"
    alike = sorted(path.name for path in folder.glob("[Ii]m*") if path.is_dir())
    there = f" (there is {', '.join(alike[:4])})" if alike else ""
    raise InputError(f"{model}: has no folder `images` beside it{there}; put the pictures there")
