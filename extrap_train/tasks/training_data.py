"""The pairs that a category is trained on and measured on: no capture may be on both sides."""

from collections.abc import Callable

from extrap_train.config import TrainConfig
from extrap_train.data.examples import ExampleReader
from extrap_train.data.feature_files import FeatureFiles, FrameEncoder
from extrap_train.data.module import PairModule
from extrap_train.data.prepared import PreparedData
from extrap_train.diffusion.frozen_features import frame_encoder, has_frozen_networks
from extrap_train.diffusion.leakage import trainings_of
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError
from extrap_train.store.manifest import Manifest

Prepare = Callable[[TrainConfig], list[PreparedData]]
"""Prepares every member of the category, or finds what was prepared before."""


def data_module(
    config: TrainConfig, prepared: list[PreparedData], encoder: FrameEncoder | None = None
) -> PairModule:
    """Training and held-out pairs; InputError where there are none of either.

    Training reads what the `encoder` has said of its frames, where one is given.
    """
    train = ExampleReader(prepared, "train", config.model.references, encoder)
    validation = ExampleReader(prepared, "test", config.model.references)
    for split, reader in (("training", train), ("test", validation)):
        if not len(reader):
            raise InputError(
                f"no {split} pairs for {config.category.name}: see the preparation's report, "
                f"and loosen the options under prep"
            )
    return PairModule(train, validation, config)


def cached_encoder(
    config: TrainConfig,
    model: ExtrapolationModel,
    prepared: list[PreparedData],
    say: Callable[[str], None],
) -> FrameEncoder | None:
    """The encoder whose cached features `trainer.latents` asks for; None to compute them.

    Raises InputError where they are asked for and not all there; with `auto` says what is done.
    """
    if config.trainer.latents == "computed":
        return None
    option = f"trainer.latents={config.trainer.latents}"
    if not has_frozen_networks(config.model):
        if config.trainer.latents == "auto":
            return None
        raise InputError(
            f"{option}: model={config.model.name} has no frozen networks; leave it out"
        )
    encoder = frame_encoder(model)
    files = [FeatureFiles(data, encoder) for data in prepared]
    wanted = sum(len(each.sequences) for each in files)
    missing = sum(len(each.missing()) for each in files)
    if not missing:
        say(f"{option}: frames of {wanted} training sequences were encoded before")
        return encoder
    lacking = (
        f"{missing} of {wanted} training sequences are not encoded by these weights at "
        f"{config.model.image_size} pixels; python -m data_prep with the same options, model="
        f"{config.model.name} and model.start=… encodes them"
    )
    if config.trainer.latents == "cached":
        raise InputError(f"{option}: {lacking}")
    say(f"{option}: computed in every step ({lacking})")
    return None


def require_unseen(start: str | None, manifest: Manifest) -> None:
    """Raise InputError if a held-out capture is one that the start (`model.start`) has seen."""
    for seen in trainings_of(start):
        for category, split in manifest.split.items():
            if not (names := seen.find_leaks(category, split)):
                continue
            through = "" if seen.model == start else f", by way of {seen.model}"
            remedy = _other_seed(seen.split.train[0]) if split.source == "synthetic" else _OTHERS
            raise InputError(
                f"model.start={start} was trained on {_listed(names)} of {category}{through}, "
                f"which this run would hold out for testing; {remedy}, or model.start=null"
            )


_OTHERS = "hold out others (data.test_sequences, data.set_list)"


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _other_seed(first_seen: str) -> str:
    """The first rendered captures are held out, and another seed renders others."""
    count = int(first_seen) if first_seen.isdigit() else 0
    fewer = f"data.test_sequences={count} or fewer, " if count else ""
    return f"give {fewer}another data.seed"
