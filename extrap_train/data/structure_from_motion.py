"""Cameras of photographs by structure from motion, in a process of its own.

`python -m extrap_train.data.structure_from_motion FOLDER THREADS` reads `FOLDER/job.json` and the
pictures that it names, writes a COLMAP model to `FOLDER/sparse/0` unless no three pictures belong
together, and prints on each line how many more of `count_steps` are done. Matches are read from
`FOLDER/matches.npz` if it is there (`picture_matches`), and are SIFT's otherwise. pycolmap handles
signals in its own way once it is imported, and may end the process: so it has one of its own.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap

MAX_SIDE = 1200
"""Longer side of the pictures that features are found in, in pixels."""
MAX_FEATURES = 4096
"""Most features of one picture; the time of matching grows with their square."""
EXHAUSTIVE = 100
"""Up to this many pictures, every pair is matched."""
NEIGHBOURS = 10
"""Of more pictures, each is matched with this many that follow it, and with those 16, 32, … places
later."""
CLEARLY_BETTER = 0.992
"""Distortion, and a principal point off the middle, must each lower the mean reprojection error to
this share: few pictures hardly tell them from a turn of the cameras."""
SEED = 0
MIN_PICTURES = 3
JOB = "job.json"
MATCHES = "matches.npz"
ESTIMATE = "estimate.json"
"""What the model says of itself: its numbers of points and of the pixels that show them, and their
mean distance from these, in pixels of the photographs."""


@dataclass(frozen=True)
class SharedCamera:
    """Pictures that one camera and lens took."""

    names: list[str]
    """Names of the photographs."""
    files: list[str]
    """The pictures in the job's folder, reduced to at most `MAX_SIDE`."""
    height: int
    width: int
    """Size of the photographs, in pixels, turned upright."""
    focal: float | None
    """In pixels of the reduced pictures, if the photographs tell it."""


def write_job(cameras: Sequence[SharedCamera], folder: Path) -> None:
    """What `main` reads."""
    content = json.dumps([asdict(camera) for camera in cameras])
    (folder / JOB).write_text(content, encoding="utf-8")


def pairs_to_match(count: int) -> list[list[tuple[int, int]]]:
    """For each picture its pairs with later ones: all, or those with the nearest and a few more."""

    def is_matched(gap: int) -> bool:
        return count <= EXHAUSTIVE or gap <= NEIGHBOURS or gap & (gap - 1) == 0

    return [[(i, j) for j in range(i + 1, count) if is_matched(j - i)] for i in range(count)]


def count_steps(count: int) -> int:
    """Pictures whose features are found, and pairs that are matched."""
    return count + sum(map(len, pairs_to_match(count)))


def main() -> None:
    """Entry point of the process."""
    import pycolmap

    folder, threads = Path(sys.argv[1]), int(sys.argv[2])
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(SEED)
    job = json.loads((folder / JOB).read_text(encoding="utf-8"))
    cameras = [SharedCamera(**camera) for camera in job]
    database = folder / "database.db"
    files = sorted(file for camera in cameras for file in camera.files)
    if (folder / MATCHES).is_file():
        _import_matches(database, folder, cameras, files)
    else:
        for number, camera in enumerate(cameras, 1):
            _find_features(database, folder, camera, number, threads)
    _match(database, folder, files, threads)
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, random_seed=SEED, extract_colors=False, min_model_size=MIN_PICTURES
    )
    output = folder / "sparse"
    output.mkdir()
    models = pycolmap.incremental_mapping(database, folder, output, options)
    if models:
        model = _refine(max(models.values(), key=lambda found: found.num_reg_images()), threads)
        _restore_photographs(model, cameras)
        model.update_point_3d_errors()
        model.normalize(extent=1.0)
        (output / "0").mkdir(exist_ok=True)
        model.write(output / "0")
        estimate = {
            "points": model.num_points3D(),
            "observations": model.compute_num_observations(),
            "error_px": model.compute_mean_reprojection_error(),
        }
        (output / "0" / ESTIMATE).write_text(json.dumps(estimate), encoding="utf-8")


