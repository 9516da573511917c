"""`task=validate`: a finished run measured again, sampled as the options under `sampler` say."""

import time
from dataclasses import asdict, replace

from extrap_train.config import TrainConfig, dotted, sampler_for
from extrap_train.data.prepared import PreparedData
from extrap_train.device import require_accelerator
from extrap_train.diffusion.model import use_channels_last
from extrap_train.diffusion.model_files import load_model, saved_config
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.metrics import lpips_or_reason
from extrap_train.runs import Finished, RunFolder, existing_run, trained_on
from extrap_train.store import Outcome
from extrap_train.store.digests import folder_digest, json_digest
from extrap_train.store.manifest import Conflict, Manifest, claim, read_manifest
from extrap_train.tasks.category import quiet_trainer, quieten_lightning
from extrap_train.tasks.results import print_places, write_results
from extrap_train.tasks.scene_model import require_saved_options
from extrap_train.tasks.training_data import Prepare, data_module, require_unseen
from extrap_train.terminal import terminal


def run(config: TrainConfig, prepare: Prepare) -> Outcome:
    """Sample the held-out views with the run's model; leaves the scores in the run's folder.

    Views are sampled as the model recommends, but for what `config.sampler` says, and in the
    model's own groups.
    """
    trained, console = existing_run(config), terminal()
    started = time.perf_counter()
    prepared = prepare(config)
    _require_as_trained(trained, config, prepared)
    seconds = {"prepare": time.perf_counter() - started}
    finished = Finished.read(trained)
    finished.require_its_model(trained)
    steps = finished.steps
    model = load_model(trained.model)
    sampler = sampler_for(config.sampler, model.config)
    options = {"sampler": asdict(sampler), "validation": asdict(config.validation)}
    folder = RunFolder(
        trained.path / "validations" / f"seed{config.seed}-{json_digest(options)[:8]}"
    )
    manifest = Manifest.of(dotted(options), {"model": folder_digest(trained.model)})
    with claim(folder.path, manifest, resume=False) as result:
        quieten_lightning()
        distance, missing = lpips_or_reason(config.validation.lpips_weights)
        pairs = data_module(replace(config, model=model.config), prepared)
        names = pairs.validation_names()
        validation = CategoryTraining(use_channels_last(model), config, names, distance)
        require_accelerator(config.trainer.accelerator)
        trainer = quiet_trainer(config.trainer, devices=1, logger=False)
        trainer.validate(validation, pairs, verbose=False)
        seconds["validate"] = validation.validation_seconds
        with result.replace() as made:
            write_results(validation, prepared, missing, seconds, steps, RunFolder(made), console)
        print_places(folder, console)
    return Outcome(folder.path)


def _require_as_trained(
    trained: RunFolder, config: TrainConfig, prepared: list[PreparedData]
) -> None:
    """InputError where the options and what lies there today are not what a run was trained on, so
    that its model has never seen the held-out views.
    """
    before = read_manifest(trained.path, "train another run=NAME")
    inputs, split = trained_on(config, prepared)
    today = replace(before, inputs={**before.inputs, **inputs}, split=split)
    if differences := today.differences(before):
        raise Conflict(
            f"{trained.path}: trained on different {', '.join(differences)}; restore the data "
            "and their options, or measure another run=NAME"
        )
    saved = saved_config(trained.model)
    require_saved_options(saved, config.model, trained.model)
    require_unseen(saved.start, today)
