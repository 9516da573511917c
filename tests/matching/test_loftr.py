import json
import os
import re

import pytest
import torch
from kornia.feature import LoFTR
from moved_pictures import turned

from extrap_train.config import LoftrMatcherConfig
from extrap_train.errors import InputError
from extrap_train.matching import Matcher
from extrap_train.matching.loftr import LoftrMatcher, read_loftr
from extrap_train.matching.matchers import matcher


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return LoFTR(pretrained=None).eval()


def saved(network, path):
    state = {f"matcher.{name}": x for name, x in network.state_dict().items()}
    torch.save({"state_dict": state}, path)
    return LoftrMatcherConfig(checkpoint=str(path), image_size=160)


def test_minimas_layout_loads_strictly_with_the_corrected_encoding(shared, tmp_path, network):
    layout = json.loads((shared / "layouts" / "minima_loftr.json").read_text())
    assert {name: list(x.shape) for name, x in network.state_dict().items()} == layout
    config = saved(network, tmp_path / "minima_loftr.ckpt")
    found = read_loftr(tmp_path / "minima_loftr.ckpt", config, "matcher.checkpoint")
    for name, value in network.state_dict().items():
        assert torch.equal(found.state_dict()[name], value), name
    assert found.config["coarse"]["temp_bug_fix"] is True
    assert network.config["coarse"]["temp_bug_fix"] is False  # kornia's own stays as it was


def test_a_picture_matches_itself_where_it_is(network):
    """Whatever the weights: cells sit at every eighth pixel of the working copy, whose pixels are
    as long as the picture's times the ratio of their sizes."""
    network.coarse_matching.thr = 0.0
    found = LoftrMatcher(LoftrMatcherConfig(image_size=160), network)
    assert isinstance(found, Matcher)
    picture, _ = turned(0, 1, (0, 0), 120).pictures((120, 200))
    known = torch.ones(120, 200, dtype=torch.bool)
    known[:, 100:] = False
    matches = found.match(picture, picture, known)
    assert len(matches) > 10
    assert (matches.first[:, 0] < 100).all()
    assert (matches.second - matches.first).norm(
        dim=-1
    ).max() < 6  # an untrained refinement stays in its window
    cells = matches.first * 160 / 200 - 0.5
    torch.testing.assert_close(cells, (cells / 8).round() * 8, atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda path: path.unlink(), "there is no such file"),
        (lambda path: os.truncate(path, 100_000), "is cut off, damaged, or no file of weights"),
        (lambda path: torch.save({"a": torch.zeros(1)}, path), "is another network's: of 211 tens"),
        (lambda path: torch.save({"a": os.system}, path), "could run code"),
    ],
    ids=["absent", "truncated", "another", "code"],
)
def test_bad_weights_are_one_line(tmp_path, network, spoil, said):
    config = saved(network, tmp_path / "net.ckpt")
    spoil(tmp_path / "net.ckpt")
    with pytest.raises(InputError, match=re.escape(said)) as raised:
        matcher(config)
    message = str(raised.value)
    assert "\n" not in message
    for part in ("net.ckpt", "matcher.checkpoint=FILE", "github.com/LSXI7/MINIMA"):
        assert part in message


def test_no_option_says_what_is_wanted():
    with pytest.raises(InputError, match=r"give matcher\.checkpoint=FILE, minima_loftr\.ckpt"):
        matcher(LoftrMatcherConfig())
