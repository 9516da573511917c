"""Agisoft Metashape's cameras (`cameras.xml`) beside the photographs.

Cameras are camera-to-chunk with OpenCV's axes; the chunk's transform leads to the world. P1 and P2
of its lenses are what OpenCV calls p2 and p1, and B1 adds to the horizontal focal length.
"""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.data.lens_keys import PERSPECTIVE, number_of
from extrap_train.data.photogrammetry import PosedPicture, find_description, sequence_of_pictures
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.xml_files import read_xml
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import PANORAMA, flip_up_and_forward

_MODELS = {"frame": PERSPECTIVE, "fisheye": "OPENCV_FISHEYE", "spherical": PANORAMA}
_PARAMETERS = ("f", "cx", "cy", "b1", "b2", *(f"{kind}{i}" for kind in "kp" for i in range(1, 5)))
_TANGENTIAL = {"p1": "p2", "p2": "p1"}
_MAX_SKEW_PIXELS = 0.5
"""Most that a skew may move any point; Metashape often fits a little of it."""


def find_metashape_cameras(folder: Path) -> Path | None:
    """The XML file with a chunk of cameras, None where there is none; InputError for several."""
    return find_description(folder, ".xml", lambda head: b"<document" in head and b"<chunk" in head)


def read_metashape(file: Path, name: str) -> FrameSequence:
    """The capture of a file that `find_metashape_cameras` found, in the unit of its world.

    Cameras that are not aligned, disabled, or in another component than most are left out.
    """
    chunks = read_xml(file).findall("chunk")
    if len(chunks) != 1:
        raise InputError(f"{file}: has {len(chunks)} chunks; export the cameras of one chunk")
    (chunk,) = chunks
    cameras, unusable = _aligned_cameras(chunk, file)
    counts = Counter(camera.get("component_id") for camera, _ in cameras)
    largest = counts.most_common(1)[0][0] if counts else None
    chunk_to_world = _chunk_to_world(chunk, largest, file)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    pictures = []
    for camera, cam_to_chunk in cameras:
        label = camera.get("label", "")
        if camera.get("component_id") != largest:
            unusable.append(f"{file}: {label[:60]!a} is in a smaller component; merge them")
            continue
        cam_to_world = torch.from_numpy(chunk_to_world) @ torch.from_numpy(cam_to_chunk)
        sensor = sensors.get(camera.get("sensor_id"))
        opengl = flip_up_and_forward(cam_to_world).numpy()
        pictures.append(PosedPicture(label, opengl, partial(_lens, sensor)))
    return sequence_of_pictures(file, name, pictures, unusable)


def _aligned_cameras(
    chunk: Element, file: Path
) -> tuple[list[tuple[Element, Float[np.ndarray, "4 4"]]], list[str]]:
    """The cameras that have a pose, each with its camera-to-chunk; and why others have none."""
    cameras = chunk.find("cameras")
    aligned, unusable = [], []
    for camera in () if cameras is None else cameras.iter("camera"):
        where = f"{file}: {camera.get('label', '')[:60]!a}"
        transform = camera.find("transform")
        if transform is None:
            unusable.append(f"{where} is not aligned; align it or remove it from the chunk")
        elif camera.get("enabled", "true") in ("false", "0"):
            unusable.append(f"{where} is disabled; enable it to use it")
        else:
            try:
                aligned.append((camera, _numbers(transform, 16).reshape(4, 4)))
            except ValueError as error:
                unusable.append(f"{where} is malformed ({error}); correct it")
    return aligned, unusable


def _chunk_to_world(chunk: Element, component: str | None, file: Path) -> Float[np.ndarray, "4 4"]:
    """The similarity of the component or else of the chunk; the identity where neither has one."""
    components = (c for c in chunk.iter("component") if c.get("id") == component)
    transforms = [part.find("transform") for part in (*components, chunk)]
    transform = next((t for t in transforms if t is not None), None)
    matrix = np.eye(4)
    if transform is None:
        return matrix
    try:
        rotation, translation, scale = (
            _numbers(part, count) if (part := transform.find(key)) is not None else default
            for key, count, default in (
                ("rotation", 9, np.eye(3)),
                ("translation", 3, np.zeros(3)),
                ("scale", 1, np.ones(1)),
            )
        )
    except ValueError as error:
        raise InputError(
            f"{file}: the chunk's transform is malformed ({error}); correct it"
        ) from None
    matrix[:3, :3] = scale * rotation.reshape(3, 3)
    matrix[:3, 3] = translation
    return matrix


def _lens(sensor: Element | None, _picture: Path) -> dict[str, Any]:
    """Size and lens of a sensor in the terms of a `transforms.json`."""
    if sensor is None:
        raise ValueError("it names a sensor that the file does not have")
    kind = sensor.get("type", "frame")
    if kind not in _MODELS:
        raise ValueError(
            f"its sensor is of type {kind!r:.40}, none of {', '.join(_MODELS)}: export undistorted "
            "pictures"
        )
    calibration = min(
        sensor.findall("calibration"),
        key=lambda one: one.get("class") == "initial",
        default=Element("calibration"),  # of a spherical sensor, which needs none
    )
    sizes = [*calibration.findall("resolution"), *sensor.findall("resolution")]
    if not sizes:
        raise KeyError("resolution")
    width, height = (number_of(dict(sizes[0].attrib), side) for side in ("width", "height"))
    said = {part.tag: part.text for part in calibration if part.tag in _PARAMETERS}
    values = {key: number_of(said, key) for key in said}
    lens = {"cx": width / 2 + values.pop("cx", 0.0), "cy": height / 2 + values.pop("cy", 0.0)}
    if kind == "spherical":
        values.pop("f", None)  # the width in radians
    else:
        focal, skew = values.pop("f"), values.pop("b2", 0.0)
        if not abs(skew) * height <= 2 * _MAX_SKEW_PIXELS * abs(focal):
            raise ValueError(f"b2 is a skew of {skew:g}, which cannot be undone: fix it at 0")
        lens |= {"fl_x": focal + values.pop("b1", 0.0), "fl_y": focal}
    lens |= {_TANGENTIAL.get(key, key): value for key, value in values.items()}
    return {"w": width, "h": height, "camera_model": _MODELS[kind]} | lens


def _numbers(element: Element, count: int) -> Float[np.ndarray, " n"]:
    numbers = np.array([float(word) for word in (element.text or "").split()])
    if len(numbers) != count:
        raise ValueError(f"{element.tag} has {len(numbers)} numbers, expected {count}")
    return numbers
