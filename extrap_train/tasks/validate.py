"""`task=validate`: a finished run measured again, sampled as the options under `sampler` say."""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from extrap_train.config import TrainConfig, sampler_for
from extrap_train.diffusion.checkpoint import load_model
from extrap_train.runs import RunFolder, existing_run
from extrap_train.tasks.measure import RunData, measure
from extrap_train.tasks.results import Finished


def run(config: TrainConfig) -> Path:
    """Sample the held-out views with the run's model and leave the scores beside the run's own."""
    trained = existing_run(config)
    data = RunData.of(trained, config)
    steps = Finished.read(trained).steps
    model = load_model(trained.model)
    sampler = sampler_for(config.sampler, model.config)
    how = {"sampler": asdict(sampler), "validation": asdict(config.validation)}
    digest = hashlib.sha256(json.dumps(how, sort_keys=True).encode()).hexdigest()[:8]
    folder = RunFolder(trained.path / "validations" / f"seed{config.seed}-{digest}")
    measure(model, steps, config, data, folder)
    return folder.path
