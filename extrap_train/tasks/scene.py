"""`task=scene`: a category model adapted to one scene from its input views alone."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
from lightning.fabric import Fabric
from rich.console import Console

from extrap_train.config import TrainConfig, dotted, sampler_for
from extrap_train.data.examples import linspace_indices
from extrap_train.data.scene_pairs import AdaptationPairs, adaptation_pairs
from extrap_train.data.scene_spec import scene_address
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.data.square_frames import target_views
from extrap_train.device import advise_on_adapting_memory, trainer_precision
from extrap_train.diffusion.adaptation import Adaptation, adapt
from extrap_train.diffusion.evaluation import missing_scores, score_images, summarise
from extrap_train.diffusion.generator import GeneratedViews
from extrap_train.diffusion.lora import (
    AdapterOrigin,
    adapter_bytes,
    add_adapter,
    read_adapter_record,
    save_adapter,
)
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError
from extrap_train.figures import draw_contact_sheet, error_map, mark_holes, plot_curve
from extrap_train.metrics import Distance, lpips_or_reason
from extrap_train.store import Outcome
from extrap_train.store.atomic import write_atomic
from extrap_train.store.digests import file_digest
from extrap_train.store.manifest import Claim, claim
from extrap_train.store.records import read_record, write_summary
from extrap_train.tasks.scene_inputs import (
    InputViews,
    input_frames,
    label_of,
    nothing_kept,
    open_inputs,
    open_sequence,
    photograph_digests,
    require_space,
    required_scene,
    result_folder,
    scene_manifest,
)
from extrap_train.tasks.scene_model import (
    UsedWeights,
    device_of,
    generate_views,
    model_options,
    named_weights,
    scene_generator,
    trained_model,
)
from extrap_train.terminal import progress, terminal
from extrap_train.views import View, stack_cameras

_PICTURES_BYTES = 2**20
"""About what tables and pictures take on the disk beside the adapter."""


def run(config: TrainConfig) -> Outcome:
    """Train an adapter for `minutes`; leave it with its numbers and pictures.

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
    named_weights(config)  # refused before cameras are estimated, which may take minutes
    sequence = open_sequence(config)
    folder, used = result_folder(config, label_of(sequence)), UsedWeights.of(config)
    read = _frames_read(config, sequence)
    options = _options(config) | model_options(config)
    digests, lpips = used.inputs(), config.validation.lpips_weights
    if lpips is not None:
        digests["weights of LPIPS"] = file_digest(Path(lpips))
    manifest = scene_manifest(config, read, digests, options)
    with nothing_kept(), claim(folder, manifest, resume=config.resume) as result:
        is_reused = result.is_reused and _is_whole(folder)
        if is_reused:
            console.print("already adapted with these options, photographs and weights")
        else:
            _run(config, sequence, result, used, console)
    console.print(f"result: {folder}")
    return Outcome(folder, is_reused)


def _run(
    config: TrainConfig, sequence: FrameSequence, result: Claim, used: UsedWeights, console: Console
) -> None:
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    model = trained_model(config).to(device_of(config))
    inputs = open_inputs(config, sequence, model.config.warp_size)
    pairs = adaptation_pairs(
        inputs.views, model.config.num_condition_views, config.lora.virtual_references, config.seed
    )
    sampler = sampler_for(config.sampler, model.config)
    measured_on = linspace_indices(len(inputs.others), config.validation.examples)
    targets = target_views([inputs.others[i] for i in measured_on], model.config.image_size)
    before = _generate(model, config, inputs, targets)
    if config.trainer.gradient_checkpointing:
        model.unet.enable_gradient_checkpointing()
    adapter = add_adapter(model, config.lora, config.seed)
    require_space(result.folder, adapter_bytes(adapter) + _PICTURES_BYTES)
    advice = advise_on_adapting_memory(config.lora, config.trainer)
    with progress("adapting", 100, "%") as bar, advice:
        bar.reach(0, "measuring the base")

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
            fabric=Fabric(
                accelerator=config.trainer.accelerator,
                devices=1,
                precision=cast(Any, trainer_precision(config.trainer)),
            ),
            on_step=on_step,
        )
    after = _generate(model, config, inputs, targets)
    origin = _origin(config, sequence, inputs, used)
    with result.replace() as whole:
        save_adapter(model, adapter, whole / "adapter", origin)
        measured = _measure(before, after, targets, whole, distance)
        read = [view.name for view in inputs.views], [view.name for view in targets]
        _write(whole, read, used, done, pairs, measured, missing)
    console.print(f"adapted {used}: {_describe(done, measured)}")


