"""Photographs without cameras: cameras are estimated with pycolmap, once for each set of pictures,
by the matches of its own SIFT or of any matcher.

The world is centred on the cameras, and its unit is about the diagonal of the box around them
(COLMAP's normalisation: the box leaves out the outer tenth on each side).
"""

import hashlib
import importlib.util
import json
import logging
import math
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from PIL import Image

from extrap_train.config import MatcherConfig, SiftPosesConfig
from extrap_train.data.camera_check import LONGEST_FOCAL, SHORTEST_FOCAL
from extrap_train.data.colmap import read_model
from extrap_train.data.colmap_files import read_model_cameras
from extrap_train.data.image_files import read_photograph, to_eight_bits, upright_photograph
from extrap_train.data.listed_files import PICTURE_SUFFIXES, counting_order, is_mask_name
from extrap_train.data.paths import require_file
from extrap_train.data.picture_matches import CELL, write_matches
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.structure_from_motion import (
    CLEARLY_BETTER,
    ESTIMATE,
    EXHAUSTIVE,
    MAX_FEATURES,
    MAX_SIDE,
    MIN_PICTURES,
    NEIGHBOURS,
    SEED,
    SharedCamera,
    count_steps,
    write_job,
)
from extrap_train.depth.sources import weight_files
from extrap_train.errors import InputError
from extrap_train.matching.matchers import matcher
from extrap_train.store.cache import cache_entry, fill_entry, is_intact, seal
from extrap_train.store.digests import file_digest
from extrap_train.terminal import progress

MAX_PICTURES = 1000
PHOTOGRAPH_SUFFIXES = (*PICTURE_SUFFIXES, ".heic", ".heif")
_MAX_NAMED = 8
_REMEDY = (
    "take more pictures of the textured scene in small steps around it, or give a transforms.json "
    "or COLMAP model"
)

log = logging.getLogger(__name__)


def find_pictures(folder: Path) -> list[str]:
    """The names of the photographs in a folder, which need not exist, in order; not of masks."""
    if not folder.is_dir():
        return []
    paths = (path for path in folder.iterdir() if path.suffix.lower() in PHOTOGRAPH_SUFFIXES)
    files = (path for path in paths if path.is_file() or path.is_symlink())  # broken ones are named
    visible = (path.name for path in files if not path.name.startswith("."))
    names = sorted(visible, key=counting_order)
    return [name for name in names if not is_mask_name(name, names)]


def read_unposed(
    folder: Path, pictures: Sequence[str], name: str, poses: MatcherConfig | None = None
) -> FrameSequence:
    """The capture of a folder's `pictures`, whose cameras are estimated and kept in the cache.

    `poses` are the options of the matcher, SIFT by default. Pictures that cannot be read or
    placed are left out with one warning. InputError where fewer than three are left, or where
    pycolmap or weights are needed and missing.
    """
    if len(pictures) > MAX_PICTURES:
        raise InputError(
            f"{folder}: has {len(pictures)} photographs without cameras, and those of at most "
            f"{MAX_PICTURES} are estimated; choose some, or run COLMAP yourself"
        )
    pictures, poses = _select_present(folder, pictures), poses or SiftPosesConfig()
    settings = {
        **{"max_side": MAX_SIDE, "max_features": MAX_FEATURES, "seed": SEED, "cell": CELL},
        **{"pairs": [EXHAUSTIVE, NEIGHBOURS], "clearly_better": CLEARLY_BETTER},
        "matcher": {key: value for key, value in asdict(poses).items() if key != "checkpoint"},
        "weights": [file_digest(file) for file in weight_files(poses) if file.is_file()],
    }
    content = json.dumps([settings, {p: file_digest(folder / p) for p in sorted(pictures)}])
    stored = cache_entry("poses", name, hashlib.sha256(content.encode()).hexdigest())
    is_sound = partial(is_intact, part="sparse")
    if not is_sound(stored):
        with fill_entry(stored, is_sound, "estimated cameras") as made:
            _estimate(folder, pictures, poses, made)
            seal(made, "sparse")
        log.warning("%s: cameras estimated from the photographs are kept in %s", folder, stored)
    sequence = read_model(stored / "sparse" / "0", folder, name, upright=True)
    placed = {frame.name for frame in sequence.frames}
    lost = [picture for picture in pictures if picture not in placed]
    if lost:
        more = f" and {len(lost) - _MAX_NAMED} more" if len(lost) > _MAX_NAMED else ""
        log.warning(
            "%s: %d of %d photographs could not be placed among the others and are left out: %s%s",
            folder,
            len(lost),
            len(pictures),
            ", ".join(lost[:_MAX_NAMED]),
            more,
        )
    reasons = tuple(f"{folder / picture}: could not be placed among the others" for picture in lost)
    return replace(
        sequence,
        left_out=reasons,
        listed=tuple(pictures),
        poses=f"pycolmap with matches of {poses.name}: {_summary(stored)}",
    )


