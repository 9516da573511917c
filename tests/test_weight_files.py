import argparse
import os
import pickle
import re
import stat
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from extrap_train.errors import InputError
from extrap_train.weight_files import Inert, WeightFile, write_tensors


def weight_file(path: Path) -> WeightFile:
    return WeightFile(path, "depth.checkpoint", "Net's weights (https://example.org/net)")


def network() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 2), nn.LayerNorm(2))


class Bomb:
    """Runs a command when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


@pytest.mark.parametrize("suffix", ["pth", "safetensors"])
def test_what_was_written_is_read_and_fills_the_network(tmp_path, suffix):
    expected, found = network(), network()
    path = tmp_path / f"net.{suffix}"
    (save_file if suffix == "safetensors" else torch.save)(expected.state_dict(), path)
    file = weight_file(path)
    file.fill(found, file.tensors(file.read()))
    for name, value in expected.state_dict().items():
        assert torch.equal(found.state_dict()[name], value)


def test_a_network_on_meta_takes_half_precision_weights_as_its_own(tmp_path):
    with torch.device("meta"):
        found = network()
    torch.save(network().half().state_dict(), tmp_path / "net.pth")
    file = weight_file(tmp_path / "net.pth")
    file.fill(found, file.tensors(file.read()))
    assert {x.dtype for x in found.parameters()} == {torch.float32}
    assert found(torch.zeros(1, 3)).isfinite().all()


def test_a_wrapped_state_with_foreign_values_is_read_without_them(tmp_path):
    state = OrderedDict(network().state_dict())
    arguments = argparse.Namespace(model="__import__('os').abort()", epochs=3)
    torch.save({"args": arguments, "model": state}, tmp_path / "net.pth")
    file = weight_file(tmp_path / "net.pth")
    content = file.read(inert=["argparse.Namespace"])
    assert type(content["args"]) is Inert
    assert content["args"].epochs == 3
    assert file.tensors(content, "state_dict", "model").keys() == state.keys()


def refused(file: WeightFile, said: str) -> None:
    """One line that names the file, the option and the source beside what is wrong."""
    with pytest.raises(InputError, match=re.escape(said)) as raised:
        file.fill(network(), file.tensors(file.read(), "model"))
    message = str(raised.value)
    assert "\n" not in message
    for part in (str(file.path), "depth.checkpoint=FILE", "https://example.org/net"):
        assert part in message


def test_absent(tmp_path):
    refused(weight_file(tmp_path / "no.pth"), "there is no such file")


@pytest.mark.parametrize("kept", [0, 1, 30, 500, 1200])
@pytest.mark.parametrize("suffix", ["pth", "safetensors"])
def test_truncated(tmp_path, kept, suffix):
    path = tmp_path / f"net.{suffix}"
    (save_file if suffix == "safetensors" else torch.save)(network().state_dict(), path)
    path.write_bytes(path.read_bytes()[: min(kept, path.stat().st_size - 1)])
    refused(weight_file(path), "is cut off, damaged, or no file of weights")


def test_a_picture_is_no_weights(tmp_path):
    (tmp_path / "net.pth").write_bytes(b"\x89PNG\r\n" + bytes(300))
    refused(weight_file(tmp_path / "net.pth"), "is cut off, damaged, or no file of weights")


@pytest.mark.parametrize("zipped", [True, False])
def test_code_does_not_run(tmp_path, zipped):
    content = {"model": network().state_dict(), "args": Bomb(tmp_path / "ran")}
    path = tmp_path / "net.pth"
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    refused(weight_file(path), "could run code")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("name", ["net.pkl", "net.ckpt", "net.safetensors"])
def test_a_plain_pickle_is_refused_as_one(tmp_path, protocol, name):
    """Python's own, which torch takes for a damaged file."""
    path = tmp_path / name
    path.write_bytes(pickle.dumps({"model": Bomb(tmp_path / "ran")}, protocol))
    refused(weight_file(path), "could run code, and is not read")
    assert not (tmp_path / "ran").exists()


