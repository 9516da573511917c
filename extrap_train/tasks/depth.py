"""`task=depth`: train the network that gives generated views their depth."""

from collections.abc import Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from extrap_train.config import (
    SyntheticConfig,
    TrainConfig,
    dotted,
)
from extrap_train.data.scene_spec import SYNTHETIC_SCHEME, open_scene
from extrap_train.data.synthetic import build_scene, trace
from extrap_train.data.synthetic.capture import sequence_name, walk_seed
from extrap_train.depth.sources import depth_source, source_of_generated
from extrap_train.diffusion.generator import DiffusionGenerator
from extrap_train.diffusion.packaged import packaged_name
from extrap_train.errors import InputError
from extrap_train.reconstruction.depth_prediction.depth_examples import MIN_FRAMES, draw_examples
from extrap_train.reconstruction.depth_prediction.network import save_depth_network
from extrap_train.reconstruction.depth_prediction.network_training import (
    DepthScores,
    DepthTraining,
    StoredExamples,
    calibrate,
    save_examples,
)
from extrap_train.runs import given_name
from extrap_train.store import Outcome
from extrap_train.store.manifest import Manifest, claim
from extrap_train.store.records import write_summary
from extrap_train.tasks.scene_model import open_model
from extrap_train.terminal import progress, terminal

_TRAINER_OPTIONS = ("batch_size", "warmup_steps", "lr_decay_start", "ema_decay")
"""What a run depends on; steps and checkpoints may change when it is continued."""


def run(config: TrainConfig) -> Outcome:
    """Draw the examples that are missing, train, and write `depth_network.safetensors`.

    A second run resumes after the last checkpoint; more `data.train_sequences` are added to what
    is there.
    """
    data = config.data
    if not isinstance(data, SyntheticConfig):
        raise InputError(
            f"data={data.name}: task=depth needs captures whose depth is known everywhere; use "
            "data=synthetic"
        )
    if data.frames < MIN_FRAMES:
        raise InputError(
            f"data.frames={data.frames}: task=depth needs at least {MIN_FRAMES} a capture"
        )
    folder = Path(config.output) / "depth" / (given_name(config) or config.category.name)
    with claim(folder, _manifest(config), resume=config.resume) as claimed:
        if not claimed.is_reused:
            claimed.begin()
        held_out = range(data.test_sequences)
        learnt = range(data.test_sequences, data.test_sequences + data.train_sequences)
        _draw_missing(config, data, folder, [*held_out, *learnt])
        training = DepthTraining(config.trainer, config.seed)
        checkpoint, console = folder / "checkpoint.pt", terminal()
        if checkpoint.is_file():
            training.load(checkpoint)
            console.print(f"resuming at step {training.step}: {folder}")
        before = training.step
        _train(training, _stored(config, folder, learnt), checkpoint)
        network = training.averaged_network()
        scores = calibrate(network, _stored(config, folder, held_out).captures())
        save_depth_network(network, folder / "depth_network.safetensors")
        summary = {"steps": training.step, "held_out": asdict(scores)}
        write_summary(folder, summary)
        _print_scores(scores, folder, console)
    return Outcome(folder, is_reused=training.step == before)


def _manifest(config: TrainConfig) -> Manifest:
    options = dotted(
        {
            "category": asdict(config.category),
            "data": asdict(config.data),
            "depth": asdict(source_of_generated(config.depth)),
        }
    )
    del options["data.train_sequences"]  # a run may be continued with more captures
    trainer = {f"trainer.{name}": getattr(config.trainer, name) for name in _TRAINER_OPTIONS}
    return Manifest.of(options | trainer | {"seed": config.seed})


def _example_file(folder: Path, category: str, index: int) -> Path:
    return folder / "examples" / f"{category}-{sequence_name(index)}.npy"


def _stored(config: TrainConfig, folder: Path, indices: Iterable[int]) -> StoredExamples:
    members = config.category.members
    return StoredExamples([_example_file(folder, c, i) for i in indices for c in members])


def _draw_missing(
    config: TrainConfig, data: SyntheticConfig, folder: Path, indices: list[int]
) -> None:
    """Draw the examples of every capture that has no file yet, with the packaged generators."""
    wanted = [(member, index) for index in indices for member in config.category.members]
    missing = [pair for pair in wanted if not _example_file(folder, *pair).is_file()]
    source = depth_source(source_of_generated(config.depth))
    generators = {member: _generator(member) for member in {member for member, _ in missing}}
    with progress("drawing examples", len(missing), "captures") as bar:
        for category, index in missing:
            name = sequence_name(index)
            rng = np.random.default_rng((config.seed, walk_seed(category, index, data.seed)))
            examples = draw_examples(
                open_scene(f"{SYNTHETIC_SCHEME}{category}/{name}", data).frames,
                partial(trace, build_scene(category, index, data.seed)),
                generators[category],
                source,
                rng,
            )
            save_examples(examples, _example_file(folder, category, index))
            bar.advance()


def _generator(category: str) -> DiffusionGenerator:
    model = open_model(packaged_name("ours", category))
    return DiffusionGenerator(model, model.config.sampler)


def _train(training: DepthTraining, examples: StoredExamples, checkpoint: Path) -> None:
    options = training.options
    left = max(0, options.steps - training.step)
    losses: list[float] = []
    with progress("training", left, "steps") as bar:
        for _ in range(left):
            losses.append(training.advance(examples))
            bar.advance()
            if training.step % options.checkpoint_every == 0 or training.step == options.steps:
                training.save(checkpoint)
                with checkpoint.with_name("loss.csv").open("a") as curve:
                    curve.write(f"{training.step},{np.mean(losses):.4f}\n")
                losses.clear()


def _print_scores(scores: DepthScores, folder: Path, console: Console) -> None:
    console.print(
        f"held-out captures, object pixels that no reference shows for certain: median error "
        f"{scores.median_error:.1%}, {scores.within:.0%} within 2 %; {scores.confident:.0%} have a "
        f"confidence of at least 50 %, of which {scores.confident_and_within:.0%} are within 2 %\n"
        f"result: {folder}"
    )
