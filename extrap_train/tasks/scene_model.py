"""The model that a task about one scene generates with: weights, adapter and generator."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from lightning.fabric import Fabric

from extrap_train.config import ModelConfig, TrainConfig, dotted, packaged_names, sampler_for
from extrap_train.data.scene_spec import scene_address
from extrap_train.data.sequences import Frame
from extrap_train.device import advise_on_sampling_memory, require_accelerator
from extrap_train.diffusion.generator import DiffusionGenerator, GeneratedViews
from extrap_train.diffusion.hub import weights_folder
from extrap_train.diffusion.lora import load_adapter, read_adapter_record
from extrap_train.diffusion.model import ExtrapolationModel, use_channels_last
from extrap_train.diffusion.model_files import is_own, load_model, published_model, saved_config
from extrap_train.diffusion.packaged import packaged_name, packaged_steps
from extrap_train.errors import InputError
from extrap_train.runs import Finished, RunFolder, newest_run
from extrap_train.store.digests import folder_digest, weights_digest
from extrap_train.tasks.scene_inputs import frame_digest, required_scene
from extrap_train.terminal import terminal
from extrap_train.views import Camera, View


@dataclass(frozen=True)
class UsedWeights:
    """Which weights a result was generated with."""

    name: str
    """A packaged model's or a repository's, or an absolute path."""
    sha256: str
    is_packaged: bool
    steps: int | None
    """That they were trained for; None if that is not known, as of published weights."""
    adapter: str | None
    adapter_sha256: str | None

    @classmethod
    def of(cls, config: TrainConfig) -> "UsedWeights":
        """The weights and the adapter that the options name; InputError if there are none."""
        name = named_weights(config)
        path, adapter = Path(name), config.adapter and Path(config.adapter)
        if adapter and not adapter.is_dir():
            raise InputError(f"adapter={adapter}: no such folder; give an adapter of task=scene")
        run, steps = RunFolder(path.parent), packaged_steps(name)
        is_packaged = name in packaged_names()
        if not is_packaged and path == run.model and run.summary.is_file():
            finished = Finished.read(run)
            finished.require_its_model(run)
            steps = finished.steps
        return cls(
            name=name,
            sha256=weights_digest(_folder_of(name)),
            is_packaged=is_packaged,
            steps=steps,
            adapter=str(adapter.resolve()) if adapter else None,
            adapter_sha256=folder_digest(adapter) if adapter else None,
        )

    def __str__(self) -> str:
        about = ["packaged"] if self.is_packaged else []
        about += [] if self.steps is None else [f"{self.steps:,} steps"]
        described = f" ({', '.join(about)})" if about else ""
        return f"{self.name}{described}{f', adapter {self.adapter}' if self.adapter else ''}"

    def inputs(self) -> dict[str, str]:
        """Their digests, as a manifest lists what it was made from."""
        found = {"weights": self.sha256}
        return found if self.adapter_sha256 is None else {**found, "adapter": self.adapter_sha256}


def model_options(config: TrainConfig) -> dict[str, Any]:
    """The options that say how published weights are read; a saved model says so itself."""
    if is_own(_folder_of(named_weights(config))):
        return {}
    return _flat(config.model)


def trained_model(config: TrainConfig) -> ExtrapolationModel:
    """The model that `weights` names, with its adapter if any; by default the category's newest.

    Before there is a run, it is the packaged model of the category. Prints a warning if the
    adapter was made for another scene.
    """
    _warn_of_another_scene(config)
    return model_of(config, named_weights(config))


def model_of(config: TrainConfig, weights: str) -> ExtrapolationModel:
    """The model that a command uses: as it was saved, or a published one, as `model` describes it.

    Raises InputError for an option of the command line that a saved model contradicts.
    """
    folder = _folder_of(weights)
    if not is_own(folder):
        return open_model(weights, config.adapter, config.model)
    require_saved_options(saved_config(folder), config.model, folder)
    return open_model(weights, config.adapter)


def frames_learnt(config: TrainConfig, frames: Iterable[Frame]) -> list[str]:
    """Those of the frames whose content the adapter was trained on; none without an adapter."""
    if config.adapter is None:
        return []
    learnt = set(read_adapter_record(Path(config.adapter)).photographs.values())
    return [frame.name for frame in frames if frame_digest(frame) in learnt]


def _warn_of_another_scene(config: TrainConfig) -> None:
    if config.adapter is None:
        return
    origin, here = read_adapter_record(Path(config.adapter)), scene_address(required_scene(config))
    if origin.scene != here:
        terminal(stderr=True).print(
            f"adapter={config.adapter}: was made for {origin.scene}, not for {here}; the model "
            "without it may do better on this scene"
        )


def named_weights(config: TrainConfig) -> str:
    """What `weights` names, or what takes its place: an absolute path, or the name of a packaged
    model or a repository.

    Raises InputError where nothing does.
    """
    if config.weights in packaged_names():
        return str(config.weights)
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
    """The model of a folder, the package, a repository or a published checkpoint, with a scene's
    adapter applied if any.

    A published checkpoint is read as the model that `config` describes, by default as the one that
    its tensors show.
    """
    path = _folder_of(weights)
    if is_own(path):
        if config is not None:
            raise InputError(f"weights={weights}: says itself what it is; leave config out")
        model = load_model(path)
    else:
        model = published_model(weights, config)
    if adapter is not None:
        load_adapter(model, Path(adapter))
    return use_channels_last(model).eval()


def _folder_of(weights: str) -> Path:
    """What `weights` names: a path, or the folder of a packaged model or a repository."""
    path = Path(weights)
    is_path = weights not in packaged_names() and path.exists()
    return path if is_path else weights_folder(weights, "weights")


def device_of(config: TrainConfig) -> torch.device:
    """Where the network runs; InputError where there is no such device."""
    require_accelerator(config.trainer.accelerator)
    return Fabric(accelerator=config.trainer.accelerator, devices=1).device


def scene_generator(config: TrainConfig, model: ExtrapolationModel) -> DiffusionGenerator:
    """The generator of every task about a scene: sampler and precision as the options say."""
    sampler = sampler_for(config.sampler, model.config)
    return DiffusionGenerator(
        model, sampler, config.sample_batch_size, precision=config.trainer.precision
    )


def generate_views(
    generator: DiffusionGenerator,
    views: Sequence[View],
    cameras: Camera,
    names: Sequence[str],
    config: TrainConfig,
) -> GeneratedViews:
    """The generator's views; InputError that says which option to change where memory ends."""
    with advise_on_sampling_memory(config.sample_batch_size, config.trainer):
        return generator.generate(views, cameras, names, config.seed)


