"""`task=scene`: a category model adapted to one scene from its input views alone."""

import hashlib
import io
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from lightning.fabric import Fabric
from rich.console import Console

from data_prep.views import target_views
from extrap_train.config import SamplerConfig, TrainConfig, dotted, sampler_for
from extrap_train.data.module import spread
from extrap_train.data.scene import scene_address
from extrap_train.data.scene_pairs import AdaptationPairs, adaptation_pairs
from extrap_train.data.sequences import Sequence
from extrap_train.diffusion.adaptation import Adaptation, adapt
from extrap_train.diffusion.adapter_card import AdapterOrigin
from extrap_train.diffusion.evaluation import score_images, summarise
from extrap_train.diffusion.generator import GeneratedViews
from extrap_train.diffusion.lora import add_adapter, base_hashes, save_adapter, saved_base_hashes
from extrap_train.diffusion.memory import advice_where_adapting_ends
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError
from extrap_train.metrics import Distance, lpips_or_reason
from extrap_train.pictures import contact_sheet, curve, error_map, mark_holes
from extrap_train.store.atomic import write_atomic
from extrap_train.tasks.results import without_nan
from extrap_train.tasks.scene_folder import claimed, result_folder, scene_options, whole_result
from extrap_train.tasks.scene_inputs import (
    SceneInputs,
    device_of,
    label_of,
    named_weights,
    open_inputs,
    open_sequence,
    painted,
    painter,
    required_scene,
    trained_model,
)
from extrap_train.terminal import progress, terminal
from extrap_train.views import View, stack_cameras


def run(config: TrainConfig) -> Path:
    """Train an adapter for `minutes` and leave it with its numbers and pictures behind.

    What the input views leave over of the scene is held out: the model is measured there with and
    without the adapter. Adapter and numbers appear together, or, interrupted, not at all.
    """
    console = terminal()
    if config.adapter is not None:
        raise InputError("task=scene makes an adapter and takes none: leave adapter= out")
    if config.trainer.compile:
        raise InputError(
            "trainer.compile=true: task=scene trains for minutes, of which compiling takes most: "
            "leave it out"
        )
    sequence = open_sequence(config)
    folder, options = result_folder(config, label_of(sequence)), _options(config)
    with claimed(folder, options, resume=config.resume):
        _run(config, sequence, folder, options, console)
    console.print(f"result: {folder}")
    return folder


def _run(
    config: TrainConfig, sequence: Sequence, folder: Path, options: dict[str, Any], console: Console
) -> None:
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    model = trained_model(config).to(device_of(config))
    inputs = open_inputs(config, sequence, model.config.warp_size)
    pairs = adaptation_pairs(
        inputs.views, model.config.told_references, config.lora.virtual_references, config.seed
    )
    sampler = sampler_for(config.sampler, model.config)
    targets = _targets(config, inputs, model)
    asked = options | _content(model, inputs.views, targets, sampler)
    if config.resume and _is_done(folder, asked):
        console.print("already adapted with these options")
        return
    before = _generate(model, config, inputs, targets)
    if config.trainer.gradient_checkpointing:
        model.unet.enable_gradient_checkpointing()
    adapter = add_adapter(model, config.lora, config.seed)
    advice = advice_where_adapting_ends(config.lora, config.trainer)
    with progress("adapting", 100, "%") as bar, advice:

        def on_step(step: int, share: float) -> None:
            bar.reach(round(100 * min(share, 1.0)), f"step {step}")

        done = adapt(
            model,
            adapter,
            pairs,
            config.lora,
            sampler,
            seconds=60 * config.minutes,
            seed=config.seed,
            fabric=_fabric(config),
            on_step=on_step,
        )
    after = _generate(model, config, inputs, targets)
    with whole_result(folder, options) as whole:
        save_adapter(model, adapter, whole / "adapter", _origin(config, inputs, done))
        measured = _measure(before, after, targets, whole, distance)
        _write(whole, asked, done, pairs, measured, missing)
    console.print(_said(done, measured))


def _fabric(config: TrainConfig) -> Fabric:
    """Device and precision of the training."""
    precision: Any = config.trainer.precision
    return Fabric(accelerator=config.trainer.accelerator, devices=1, precision=precision)


def _options(config: TrainConfig) -> dict[str, Any]:
    """Of an adapter and its numbers."""
    adapting = {
        "lora": asdict(config.lora),
        "minutes": config.minutes,
        "validation.examples": config.validation.examples,
        "validation.lpips_weights": config.validation.lpips_weights,
    }
    return scene_options(config) | dotted(adapting)


