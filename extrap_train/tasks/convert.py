"""`task=convert`: a published checkpoint as a folder that diffusers and every command here load."""

from dataclasses import asdict, replace
from pathlib import Path

from extrap_train.config import TrainConfig, dotted
from extrap_train.diffusion.model_files import (
    is_own,
    published_config,
    published_model,
    save_model,
)
from extrap_train.diffusion.published.read import SOURCES, weights_at
from extrap_train.errors import InputError
from extrap_train.store import Outcome
from extrap_train.store.digests import weights_digest
from extrap_train.store.manifest import PUBLISHED, Manifest, Split, claim
from extrap_train.terminal import terminal

_REMEDY = "give another to= or resume=false to replace it"


def run(config: TrainConfig) -> Outcome:
    """Write the checkpoint that `weights` names to the folder `to`, with a manifest.

    Family and size are those of its tensors. The tensors are mapped from the file and written
    network by network, so that memory stays far below the file's size.
    """
    if config.weights is None or config.to is None:
        raise InputError(
            "task=convert needs a published checkpoint and a folder: give weights=FILE to=FOLDER"
        )
    source, folder, console = Path(config.weights), Path(config.to), terminal()
    if is_own(source):
        raise InputError(
            f"weights={source}: is a model folder of this project already; use it as it is"
        )
    checkpoint = weights_at(source)
    if checkpoint is None:
        raise InputError(f"weights={source}: no published checkpoint lies there; give {SOURCES}")
    model = published_config(str(source))
    options = dotted({"model": asdict(model)})
    content = {"published checkpoint": weights_digest(checkpoint)}
    # It has learnt nothing of this project's captures, and which ones it has is not known.
    split = {"all": Split(PUBLISHED, (), ())}
    with claim(
        folder, Manifest.of(options, content, split), resume=config.resume, remedy=_REMEDY
    ) as result:
        if not result.is_reused:
            described = replace(model, start=str(source.resolve()))
            with result.replace() as made:
                save_model(published_model(str(source), described), made)
    widths = ", ".join(map(str, model.unet.channels))
    console.print(f"recognised: {model.family}, denoiser of widths {widths}")
    if result.is_reused:
        console.print("converted before from the same file: reused")
    console.print(f"use it: weights={folder}\nresult: {folder}")
    return Outcome(folder, result.is_reused)
