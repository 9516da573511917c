"""Every key of a `transforms.json` that says something of the lens: understood, or refused by name.

nerfstudio, instant-ngp and Blender each have spellings of their own (docs/captures.md lists them).
Keys that are neither in the tables below nor asked for here do not change what a pixel shows, and
are passed over.
"""

import json
import math
from typing import Any

from extrap_train.geometry.cuts import Equirectangular
from extrap_train.geometry.foreign_cameras import CAMERA_MODELS, PANORAMA, lens_from_parameters
from extrap_train.geometry.lens import Lens

PERSPECTIVE = "PERSPECTIVE"
MODELS = {model.name: model.fisheye for model in CAMERA_MODELS} | {PERSPECTIVE: False}
"""Values of `camera_model`, and whether they are fisheyes."""
RATIONAL = "FULL_OPENCV"
"""The model in which k4, k5 and k6 stand in OpenCV's denominator."""

REFUSED = {
    "skew": "rows and columns that are not at right angles",
    "rolling_shutter": "a camera that moves while it takes a picture",
    **dict.fromkeys(
        ("equirectangular", "latlong"),
        f"a panorama, which is written as camera_model {PANORAMA} here",
    ),
    "orthographic": "an orthographic projection",
    "from_mitsuba": "matrices in Mitsuba's axes",
    **dict.fromkeys(
        ("p3", "p4", "s1", "s2", "s3", "s4", "sx1", "sy1", "xi"), "a lens model of its own"
    ),
    **dict.fromkeys((f"ftheta_p{i}" for i in range(6)), "an f-theta lens"),
    **dict.fromkeys(("b1", "b2"), "Metashape's affinity and skew"),
    **dict.fromkeys(("distortion", "distortion_coefficients"), "distortion in an unknown order"),
}
"""What such a key means. Where it says nothing (0, false, a list of zeros) it is passed over."""

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""nerfstudio's order in `distortion_params`."""
_FOREIGN = {
    model.name: tuple(key for key in _COEFFICIENTS if key not in model.parameters)
    for model in CAMERA_MODELS
    if not model.fisheye and model.name not in ("OPENCV", RATIONAL)
}
"""Coefficients that a perspective `camera_model` does not have; nerfstudio's OPENCV has k3, k4."""
_SPELLINGS = (
    (("fl_x",), ("x_fov",), ("camera_angle_x",)),
    (("fl_y",), ("y_fov",), ("camera_angle_y",)),
    (_COEFFICIENTS, ("distortion_params",)),
    (("camera_model",), ("is_fisheye",)),
    (("depth_file_path",), ("depth_path",)),
)
_PLACE_KEYS = {key for group in _SPELLINGS[:2] for keys in group for key in keys} | {"cx", "cy"}
"""Focal lengths and principal point."""
LENS_KEYS = frozenset(REFUSED) | {key for group in _SPELLINGS[:4] for keys in group for key in keys}
LENS_KEYS |= _PLACE_KEYS
"""Every key that is looked at here."""


