import os
import re
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file
from tiny import EXPRESSION, TINY, plain_state, write_checkpoint

from extrap_train.config import Mast3rConfig
from extrap_train.depth.mast3r.network.mast3r_checkpoint import read_network
from extrap_train.depth.sources import depth_source
from extrap_train.errors import InputError

SMALL = replace(TINY, encoder_depth=1, decoder_depth=2)


@pytest.fixture(scope="module")
def state():
    return plain_state(SMALL)


@pytest.mark.parametrize(
    "architecture",
    [SMALL, replace(SMALL, descriptor_width=None), replace(SMALL, head="linear", patch=8)],
    ids=["mast3r", "dust3r", "dust3r linear"],
)
def test_every_family_is_recognised_by_its_tensors(tmp_path, architecture):
    expected = plain_state(architecture)
    network = read_network(write_checkpoint(expected, tmp_path / "net.pth"))
    found = replace(network.architecture, descriptor_width=architecture.descriptor_width)
    assert found == architecture
    for name, value in network.state_dict().items():
        assert torch.equal(value, expected[name]), name
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_safetensors_name_shared_tensors_once(tmp_path):
    # Where no expression says it, heads are 64 wide, as in every published network.
    architecture = replace(SMALL, encoder_heads=1, decoder_width=64, decoder_heads=1)
    state = plain_state(architecture)
    once = {name: x for name, x in state.items() if ".layer_rn." not in name}
    save_file(once, tmp_path / "net.safetensors")
    network = read_network(tmp_path / "net.safetensors")
    assert network.architecture == architecture
    for name, value in network.state_dict().items():
        assert torch.equal(value, state[name]), name


def refused(path, said):
    with pytest.raises(InputError, match=re.escape(said)) as raised:
        depth_source(Mast3rConfig(checkpoint=str(path)))
    message = str(raised.value)
    assert "\n" not in message
    for part in (str(path), "depth.checkpoint=FILE", "github.com/naver/mast3r"):
        assert part in message


def test_no_option_says_what_is_wanted():
    with pytest.raises(InputError, match=r"give depth\.checkpoint=FILE, weights of MASt3R"):
        depth_source(Mast3rConfig())


def test_absent(tmp_path):
    refused(tmp_path / "net.pth", "there is no such file")


def test_truncated(tmp_path, state):
    path = write_checkpoint(state, tmp_path / "net.pth")
    os.truncate(path, path.stat().st_size // 2)
    refused(path, "is cut off, damaged, or no file of weights")


def test_another_architecture(tmp_path, state):
    path = tmp_path / "net.pth"
    write_checkpoint({"conv1.weight": torch.zeros(4, 3, 7, 7)}, path)
    refused(path, "is another network's (")
    write_checkpoint({n: x for n, x in state.items() if "dec_blocks2" not in n}, path)
    refused(path, "missing (dec_blocks2.0.attn.proj.bias)")
    write_checkpoint(state, path, EXPRESSION.replace("enc_num_heads=2", "enc_num_heads=7"))
    refused(path, "64 features do not fall into 7 heads")
    write_checkpoint(state, path, EXPRESSION.replace("enc_num_heads=2", "enc_num_heads=0"))
    refused(path, "is another network's")


def test_code_in_the_file_does_not_run(tmp_path, state):
    class Bomb:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'ran'}",)

    torch.save({"args": Bomb(), "model": state}, tmp_path / "net.pth")
    refused(tmp_path / "net.pth", "could run code")
    assert not (tmp_path / "ran").exists()