def _summary(stored: Path) -> str:
    """What the estimate says of itself."""
    said = json.loads((stored / "sparse" / "0" / ESTIMATE).read_text(encoding="utf-8"))
    length = said["observations"] / said["points"]
    return (
        f"{said['points']:,} points in {length:.1f} photographs each, mean reprojection error "
        f"{said['error_px']:.2f} px"
    )


def _select_present(folder: Path, pictures: Sequence[str]) -> list[str]:
    """Those that are files, or links to files, with names that can be written down."""
    present = []
    for name in pictures:
        try:
            name.encode()
            require_file(folder / name)
        except UnicodeEncodeError:
            log.warning("%s: %a is left out: its name is not UTF-8; rename it", folder, name)
        except InputError as error:
            log.warning("%s", error)
        else:
            present.append(name)
    return present


def _estimate(folder: Path, pictures: Sequence[str], poses: MatcherConfig, made: Path) -> None:
    """Write the model to `made/sparse/0`."""
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            f"{folder}: holds photographs without cameras, and estimating these needs pycolmap; "
            'pip install "extrap-train[poses]", or give a transforms.json or COLMAP model'
        )
    work = made / "work"
    work.mkdir()
    is_sift = isinstance(poses, SiftPosesConfig)
    matching = None if is_sift else matcher(poses, "poses")
    cameras = _write_small(folder, pictures, work, "pgm" if is_sift else "ppm")
    count = sum(len(camera.files) for camera in cameras)
    if count < MIN_PICTURES:
        raise InputError(
            f"{folder}: has {count} readable photographs and no cameras, which takes at least "
            f"{MIN_PICTURES} to estimate; add photographs, or a transforms.json or COLMAP model"
        )
    if matching is not None:
        write_matches(matching, work, sorted(file for c in cameras for file in c.files))
    write_job(cameras, work)
    _run(work, count)
    model = work / "sparse" / "0"
    if not (model / "images.bin").is_file():
        raise InputError(
            f"{folder}: its {count} photographs show too little in common to estimate their "
            f"cameras; {_REMEDY}"
        )
    _require_plausible_focal(model, folder)
    model.parent.rename(made / "sparse")
    shutil.rmtree(work)


def _write_small(
    folder: Path, pictures: Sequence[str], work: Path, suffix: str
) -> list[SharedCamera]:
    """Upright pictures to match, `pgm` in grey and `ppm` in colour; those of one size and focal
    length share a camera.
    """
    groups: dict[tuple[tuple[int, int], float | None], SharedCamera] = {}
    with progress("reading photographs", len(pictures), "photographs") as bar:
        for number, name in enumerate(pictures):
            file = f"{number:04d}.{suffix}"
            try:
                size, focal = upright_photograph(folder / name)
                image, _ = read_photograph(folder / name, size, upright=True)
            except InputError as error:
                log.warning("%s", error)
                continue
            small = Image.fromarray(to_eight_bits(image).transpose(1, 2, 0))
            small = small.convert("L") if suffix == "pgm" else small
            small.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.LANCZOS)
            small.save(work / file)
            group = SharedCamera([], [], *size, focal and focal * small.width / size[1])
            camera = groups.setdefault((size, focal), group)
            camera.names.append(name)
            camera.files.append(file)
            bar.advance()
    return list(groups.values())


def _run(work: Path, count: int) -> None:
    """Run `structure_from_motion` on a job."""
    module = "extrap_train.data.structure_from_motion"
    # -P: modules are not looked for in the current folder, which may be the photographs'.
    command = [sys.executable, "-P", "-m", module, str(work), str(torch.get_num_threads())]
    errors = work / "errors.txt"
    with (
        progress("estimating cameras", count_steps(count), "pictures and pairs") as bar,
        errors.open("w") as stderr,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True) as process,
    ):
        assert process.stdout is not None
        try:
            for line in process.stdout:
                bar.advance(int(line))
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        said = errors.read_text(errors="replace").strip().splitlines() or ["no message"]
        raise InputError(
            f"pycolmap failed to estimate cameras ({said[-1][:200]}, exit status "
            f"{process.returncode}); {_REMEDY}"
        )


def _require_plausible_focal(model: Path, folder: Path) -> None:
    for camera in read_model_cameras(model / "cameras.bin").values():
        focal, sides = camera.parameters[0], sorted((camera.height, camera.width))
        plausible = SHORTEST_FOCAL * sides[0] <= focal <= LONGEST_FOCAL * sides[1]
        if not (math.isfinite(focal) and plausible):
            raise InputError(
                f"{folder}: a focal length of {focal:.4g} pixels is estimated for photographs of "
                f"{camera.width} x {camera.height}, which no lens has: they do not determine their "
                f"cameras; {_REMEDY}"
            )
