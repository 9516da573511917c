"""Precision and repeatability follow the processor; running out of memory says what helps."""

from dataclasses import replace

import pytest
import torch

from extrap_train.config import TrainerConfig
from extrap_train.device import advise_on_training_memory, resolve_precision
from extrap_train.errors import InputError
from extrap_train.tasks import category

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


@pytest.mark.parametrize(
    ("avx512_bf16", "amx", "expected"),
    [
        (False, False, "32-true"),
        (True, False, "bf16-mixed"),
        (False, True, "bf16-mixed"),
    ],
)
def test_auto_takes_bfloat16_only_where_a_cpu_has_units_for_it(
    avx512_bf16: bool, amx: bool, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx512_bf16)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    assert resolve_precision("auto", torch.device("cpu")) == expected
    assert resolve_precision("auto", torch.device("mps")) == "32-true"
    for given in ("32-true", "16-mixed", "bf16-mixed"):
        assert resolve_precision(given, torch.device("cpu")) == given


@pytest.mark.parametrize(
    ("device", "asked", "repeats"),
    [("cpu", False, True), ("cuda", False, False), ("cuda", True, True), ("mps", False, False)],
)
def test_a_gpu_repeats_itself_only_if_asked(
    monkeypatch: pytest.MonkeyPatch, device: str, asked: bool, repeats: bool
) -> None:
    monkeypatch.setattr(category, "trainer_device", lambda _: torch.device(device))
    before = torch.are_deterministic_algorithms_enabled()
    try:
        category.quiet_trainer(TrainerConfig(accelerator="cpu", deterministic=asked), logger=False)
        assert torch.are_deterministic_algorithms_enabled() == repeats
    finally:
        torch.use_deterministic_algorithms(before)
