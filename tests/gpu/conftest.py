"""The device that these tests compare with the CPU."""

from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(scope="session")
def gpu() -> torch.device:
    return torch.device("cuda")


@pytest.fixture
def exact() -> Iterator[None]:
    """Convolutions in full precision: PyTorch lets a GPU compute them in TF32, ten bits."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32 = before