def _frames_read(config: TrainConfig, sequence: FrameSequence) -> list[Frame]:
    """The input frames and those that the adapter is measured on."""
    part, chosen = input_frames(config, sequence)
    inputs = [part.frames[i] for i in chosen]
    names = {frame.name for frame in inputs}
    others = [frame for frame in sequence.frames if frame.name not in names]
    return inputs + [others[i] for i in linspace_indices(len(others), config.validation.examples)]


def _options(config: TrainConfig) -> dict[str, Any]:
    """The options that decide an adapter and its scores."""
    adapting = {
        "lora": asdict(config.lora),
        "minutes": config.minutes,
        "validation.examples": config.validation.examples,
        "validation.lpips_weights": config.validation.lpips_weights,
    }
    return dotted(adapting)


def _origin(
    config: TrainConfig,
    sequence: FrameSequence,
    inputs: InputViews,
    used: UsedWeights,
) -> AdapterOrigin:
    learnt = {view.name for view in inputs.views}
    return AdapterOrigin(
        scene=scene_address(required_scene(config)),
        photographs=photograph_digests(f for f in sequence.frames if f.name in learnt),
        weights=used.name,
    )


@dataclass(frozen=True)
class _Finished:
    """The part of a summary that a whole result must have."""

    adaptation: Adaptation


def _is_whole(folder: Path) -> bool:
    """Whether the adapter lies there with its numbers, neither of them damaged."""
    try:
        read_record(folder / "summary.json", _Finished, "")
        read_adapter_record(folder / "adapter")
    except InputError as error:
        terminal(stderr=True).print(f"{error}: adapting again")
        return False
    return True


def _generate(
    model: ExtrapolationModel,
    config: TrainConfig,
    inputs: InputViews,
    targets: list[View],
) -> GeneratedViews | None:
    if not targets:
        return None
    cameras, names = stack_cameras([v.camera for v in targets]), [v.name for v in targets]
    return generate_views(scene_generator(config, model), inputs.views, cameras, names, config)


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
    whole = torch.ones_like(truth[0, 0])
    shown = torch.stack([whole if view.mask is None else view.mask.round() for view in targets])
    scores = score_images(images, truth, after.warp.mask, shown, names, distance)
    write_atomic(folder / "held_out.csv", scores.to_csv(index=False).encode())
    draw_contact_sheet(
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
    read: tuple[list[str], list[str]],
    used: UsedWeights,
    done: Adaptation,
    pairs: AdaptationPairs,
    measured: dict[str, dict[str, float]],
    missing: dict[str, str],
) -> None:
    steps, errors = [list(column) for column in zip(*done.held_out_errors, strict=True)]
    plot_curve(steps, {"held-out pair": errors}, "denoising error", folder / "curve.png")
    summary = {
        "generated_with": asdict(used),
        "inputs": read[0],
        "held_out_frames": read[1],
        "pairs": pairs.counts(),
        "adaptation": asdict(done),
        "held_out": measured,
        "missing": missing_scores(missing)
        if measured
        else {"held_out": "every frame of the scene is an input"},
    }
    write_summary(folder, summary)


def _describe(done: Adaptation, measured: dict[str, dict[str, float]]) -> str:
    text = _describe_end(done)
    if measured:
        one, other = measured["model"], measured["adapted"]
        text += f"; held-out views: PSNR {one['psnr']:.2f} → {other['psnr']:.2f} dB"
        if not math.isnan(one["lpips"]):
            text += f", LPIPS {one['lpips']:.3f} → {other['lpips']:.3f}"
    return text


def _describe_end(done: Adaptation) -> str:
    if not done.steps:
        return (
            f"the time was up after {done.seconds:.0f} s, before the first step: give more minutes="
        )
    kept = f"kept step {done.best_step} of {done.steps}" if done.best_step else "kept the base"
    return f"ended by {done.ended} after {done.seconds:.0f} s, {kept}"
