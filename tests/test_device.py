"""Running out of memory says what helps."""

from dataclasses import replace

import pytest
import torch

from extrap_train.config import TrainerConfig
from extrap_train.device import advise_on_training_memory
from extrap_train.errors import InputError

_OPTIONS = TrainerConfig(batch_size=2, precision="32-true")


@pytest.mark.parametrize(
    ("options", "helps"),
    [
        (_OPTIONS, "give trainer.gradient_checkpointing=true or trainer.batch_size=1"),
        (
            replace(_OPTIONS, gradient_checkpointing=True),
            r"give trainer.batch_size=1 or trainer.ema_decay=0",
        ),
        (
            replace(_OPTIONS, gradient_checkpointing=True, batch_size=1, ema_decay=0.0),
            "it takes a device with more memory",
        ),
    ],
)
def test_out_of_memory_names_two_options(options: TrainerConfig, helps: str) -> None:
    with pytest.raises(InputError, match=helps), advise_on_training_memory(options):
        torch.empty(2**60)  # the CPU allocator's own error
    with pytest.raises(InputError, match=helps), advise_on_training_memory(options):
        raise torch.OutOfMemoryError("CUDA out of memory")


def test_other_errors_pass() -> None:
    with pytest.raises(RuntimeError, match="shape"), advise_on_training_memory(_OPTIONS):
        raise RuntimeError("shape")
