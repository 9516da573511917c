"""`task=validate`: a finished run measured again, sampled as the options under `sampler` say."""

import hashlib
import json
from dataclasses import asdict

from extrap_train.config import TrainConfig, dotted, sampler_for
from extrap_train.diffusion.checkpoint import load_model
from extrap_train.runs import Finished, RunFolder, existing_run
from extrap_train.store.cache import claim
from extrap_train.store.digests import folder_digest
from extrap_train.store.manifest import MANIFEST, Manifest
from extrap_train.store.outcome import Outcome
from extrap_train.store.records import write_record
from extrap_train.tasks.measure import RunData, measure
from extrap_train.tasks.training_data import Prepare


def run(config: TrainConfig, prepare: Prepare) -> Outcome:
    """Sample the held-out views with the run's model; leaves the scores in the run's folder."""
    trained = existing_run(config)
    data = RunData.of(trained, config, prepare)
    steps = Finished.read(trained).steps
    model = load_model(trained.model)
    sampler = sampler_for(config.sampler, model.config)
    options = {"sampler": asdict(sampler), "validation": asdict(config.validation)}
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:8]
    folder = RunFolder(trained.path / "validations" / f"seed{config.seed}-{digest}")
    manifest = Manifest.of(dotted(options), {"model": folder_digest(trained.model)})
    with claim(folder.path, manifest, resume=False):
        measure(model, steps, config, data, folder)
        write_record(folder.path / MANIFEST, manifest)
    return Outcome(folder.path)
