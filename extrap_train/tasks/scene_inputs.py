"""What the tasks about one scene start from: its views, and the model that sees them."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from lightning.fabric import Fabric

from data_prep.views import choose_frames, input_views
from extrap_train.config import ModelConfig, SyntheticConfig, TrainConfig, sampler_for
from extrap_train.data.photographs import CATEGORY
from extrap_train.data.scene import open_scene, scene_address
from extrap_train.data.sequences import Frame, Sequence
from extrap_train.depth.build import depth_source
from extrap_train.device import require_accelerator
from extrap_train.diffusion.adapter_card import AdapterOrigin
from extrap_train.diffusion.checkpoint import is_own, load_model, published_model, saved_config
from extrap_train.diffusion.generator import DiffusionGenerator, GeneratedViews
from extrap_train.diffusion.layout import arranged
from extrap_train.diffusion.lora import load_adapter, saved_origin
from extrap_train.diffusion.memory import advice_where_painting_ends
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.packaged import packaged_name, packaged_names, packaged_weights
from extrap_train.errors import InputError
from extrap_train.runs import newest_run
from extrap_train.tasks.saved_model import require_as_said, require_described
from extrap_train.terminal import terminal
from extrap_train.views import Camera, View


@dataclass(frozen=True)
class SceneInputs:
    """A scene's chosen views with depth, and its frames that are left over."""

    views: list[View]
    """Square, at the size that a model's warps are made at."""
    others: list[Frame]


def required_scene(config: TrainConfig) -> str:
    """The scene's address; raises InputError where none is given."""
    if config.scene is None:
        raise InputError(
            f"task={config.task} needs a scene: give scene=FOLDER, "
            "scene=co3d:ROOT/category/sequence or scene=synthetic:category/0003"
        )
    return config.scene


def open_sequence(config: TrainConfig) -> Sequence:
    """The scene's frames, of which no photograph has been read yet."""
    synthetic = config.data if isinstance(config.data, SyntheticConfig) else None
    return open_scene(required_scene(config), synthetic)


def label_of(sequence: Sequence) -> str:
    """The scene's name in a path."""
    if sequence.category == CATEGORY:
        return sequence.name
    return f"{sequence.category}-{sequence.name}"


def input_frames(
    config: TrainConfig, sequence: Sequence, query: str | None = None
) -> tuple[Sequence, list[int]]:
    """The frames that inputs are chosen from, and the places of those that are; see `open_inputs`.

    Reads no photograph. Raises InputError where there are too few.
    """
    known = tuple(frame for frame in sequence.frames if frame.name != query)
    part = sequence if config.input_frames else replace(sequence, frames=known)
    if not part.frames:
        raise InputError(
            f"scene {config.scene}: {query} is its only frame, and is asked for; give more"
        )
    return part, choose_frames(part, config.input_frames, config.inputs)


def open_inputs(
    config: TrainConfig, sequence: Sequence, image_size: int, query: str | None = None
) -> SceneInputs:
    """The scene's input views at this size; depth comes from these views alone.

    The frame called `query` is none of them, so that it can be compared with, unless
    `input_frames` names it.
    """
    part, chosen = input_frames(config, sequence, query)
    views = input_views(part, chosen, depth_source(config.depth), image_size)
    names = {view.name for view in views}
    others = [frame for frame in sequence.frames if frame.name not in names]
    return SceneInputs(views, others)


def trained_model(config: TrainConfig) -> ExtrapolationModel:
    """The model that `weights` names, with its adapter if any; by default the category's newest.

    Before there is a run, the packaged model of the category takes its place, which is said; so is
    an adapter that was made for another scene.
    """
    _say_whose(config)
    if config.weights is not None:
        return model_of(config, config.weights)
    name, newest = named_weights(config), newest_run(config).model
    if not newest.is_dir():
        terminal(stderr=True).print(f"{newest}: there is none yet; weights={name}, of the package")
    return model_of(config, name)


