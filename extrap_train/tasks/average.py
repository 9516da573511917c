"""`task=average`: a trained model with averaged weights of another length, and how good it is."""

from pathlib import Path

from extrap_train.config import TrainConfig
from extrap_train.diffusion.averages import take_average
from extrap_train.diffusion.checkpoint import load_model, save_model
from extrap_train.runs import RunFolder, existing_run
from extrap_train.tasks.measure import RunData, measure
from extrap_train.trained_on import TrainedOn


def run(config: TrainConfig) -> Path:
    """Make the model of `average_width` from the run's snapshots and validate it as the run was."""
    trained = existing_run(config)
    data = RunData.of(trained, config)  # before anything is written
    model = load_model(trained.model)
    step = take_average(model, trained.averages, config.average_width)
    folder = RunFolder(trained.averages / f"width-{config.average_width:g}")
    save_model(model, folder.model)
    TrainedOn.read(trained.data).write(folder.data)
    measure(model, step, config, data, folder)
    return folder.path