def test_no_table_of_tensors(tmp_path):
    torch.save({"model": [torch.zeros(1)]}, tmp_path / "net.pth")
    refused(weight_file(tmp_path / "net.pth"), "holds no table of named tensors")


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (nn.Sequential(nn.Linear(3, 2)), "of 4 tensors 2 missing (1.bias)"),
        (
            nn.Sequential(nn.Linear(4, 2), nn.LayerNorm(2)),
            "of 4 tensors 1 of another shape (0.weight: [2, 4], not [2, 3])",
        ),
        (
            nn.Sequential(nn.Linear(3, 2), nn.LayerNorm(2), nn.Linear(1, 1)),
            "of 4 tensors 2 unknown (2.bias)",
        ),
    ],
)
def test_another_network(tmp_path, other, said):
    torch.save({"model": other.state_dict()}, tmp_path / "net.pth")
    refused(weight_file(tmp_path / "net.pth"), said)


def test_weights_without_permission_are_not_called_damaged(tmp_path, closed):
    torch.save(network().state_dict(), tmp_path / "net.pth")
    with closed(tmp_path / "net.pth"):
        refused(weight_file(tmp_path / "net.pth"), "cannot be opened (Permission denied)")
    with closed(tmp_path):
        refused(weight_file(tmp_path / "net.pth"), "cannot be opened (Permission denied)")


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "net.pth")
    refused(weight_file(tmp_path / "net.pth"), "is not a regular file")


def _zipped_again(path: Path, compression: int) -> None:
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)


def test_a_compressed_archive_is_refused_before_it_is_unpacked(tmp_path):
    """Torch compresses nothing; a bomb's table of 4 GB has 4 MB."""
    path = tmp_path / "net.pth"
    torch.save({"model": network().state_dict()}, path)
    _zipped_again(path, zipfile.ZIP_DEFLATED)
    refused(weight_file(path), "is a compressed archive")


def test_a_shape_of_more_numbers_than_the_file_holds_is_refused(tmp_path):
    """One number that claims to be a matrix of a terabyte."""
    state = network().state_dict() | {"0.weight": torch.zeros(1).expand(10**6, 10**6)}
    torch.save({"model": state}, tmp_path / "net.pth")
    assert (tmp_path / "net.pth").stat().st_size < 10_000
    refused(weight_file(tmp_path / "net.pth"), "0.weight has a shape of more numbers")


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        (torch.zeros(2, 3).to_sparse(), "not a plain tensor"),
        (torch.quantize_per_tensor(torch.zeros(2, 3), 0.1, 0, torch.qint8), "not a plain tensor"),
        (torch.zeros(2, 3, dtype=torch.int64), "of another type (0.weight: torch.int64"),
        (torch.zeros(2, 3, dtype=torch.complex64), "of another type (0.weight: torch.complex64"),
    ],
)
def test_tensors_of_another_kind_are_refused(tmp_path, odd, said):
    torch.save({"model": network().state_dict() | {"0.weight": odd}}, tmp_path / "net.pth")
    refused(weight_file(tmp_path / "net.pth"), said)


def test_names_that_are_no_text_are_refused(tmp_path):
    torch.save({"model": {0: torch.zeros(1), "a": torch.zeros(1)}}, tmp_path / "net.pth")
    refused(weight_file(tmp_path / "net.pth"), "holds no table of named tensors")


def test_what_is_written_may_be_read_as_the_umask_says(tmp_path, umask):
    for mask, mode in ((0o022, 0o644), (0o002, 0o664), (0o077, 0o600)):
        umask(mask)
        write_tensors(network().state_dict(), tmp_path / "net.safetensors")
        assert stat.S_IMODE((tmp_path / "net.safetensors").stat().st_mode) == mode


def test_a_folder_is_called_one(tmp_path):
    with pytest.raises(InputError, match=r"is a folder; give option=FILE, some weights"):
        WeightFile(tmp_path, "option", "some weights").read()