def _find_features(
    database: Path, folder: Path, camera: SharedCamera, number: int, threads: int
) -> None:
    """The camera becomes the database's `number`th."""
    import pycolmap

    options = pycolmap.FeatureExtractionOptions(num_threads=threads)
    options.sift.max_num_features = MAX_FEATURES
    reader = _reader(camera)
    block = 4 * threads
    for start in range(0, len(camera.files), block):
        files = camera.files[start : start + block]
        if start:
            reader.existing_camera_id = number
        pycolmap.extract_features(
            database,
            folder,
            files,
            pycolmap.CameraMode.SINGLE,
            reader,
            options,
            pycolmap.Device.cpu,
        )
        print(len(files), flush=True)


def _reader(camera: SharedCamera) -> "pycolmap.ImageReaderOptions":
    import pycolmap

    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if camera.focal is not None:
        scale = MAX_SIDE / max(camera.height, camera.width, MAX_SIDE)
        middle = f"{camera.width * scale / 2},{camera.height * scale / 2}"
        reader.camera_params = f"{camera.focal},{middle},0"
    return reader


def _import_matches(
    database: Path, folder: Path, cameras: Sequence[SharedCamera], files: Sequence[str]
) -> None:
    import pycolmap

    pycolmap.Database.open(database).close()  # import_images expects one
    single = pycolmap.CameraMode.SINGLE
    for camera in cameras:
        pycolmap.import_images(database, folder, single, camera.files, _reader(camera))
    with (
        np.load(folder / MATCHES, allow_pickle=False) as stored,
        pycolmap.Database.open(database) as opened,
    ):
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        for name in stored.files:
            shown = [numbers[file] for file in name.split()]
            if len(shown) == 1:
                opened.write_keypoints(shown[0], stored[name].astype(np.float32))
            else:
                opened.write_matches(shown[0], shown[1], stored[name].astype(np.uint32))
    print(len(files), flush=True)


def _match(database: Path, folder: Path, files: Sequence[str], threads: int) -> None:
    """Match and verify all pairs; those of `_import_matches` need only be verified."""
    import pycolmap

    options = pycolmap.FeatureMatchingOptions(num_threads=threads, guided_matching=True)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    is_matched = (folder / MATCHES).is_file()
    listed = folder / "pairs.txt"
    for pairs in filter(None, pairs_to_match(len(files))):
        listed.write_text("".join(f"{files[i]} {files[j]}\n" for i, j in pairs))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
        if is_matched:
            pycolmap.verify_matches(database, listed, verification)
        else:
            cpu = pycolmap.Device.cpu
            pycolmap.match_image_pairs(database, options, pairing, verification, cpu)
        print(len(pairs), flush=True)


def _refine(model: "pycolmap.Reconstruction", threads: int) -> "pycolmap.Reconstruction":
    """All cameras and points adjusted once more, with less weight for outliers than the mapper.

    Lenses start without distortion and with the principal point in the middle.
    """
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_extra_params=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = 1e-8
    for camera in model.cameras.values():
        camera.params = [*camera.params[:3], 0.0]
    error = _adjust(model, options)
    for released in ("refine_extra_params", "refine_principal_point"):
        setattr(options, released, True)
        freer = pycolmap.Reconstruction(model)
        freer_error = _adjust(freer, options)
        if freer_error < CLEARLY_BETTER * error:
            model, error = freer, freer_error
        else:
            setattr(options, released, False)
    return model


def _adjust(model: "pycolmap.Reconstruction", options: "pycolmap.BundleAdjustmentOptions") -> float:
    """Adjust the model's bundle; returns its mean reprojection error in pixels."""
    import pycolmap

    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())


def _restore_photographs(model: "pycolmap.Reconstruction", cameras: Sequence[SharedCamera]) -> None:
    """Names and pixels of the photographs instead of those of the grey pictures."""
    names = {f: name for c in cameras for f, name in zip(c.files, c.names, strict=True)}
    scales = {}
    for number, found in model.cameras.items():
        photograph = cameras[number - 1]
        scales[number] = photograph.width / found.width, photograph.height / found.height
        found.rescale(photograph.width, photograph.height)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy * scales[image.camera_id]
        image.name = names[image.name]


if __name__ == "__main__":
    main()