def merge_entry(common: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """The keys of all frames, overridden by a frame's own, whichever way they are spelt.

    Distortion that stands beside a `camera_model` for all is not that of a frame with another one,
    and a panorama shares no key of the lens with other pictures.
    """
    hidden = _keys_of_other_lens(common, frame)
    for spellings in _SPELLINGS:
        said = [keys for keys in spellings if any(key in frame for key in keys)]
        if said:
            hidden.update(key for keys in spellings if keys not in said for key in keys)
    return {key: value for key, value in common.items() if key not in hidden} | frame


def _keys_of_other_lens(common: dict[str, Any], frame: dict[str, Any]) -> set[str]:
    """The keys shared by all frames that do not apply to a frame that names another lens."""
    own, shared = frame.get("camera_model"), common.get("camera_model")
    names_model = own is not None and shared is not None and own != shared
    fisheyes = [_says_fisheye(entry) for entry in (common, frame)]
    if not names_model and (None in fisheyes or fisheyes[0] == fisheyes[1]):
        return set()
    hidden = {*_COEFFICIENTS, "distortion_params"}
    return hidden | _PLACE_KEYS if PANORAMA in (own, shared) else hidden


def _says_fisheye(entry: dict[str, Any]) -> bool | None:
    """Whether an entry says that its lens is a fisheye, or that it is none; None if neither."""
    model, said = entry.get("camera_model"), entry.get("is_fisheye")
    if isinstance(model, str):
        return MODELS.get(model)
    return said if isinstance(said, bool) else None


def lens_of(entry: dict[str, Any], height: int, width: int) -> Lens | Equirectangular:
    """The lens of a merged entry, for a picture of `height` × `width` pixels.

    Raises KeyError for the focal length where there is none, and ValueError or TypeError that names
    the key where a value cannot be used.
    """
    for key, value in entry.items():
        if key in REFUSED and _says_something(value):
            raise ValueError(
                f"{key} means {REFUSED[key]}, which cannot be undone: convert the capture"
            )
    if entry.get("camera_model") == PANORAMA:
        return _panorama(entry, height, width)
    focal = _focal(entry, "x", width), _focal(entry, "y", height)
    known = [length for length in focal if length is not None]
    if not known:
        raise KeyError("fl_x")
    center = number_of(entry, "cx", width / 2), number_of(entry, "cy", height / 2)
    return _lens_with_distortion(
        entry, {"fx": known[0], "fy": known[-1], "cx": center[0], "cy": center[1]}
    )


def _panorama(entry: dict[str, Any], height: int, width: int) -> Equirectangular:
    """ValueError where a key says that the picture is not a whole one.

    nerfstudio writes half the width and the height as focal lengths.
    """
    wanted = {"fl_x": width / 2, "fl_y": height, "cx": width / 2, "cy": height / 2}
    for key in wanted.keys() & entry.keys():
        if not abs(number_of(entry, key) - wanted[key]) <= 1:
            raise ValueError(
                f"{key} is {entry[key]!r}, and that of a panorama of this size is {wanted[key]:g}: "
                "remove it"
            )
    for key in ("is_fisheye", *sorted(_PLACE_KEYS - wanted.keys())):
        if _says_something(entry.get(key)):
            raise ValueError(
                f"{key} is {entry[key]!r:.60}, which a panorama does not have: remove it"
            )
    coefficients = _coefficients(entry, fisheye=True)
    _require_zero(coefficients, _COEFFICIENTS, f"camera_model {PANORAMA}")
    return Equirectangular()


def _lens_with_distortion(entry: dict[str, Any], pinhole: dict[str, float]) -> Lens:
    model = entry.get("camera_model", PERSPECTIVE)
    fisheye = _is_fisheye(entry, model)
    coefficients = _coefficients(entry, fisheye)
    _require_zero(coefficients, _FOREIGN.get(model, ()), f"camera_model {model}")
    if fisheye:
        _require_zero(coefficients, ("p1", "p2", "k5", "k6"), "a fisheye lens")
        return lens_from_parameters(pinhole | coefficients, fisheye=True)
    if model == RATIONAL:
        return lens_from_parameters(pinhole | coefficients)
    _require_zero(coefficients, ("k5", "k6"), f"a camera_model other than {RATIONAL}")
    # The fourth radial term here, in OpenCV's model a coefficient of the denominator.
    radial_r8 = coefficients.pop("k4", 0.0)
    return lens_from_parameters(pinhole | coefficients, radial_r8=radial_r8)


def _focal(entry: dict[str, Any], axis: str, side: int) -> float | None:
    """In pixels; None where nothing is said of this axis."""
    if f"fl_{axis}" in entry:
        return number_of(entry, f"fl_{axis}")
    for key, unit in ((f"{axis}_fov", math.pi / 180), (f"camera_angle_{axis}", 1.0)):
        if key in entry:
            angle_rad = number_of(entry, key) * unit
            if not 0 < angle_rad < math.pi:
                raise ValueError(
                    f"{key} is {entry[key]!r}, no field of view (camera_angle_x and _y are in "
                    "radians, x_fov and y_fov in degrees)"
                )
            return side / 2 / math.tan(angle_rad / 2)
    return None


def _coefficients(entry: dict[str, Any], fisheye: bool) -> dict[str, float]:
    found = {key: number_of(entry, key) for key in _COEFFICIENTS if key in entry}
    listed = entry.get("distortion_params")
    if not _says_something(listed):
        return found
    if not isinstance(listed, list) or len(listed) not in (4, len(_PARAMS)):
        raise ValueError(f"distortion_params {listed!r:.60} are not {', '.join(_PARAMS)}")
    if len(listed) == 4 and not fisheye and _says_something(listed[2:]):
        raise ValueError(
            f"distortion_params {listed!r:.60} may end in k3, k4 or in p1, p2: give all of "
            f"{', '.join(_PARAMS)}"
        )
    from_list = {
        key: number_of({"distortion_params": value}, "distortion_params")
        for key, value in zip(_PARAMS, listed, strict=False)
    }
    if any(found.get(key, value) != value for key, value in from_list.items()):
        raise ValueError("distortion_params and k1, k2 … say different things: remove one of them")
    return found | from_list


def _is_fisheye(entry: dict[str, Any], model: Any) -> bool:
    if not isinstance(model, str) or model not in MODELS:
        raise ValueError(f"camera_model {model!r:.60} is none of {', '.join(MODELS)}")
    said = entry.get("is_fisheye", MODELS[model])
    if said not in (True, False):
        raise ValueError(f"is_fisheye is {said!r:.60}, neither true nor false")
    if "camera_model" in entry and bool(said) != MODELS[model]:
        raise ValueError(
            f"is_fisheye {said} and camera_model {model} contradict each other: remove one of them"
        )
    return bool(said)


def _require_zero(coefficients: dict[str, float], keys: tuple[str, ...], whose: str) -> None:
    for key in keys:
        if coefficients.get(key):
            raise ValueError(f"{key} is not a coefficient of {whose}, but {coefficients[key]}")


def _says_something(value: Any) -> bool:
    if isinstance(value, list):
        return any(_says_something(part) for part in value)
    return bool(value)


def number_of(entry: dict[str, Any], key: str, default: float | None = None) -> float:
    """The number of a key; ValueError that names the key where it is none.

    Raises KeyError where there is neither the key nor a default.
    """
    value: Any = entry[key] if default is None else entry.get(key, default)
    try:
        if isinstance(value, bool):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{key} is {json.dumps(value)[:60]}, no number") from None
