"""An adapter changes what a model generates and never the model; it comes back as it was saved."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import peft
import pytest
import torch
from lightning.fabric import Fabric
from live_bytes import LiveBytes
from orbits import walls
from torch import Tensor, nn

from extrap_train.config import LoraConfig, ModelConfig, SamplerConfig
from extrap_train.data.scene_pairs import adaptation_pairs
from extrap_train.diffusion.adaptation import Adaptation, adapt
from extrap_train.diffusion.lora import (
    AdapterOrigin,
    add_adapter,
    base_hashes,
    load_adapter,
    read_adapter_record,
    save_adapter,
)
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views
from extrap_train.errors import InputError
from extrap_train.views import PairBatch

OPTIONS = LoraConfig(rank=2, convolutions=True, steps=12, validate_every=4, batch_size=4)


ORIGIN = AdapterOrigin(
    "/scenes/apple", {"a.jpg": "ab", "b.jpg": "cd"}, "ours-apple", {"lora.rank": 2}, "kept step 4"
)


def _model(config: ModelConfig) -> ExtrapolationModel:
    torch.manual_seed(0)
    model = ExtrapolationModel(config).eval()
    nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    return model


def _generated(model: ExtrapolationModel, batch: PairBatch) -> Tensor:
    return sample_views(model, batch, SamplerConfig(), "abc")


def _randomised(model: ExtrapolationModel) -> peft.PeftModel:
    adapter = add_adapter(model, OPTIONS, seed=0)
    torch.manual_seed(1)
    for name, weight in adapter.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(weight, std=0.1)
    return adapter


def test_a_new_adapter_has_no_effect_and_only_it_learns(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = _model(config)
    before = _generated(model, batch)
    add_adapter(model, OPTIONS, seed=0)
    torch.testing.assert_close(_generated(model, batch), before)
    learning = {n for n, p in model.named_parameters() if p.requires_grad}
    assert learning
    assert all(".lora_" in name for name in learning)
    assert any("attn1" in name for name in learning)
    assert any("conv1" in name for name in learning)


def test_it_comes_back_as_it_was_saved_and_goes_without_a_trace(
    config: ModelConfig, batch: PairBatch, tmp_path: Path
) -> None:
    model = _model(config)
    state = {name: value.clone() for name, value in model.state_dict().items()}
    before = _generated(model, batch)
    adapter = _randomised(model)
    adapted = _generated(model, batch)
    assert (adapted - before).abs().max() > 1e-3
    save_adapter(model, adapter, tmp_path / "adapter", ORIGIN)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["adapter"]
    adapter.unload()
    assert all(torch.equal(state[name], value) for name, value in model.state_dict().items())
    fresh = _model(config)
    load_adapter(fresh, tmp_path / "adapter")
    torch.testing.assert_close(_generated(fresh, batch), adapted)


def test_plain_peft_reads_the_folder(config: ModelConfig, batch: PairBatch, tmp_path: Path) -> None:
    model = _model(config)
    save_adapter(model, _randomised(model), tmp_path / "adapter", ORIGIN)
    adapted = _generated(model, batch)
    fresh = _model(config)
    peft.PeftModel.from_pretrained(fresh.unet, str(tmp_path / "adapter"))
    torch.testing.assert_close(_generated(fresh, batch), adapted)


def test_other_weights_and_other_folders_are_refused(config: ModelConfig, tmp_path: Path) -> None:
    model = _model(config)
    save_adapter(model, _randomised(model), tmp_path / "adapter", ORIGIN)
    other = _model(config)
    nn.init.normal_(other.unet.conv_out.weight, std=0.1)
    with pytest.raises(InputError, match="was trained on other weights"):
        load_adapter(other, tmp_path / "adapter")
    unlike = _model(config)
    nn.init.normal_(unlike.cc_projection.weight, std=0.1)  # what the adapted layers attend to
    with pytest.raises(InputError, match="was trained on other weights"):
        load_adapter(unlike, tmp_path / "adapter")
    with pytest.raises(InputError, match="is no adapter folder of task=scene"):
        load_adapter(_model(config), tmp_path / "gone")
    weights = tmp_path / "adapter" / "adapter_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:100])
    with pytest.raises(InputError, match="is no adapter folder of task=scene"):
        load_adapter(_model(config), tmp_path / "adapter")


def test_an_adapter_says_what_it_was_made_from(config: ModelConfig, tmp_path: Path) -> None:
    model = _model(config)
    folder = tmp_path / "adapter"
    save_adapter(model, _randomised(model), folder, ORIGIN)
    record = read_adapter_record(folder)
    assert vars(ORIGIN).items() <= vars(record).items()
    card = (folder / "README.md").read_text()
    assert "More Information Needed" not in card
    hashes = base_hashes(model)
    for said in (
        "/scenes/apple",
        "`a.jpg`, `b.jpg`",
        "ours-apple",
        hashes.denoiser,
        hashes.others,
        "rank=2",
    ):
        assert said in card


@pytest.mark.parametrize("changed", ["flip", "cut", "gone", "folder"])
def test_an_adapter_whose_tensors_were_changed_is_refused(
    config: ModelConfig, tmp_path: Path, changed: str
) -> None:
    """One bit gives another picture, and no error of its own."""
    model = _model(config)
    save_adapter(model, _randomised(model), tmp_path, ORIGIN)
    file = tmp_path / "adapter_model.safetensors"
    content = bytearray(file.read_bytes())
    content[-5] ^= 64
    file.unlink()
    if changed == "folder":
        file.mkdir()
    elif changed != "gone":
        file.write_bytes(content if changed == "flip" else content[:-1])
    with pytest.raises(InputError, match=r"adapter_model\.safetensors: "):
        load_adapter(_model(config), tmp_path)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"r": 3}, "r is 3"),
        ({"r": 0}, "r: "),
        ({"r": 10**9, "lora_alpha": 10**9}, "r: "),
        ({"lora_alpha": int("9" * 400)}, "lora_alpha: "),
        ({"lora_alpha": 3}, "lora_alpha 3"),
        ({"r": "many"}, "r: "),
        ({"r": True}, "r: "),
        ({"peft_type": "IA3"}, "peft_type: "),
        ({"peft_type": "NONE"}, "peft_type: "),
        ({"target_modules": ["conv_in"]}, "target_modules.0: "),
        ({"target_modules": None}, "target_modules: "),
        ({"target_modules": []}, "target_modules: "),
        ({"target_modules": ["to_q"]}, "tensors do not fit"),
    ],
)
def test_an_adapter_of_another_kind_is_refused_and_leaves_the_model_alone(
    config: ModelConfig, batch: PairBatch, tmp_path: Path, changed: dict[str, Any], said: str
) -> None:
    model = _model(config)
    save_adapter(model, _randomised(model), tmp_path / "adapter", ORIGIN)
    file = tmp_path / "adapter" / "adapter_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))
    model = _model(config)
    names = list(model.state_dict())
    with pytest.raises(InputError, match=said) as raised:
        load_adapter(model, tmp_path / "adapter")
    assert "\n" not in str(raised.value)
    assert list(model.state_dict()) == names


def _adapt(
    config: ModelConfig, seconds: float = 1e9, **options: Any
) -> tuple[ExtrapolationModel, Adaptation]:
    model = _model(config)
    return model, _adapted(model, replace(OPTIONS, **options), seconds)


def _adapted(model: ExtrapolationModel, options: LoraConfig, seconds: float = 1e9) -> Adaptation:
    return adapt(
        model,
        add_adapter(model, options, seed=0),
        adaptation_pairs(walls(3), 3, options.virtual_references, seed=0),
        options,
        SamplerConfig(),
        seconds=seconds,
        seed=0,
        fabric=Fabric(accelerator="cpu", devices=1),
    )


def test_adapting_learns_the_scene_repeatably_and_keeps_the_best(config: ModelConfig) -> None:
    options = {"steps": 8, "learning_rate": 3e-3, "patience": 100, "virtual_references": 2}
    model, done = _adapt(config, **options)
    again, done_again = _adapt(config, **options)
    assert done.losses == done_again.losses
    for one, other in zip(model.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    losses = dict(done.losses)
    assert done.best_step > 0
    assert losses[done.best_step] == min(losses.values()) < losses[0]
    assert done.ended == "steps"


def test_gradient_checkpointing_learns_the_same_with_less_memory(config: ModelConfig) -> None:
    unet = replace(config.unet, channels=[32, 64])
    peaks, losses = [], []
    for checkpointing in (False, True):
        model = _model(replace(config, unet=unet))
        if checkpointing:
            model.unet.enable_gradient_checkpointing()
        with LiveBytes(model.parameters()) as live:
            losses.append(_adapted(model, replace(OPTIONS, steps=1, batch_size=8)).losses)
        peaks.append(live.peak)
    assert losses[1] == losses[0]
    assert peaks[1] < 0.8 * peaks[0]


def _adapter_of(model: ExtrapolationModel) -> dict[str, Tensor]:
    return {name: p.detach() for name, p in model.named_parameters() if ".lora_" in name}


def test_it_ends_where_the_held_out_pair_gains_no_more_and_keeps_the_best_step(
    config: ModelConfig,
) -> None:
    """Not the last: its weights are those of a training that ended where the best was."""
    options = {"learning_rate": 30.0, "patience": 2, "virtual_references": 2}
    model, done = _adapt(config, steps=400, **options)
    losses = dict(done.losses)
    assert done.ended == "held-out pair"
    assert 0 < done.best_step == min(losses, key=losses.__getitem__)
    assert done.steps == done.best_step + 2 * OPTIONS.validate_every
    shorter, ended_there = _adapt(config, steps=done.best_step, **options)
    assert ended_there.best_step == ended_there.steps == done.best_step
    for name, kept in _adapter_of(model).items():
        assert torch.equal(kept, _adapter_of(shorter)[name]), name


def test_the_base_is_kept_where_no_step_gains(config: ModelConfig) -> None:
    """A rate that destroys the model at once."""
    model, done = _adapt(config, steps=400, learning_rate=1e8, patience=2)
    assert (done.best_step, done.ended) == (0, "held-out pair")
    assert done.steps == 2 * OPTIONS.validate_every
    written = [p for name, p in _adapter_of(model).items() if ".lora_B" in name]
    assert written
    assert not any(p.any() for p in written)


def test_it_ends_where_the_time_is_up(config: ModelConfig) -> None:
    _, timed = _adapt(config, steps=400, seconds=0.2)
    assert timed.ended == "time"
    assert timed.steps < 400


@pytest.mark.parametrize(("steps", "every"), [(5, 25), (7, 3)])
def test_the_last_step_is_measured_and_can_be_kept(
    config: ModelConfig, steps: int, every: int
) -> None:
    rate = {"learning_rate": 3e-3, "patience": 100, "virtual_references": 2}
    _, done = _adapt(config, steps=steps, validate_every=every, **rate)
    assert done.losses[-1][0] == done.steps == steps
    assert done.best_step == min(done.losses, key=lambda found: found[1])[0]
    assert done.ended == "steps"


@pytest.mark.parametrize(("budget_s", "evaluations"), [(1e9, 12), (600.0, 6), (60.0, 1), (15.0, 1)])
def test_a_slow_model_is_measured_less_so_that_the_budget_holds(
    config: ModelConfig, budget_s: float, evaluations: int
) -> None:
    """Each run of the denoiser takes ten seconds of a clock; three pairs are measured at once."""
    model, passed = _model(config), [0.0]

    def tick(*_: object) -> None:
        passed[0] += 5.0

    model.unet.register_forward_pre_hook(tick)
    heard: list[tuple[int, float]] = []
    done = adapt(
        model,
        add_adapter(model, OPTIONS, seed=0),
        adaptation_pairs(walls(3), 3, 8, seed=0),
        replace(OPTIONS, steps=1),
        SamplerConfig(steps=50),
        seconds=budget_s,
        seed=0,
        fabric=Fabric(accelerator="cpu", devices=1),
        on_step=lambda step, share: heard.append((step, share)),
        clock=lambda: passed[0],
    )
    assert heard[0][0] == 0
    tried_s = 20.0 if budget_s < 1e9 else 10.0
    assert heard[0][1] * budget_s == pytest.approx(tried_s + 10.0 * evaluations)
    assert done.steps == (1 if heard[0][1] < 1 else 0)
    assert done.ended == ("steps" if done.steps else "time")


def test_a_long_schedule_and_many_held_out_pairs_are_measured_a_batch_at_a_time(
    config: ModelConfig,
) -> None:
    """Fifty steps of a full-size model must not become fifty times the memory."""
    model = _model(config)
    sizes: list[int] = []
    model.unet.register_forward_pre_hook(lambda _, arguments: sizes.append(len(arguments[0])))
    options = replace(OPTIONS, batch_size=2, steps=1, virtual_references=5)
    adapter = add_adapter(model, options, seed=0)
    sampler = SamplerConfig(steps=50)
    pairs = adaptation_pairs(walls(3), 3, options.virtual_references, seed=0)
    fabric = Fabric(accelerator="cpu", devices=1)
    adapt(model, adapter, pairs, options, sampler, seconds=1e9, seed=0, fabric=fabric)
    assert max(sizes) == 2
    views_levels_draws = 3 * 4 * 3
    with_and_without_adapter = 2
    measured = 2 * views_levels_draws  # before and after one step
    timed, trained = 2, 2
    assert sum(sizes) == with_and_without_adapter * (measured + timed + trained)


@pytest.mark.parametrize("guidance", [1.0, 2.0])
def test_the_null_condition_is_trained_where_sampling_asks_for_it(
    config: ModelConfig, guidance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def loss(
        model: ExtrapolationModel, batch: PairBatch, generator: Any, dropout: float, **anchor: Any
    ) -> Tensor:
        asked.append(dropout)
        return diffusion_loss(model, batch, generator, dropout, **anchor)

    monkeypatch.setattr("extrap_train.diffusion.adaptation.diffusion_loss", loss)
    model = _model(config)
    options = replace(OPTIONS, steps=1)
    adapter = add_adapter(model, options, seed=0)
    pairs = adaptation_pairs(walls(2), 3, 2, seed=0)
    fabric = Fabric(accelerator="cpu", devices=1)
    sampler = SamplerConfig(guidance=guidance)
    adapt(model, adapter, pairs, options, sampler, seconds=1e9, seed=0, fabric=fabric)
    assert [share > 0 for share in asked] == [guidance != 1]