def model_of(config: TrainConfig, weights: str) -> ExtrapolationModel:
    """The model that a command uses: as it was saved, or a published one, as `model` describes it.

    Raises InputError for an option of the command line that a saved model contradicts.
    """
    folder = _folder_of(weights)
    if not is_own(folder):
        return open_model(weights, config.adapter, config.model)
    require_as_said(saved_config(folder), config.model, folder)
    return open_model(weights, config.adapter)


def learnt_frames(config: TrainConfig) -> list[str]:
    """The scene's frames that the adapter was trained on, if there is one and it says so."""
    origin = _origin(config)
    if origin is None or origin.scene != scene_address(required_scene(config)):
        return []
    return origin.inputs


def _origin(config: TrainConfig) -> AdapterOrigin | None:
    return None if config.adapter is None else saved_origin(Path(config.adapter))


def _say_whose(config: TrainConfig) -> None:
    origin, here = _origin(config), scene_address(required_scene(config))
    if origin is not None and origin.scene != here:
        terminal(stderr=True).print(
            f"adapter={config.adapter}: was made for {origin.scene}, not for {here}, which the "
            "model alone may paint better"
        )


def named_weights(config: TrainConfig) -> str:
    """What `weights` names, or what takes its place: an absolute path, or a packaged model's name.

    Raises InputError where nothing does.
    """
    path = newest_run(config).model if config.weights is None else Path(config.weights)
    if path.exists():
        return str(path.resolve())
    return config.weights or _packaged(config)


def _packaged(config: TrainConfig) -> str:
    """The packaged model of this configuration; InputError where there is none."""
    name = packaged_name(config.model.family, config.category.name)
    if config.model.name.startswith("small") and name in packaged_names():
        return name
    raise InputError(
        f"{newest_run(config).model}: there is no trained model of {config.category.name}; train "
        "one (task=category), or give weights=FOLDER or a packaged model's name: "
        f"{', '.join(packaged_names())}"
    )


def open_model(
    weights: str, adapter: str | None = None, config: ModelConfig | None = None
) -> ExtrapolationModel:
    """The model of a folder, of the package or of a published checkpoint, with a scene's adapter
    upon it if any.

    A published checkpoint says not what it is: it is read as the model that `config` describes.
    InputError where that is another than the saved one.
    """
    path = _folder_of(weights)
    if is_own(path):
        if config is not None:
            require_described(saved_config(path), config, path)
        model = load_model(path)
    elif config is not None:
        model = published_model(weights, config)
    else:
        raise InputError(
            f"weights={weights}: is no model folder of this project; a published checkpoint needs "
            "the configuration of its model beside it"
        )
    if adapter is not None:
        load_adapter(model, Path(adapter))
    return arranged(model).eval()


def _folder_of(weights: str) -> Path:
    """What `weights` names: a path, or the folder of a packaged model."""
    path = Path(weights)
    return path if path.exists() else packaged_weights(weights, "weights")


def device_of(config: TrainConfig) -> torch.device:
    """Where the network runs; InputError where there is no such device."""
    require_accelerator(config.trainer.accelerator)
    return Fabric(accelerator=config.trainer.accelerator, devices=1).device


def painter(config: TrainConfig, model: ExtrapolationModel) -> DiffusionGenerator:
    """What paints the scene's views with the model, as the options say."""
    sampler = sampler_for(config.sampler, model.config)
    return DiffusionGenerator(
        model, sampler, config.painted_at_once, precision=config.trainer.precision
    )


def painted(
    generator: DiffusionGenerator,
    views: list[View],
    cameras: Camera,
    names: list[str],
    config: TrainConfig,
) -> GeneratedViews:
    """The generator's views; InputError that says what to turn where memory ends."""
    with advice_where_painting_ends(config.painted_at_once, config.trainer):
        return generator.generate(views, cameras, names, config.seed)