def _origin(config: TrainConfig, inputs: SceneInputs, done: Adaptation) -> AdapterOrigin:
    options = {"lora": asdict(config.lora), "minutes": config.minutes, "seed": config.seed}
    return AdapterOrigin(
        scene=scene_address(required_scene(config)),
        inputs=[view.name for view in inputs.views],
        weights=named_weights(config),
        options=dotted(options),
        outcome=_outcome(done),
    )


def _content(
    model: ExtrapolationModel, views: list[View], targets: list[View], sampler: SamplerConfig
) -> dict[str, Any]:
    """What the result follows from beside the options: weights and views by what is in them."""
    return {
        "inputs": [view.name for view in views],
        "held_out": [view.name for view in targets],
        "views": _digest(views + targets),
        "model": asdict(model.config),
        "base": base_hashes(model),
        "sampler": asdict(sampler),
    }


def _digest(views: list[View]) -> str:
    digest = hashlib.sha256()
    for view in views:
        tensors = (view.image, view.depth, view.camera.world_to_cam, view.camera.intrinsics)
        for tensor in tensors:
            if tensor is not None:
                digest.update(tensor.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _is_done(folder: Path, asked: dict[str, Any]) -> bool:
    """Whether the adapter lies there that was made of this, with its numbers beside it."""
    try:
        found = json.loads((folder / "summary.json").read_text())["asked"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    same = found == json.loads(json.dumps(asked))
    return same and saved_base_hashes(folder / "adapter") == asked["base"]


def _targets(config: TrainConfig, inputs: SceneInputs, model: ExtrapolationModel) -> list[View]:
    chosen = spread(len(inputs.others), config.validation.examples)
    return target_views([inputs.others[i] for i in chosen], model.config.image_size)


def _generate(
    model: ExtrapolationModel,
    config: TrainConfig,
    inputs: SceneInputs,
    targets: list[View],
) -> GeneratedViews | None:
    if not targets:
        return None
    cameras, names = stack_cameras([v.camera for v in targets]), [v.name for v in targets]
    return painted(painter(config, model), inputs.views, cameras, names, config)


def _measure(
    before: GeneratedViews | None,
    after: GeneratedViews | None,
    targets: list[View],
    folder: Path,
    distance: Distance | None,
) -> dict[str, dict[str, float]]:
    """Scores on the held-out views with and without the adapter, and a picture of them."""
    if before is None or after is None:
        return {}
    truth = torch.stack([view.image for view in targets])
    images = {"model": before.images, "adapted": after.images}
    names = [view.name for view in targets]
    scores = score_images(images, truth, after.warp.mask, names, distance)
    text = io.StringIO()
    scores.to_csv(text, index=False)
    write_atomic(folder / "held_out.csv", text.getvalue().encode())
    contact_sheet(
        {
            "warp": mark_holes(after.warp.image, after.warp.mask),
            **images,
            "truth": truth,
            "error": error_map(after.images, truth),
        },
        folder / "held_out.png",
    )
    return summarise(scores)


def _write(
    folder: Path,
    asked: dict[str, Any],
    done: Adaptation,
    pairs: AdaptationPairs,
    measured: dict[str, dict[str, float]],
    missing: dict[str, str],
) -> None:
    steps, losses = [list(column) for column in zip(*done.losses, strict=True)]
    curve(steps, {"held-out pair": losses}, "denoising error", folder / "curve.png")
    summary = {
        "asked": asked,
        "pairs": pairs.counts(),
        "adaptation": asdict(done),
        "held_out": measured,
        "missing": missing if measured else {"held_out": "every frame of the scene is an input"},
    }
    content = json.dumps(without_nan(summary), indent=1) + "\n"
    write_atomic(folder / "summary.json", content.encode())


def _said(done: Adaptation, measured: dict[str, dict[str, float]]) -> str:
    text = _outcome(done)
    if measured:
        one, other = measured["model"], measured["adapted"]
        text += f"; held-out views: PSNR {one['psnr']:.2f} → {other['psnr']:.2f} dB"
        if not math.isnan(one["lpips"]):
            text += f", LPIPS {one['lpips']:.3f} → {other['lpips']:.3f}"
    return text


def _outcome(done: Adaptation) -> str:
    kept = f"kept step {done.best_step} of {done.steps}" if done.best_step else "kept the base"
    return f"ended by {done.ended} after {done.seconds:.0f} s, {kept}"
