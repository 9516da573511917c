"""The count of live bytes sees storages, and when they end."""

import torch
from live_bytes import LiveBytes


def test_live_bytes_see_storages_and_their_ends() -> None:
    with LiveBytes(iter([])) as live:
        one = torch.zeros(1000)
        view = one.view(10, 100)
        two = one + view.flatten()
        assert live.now == 8000
        del one, view
        assert live.now == 4000
        del two
        assert live.now == 0
        assert live.peak == 8000
