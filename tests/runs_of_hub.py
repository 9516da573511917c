"""A finished run of a tiny model, as `task=category` leaves it."""

from pathlib import Path

from extrap_train.config import ModelConfig, UNetConfig, ValidationConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.model_files import save_model
from extrap_train.runs import RunFolder
from extrap_train.store.digests import folder_digest
from extrap_train.store.manifest import MANIFEST, Manifest, Split
from extrap_train.store.records import write_record, write_summary


def finished_run(folder: Path, start: Path | str | None = None, capture: str = "0001") -> RunFolder:
    """Trained on one rendered capture, by default from somebody's weights in the same folder."""
    run = RunFolder(folder / "run")
    unet = UNetConfig([16, 32], 1, [False, True], 2, 16, 16)
    began = str(start or folder / "zeronvs.ckpt")
    save_model(ExtrapolationModel(ModelConfig("small", unet=unet, start=began)), run.model)
    (run.model / "pickle.bin").write_bytes(b"\x80")
    scores = {"model": {"psnr": 24.0, "lpips": None}, "nearest": {"psnr": 15.5, "lpips": None}}
    summary = {
        "validation": scores,
        "steps": 7,
        "provenance": {"validation": vars(ValidationConfig())},
        "model_sha256": folder_digest(run.model),
    }
    write_summary(run.path, summary)
    split = {"hydrant": Split("synthetic", (capture,), ("0000",))}
    write_record(run.path / MANIFEST, Manifest.of({"model.start": began}, {}, split))
    return run