def require_saved_options(saved: ModelConfig, asked: ModelConfig, folder: Path) -> None:
    """InputError for the first `model` option of the command line that the saved model contradicts.

    What the command line leaves out, `asked` has by default, and the saved model as it is. Of
    `model=NAME` the family must be the model's.
    """
    said = [name for name in _cli_overrides() if name != "model.name"]  # names its runs' folder
    found, wanted = _flat(saved), _flat(asked)
    for name in wanted:
        is_said = any(f"{name}.".startswith(f"{option}.") for option in said)
        if is_said and wanted[name] != (is_so := found.get(name)):
            remedy = "remove this option, or give weights= that were trained with it"
            if name.startswith("model.sampler."):
                remedy = f"give {name.removeprefix('model.')}= instead"
            if name == "model.image_size":
                remedy += (
                    f" (task=category {name}={asked.image_size} prep.image_size={asked.warp_size})"
                )
            raise InputError(
                f"{name}={wanted[name]}: the weights {folder} fix {name}={is_so}; {remedy}"
            )


def _cli_overrides() -> list[str]:
    """Options under `model` that the command line sets, and the family where it chooses a model;
    none where no command line was read.
    """
    if not HydraConfig.initialized():
        return []
    words = HydraConfig.get().overrides.task
    names = [word.partition("=")[0].lstrip("+~") for word in words]
    said = [name for name in names if name.startswith("model.")]
    return said + (["model.family"] if "model" in names else [])


def _flat(model: ModelConfig) -> dict[str, Any]:
    return dotted({"model": asdict(model)})
